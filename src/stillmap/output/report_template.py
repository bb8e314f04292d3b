"""The frame and the looks of the report: no script, nothing from outside."""

from string import Template

PAGE = Template("""<!DOCTYPE html>
<html lang="en">
<head>
<meta charset="utf-8">
<meta name="viewport" content="width=device-width, initial-scale=1">
<meta name="color-scheme" content="light dark">
<title>$title</title>
<style>$style</style>
</head>
<body>
$body
</body>
</html>
""")

STYLE = """
:root { --paper: #ffffff; --card: #f5f6f8; --ink: #1d2329; --soft: #5a646f; --rule: #d5dae0;
  --accent: #2463a8; --orange: #d96a00; --warn: #fff3df; }
@media (prefers-color-scheme: dark) { :root { --paper: #14181d; --card: #1f252c; --ink: #e6e9ec;
  --soft: #a3adb8; --rule: #3a434d; --accent: #79b4f2; --orange: #ff9a3d; --warn: #3a2c14; } }
* { box-sizing: border-box; }
body { margin: 0 auto; padding: 1.5rem 1.25rem 4rem; max-width: 82rem; background: var(--paper);
  color: var(--ink); font: 16px/1.5 system-ui, "Segoe UI", "DejaVu Sans", sans-serif; }
h1 { font-size: 1.65rem; line-height: 1.2; margin: 0; overflow-wrap: anywhere; }
h2 { font-size: 1.2rem; margin: 2.6rem 0 .5rem; }
p { margin: .4rem 0; max-width: 48rem; }
.soft, figcaption { color: var(--soft); }
code, .number { font-variant-numeric: tabular-nums; }
code { font-family: ui-monospace, "DejaVu Sans Mono", monospace; font-size: .88em; }
.cards { display: grid; grid-template-columns: repeat(auto-fit, minmax(8.6rem, 1fr)); gap: .75rem;
  margin: 1.25rem 0 0; }
.cards div { background: var(--card); border-radius: .5rem; padding: .7rem .9rem; }
.cards dt { color: var(--soft); font-size: .85rem; }
.cards dd { margin: 0; font-size: 1.3rem; font-weight: 600; line-height: 1.35; }
.cards small { display: block; color: var(--soft); font-size: .8rem; font-weight: 400; }
.warnings { background: var(--warn); border-left: 4px solid var(--orange); border-radius: .3rem;
  padding: .6rem 1rem; margin: 1.25rem 0 0; }
.warnings h2 { margin: 0; font-size: 1rem; }
.warnings ul { margin: .3rem 0 0; padding-left: 1.2rem; }
.toggle { margin-right: .35rem; accent-color: var(--accent); }
.toggle + label { margin-right: 1.4rem; cursor: pointer; }
.pair, .row { display: grid; gap: 1.1rem; margin-top: .8rem; align-items: start; }
.pair { align-items: end; grid-template-columns: repeat(auto-fit, minmax(min(26rem, 100%), 1fr)); }
.row { grid-template-columns: repeat(auto-fit, minmax(min(15rem, 100%), 1fr)); }
.row figure { max-width: 38rem; }
.sides { grid-template-columns: repeat(auto-fill, minmax(min(18rem, 100%), 1fr)); }
#large:checked ~ .pair { grid-template-columns: 1fr; }
figure { margin: 0; }
figcaption { font-size: .9rem; margin-bottom: .35rem; }
figcaption b { color: var(--ink); }
.map { position: relative; margin: 0 auto; width: min(100%, calc(82vh * var(--ratio)));
  aspect-ratio: var(--ratio); border: 1px solid var(--rule); overflow: hidden; }
#large:checked ~ .pair .map { width: min(100%, calc(140vh * var(--ratio))); }
.map img, .map svg { position: absolute; inset: 0; width: 100%; height: 100%; }
.map img { image-rendering: pixelated; }
.map img.reduced { image-rendering: auto; }
.map polyline { fill: none; stroke: #2463a8; stroke-width: 1.6; stroke-linejoin: round;
  vector-effect: non-scaling-stroke; }
.map .numbers text { fill: #111; stroke: #fff; stroke-width: .25em; paint-order: stroke; }
.map .ways polyline { stroke: #d96a00; stroke-width: 1.3; }
.still { display: block; width: 100%; height: auto; border: 1px solid var(--rule); }
.map .path { display: none; }
#show-path:checked ~ .pair .path { display: block; }
#show-dynamic:not(:checked) ~ .pair .dynamic { display: none; }
#show-thin:not(:checked) ~ .pair .thin { display: none; }
.scale { position: absolute; left: 2%; bottom: 2%; border: solid #1d2329; border-width: 0 2px 2px;
  color: #1d2329; font-size: .75rem; line-height: 1.3; text-align: center;
  text-shadow: 0 0 3px #fff, 0 0 3px #fff, 0 0 3px #fff; }
.key { display: inline-block; width: .75em; height: .75em; margin: 0 .3em 0 .9em;
  border: 1px solid var(--soft); border-radius: 2px; vertical-align: -.05em; }
.below { max-width: 48rem; margin: .35rem 0 0; }
.curve { display: block; width: 100%; height: auto; max-width: 62rem; }
.curve text { fill: var(--ink); }
table { border-collapse: collapse; font-size: .92rem; }
th, td { text-align: left; padding: .22rem .9rem .22rem 0; border-bottom: 1px solid var(--rule);
  vertical-align: top; overflow-wrap: anywhere; }
thead th { color: var(--soft); font-weight: 500; }
tbody th { font-weight: 500; white-space: nowrap; }
td.number, th.number { text-align: right; white-space: nowrap; }
tr.best th, tr.best td { color: var(--orange); font-weight: 600; }
.wide { overflow-x: auto; }
td ul { margin: 0; padding-left: 1.1rem; }
td > ul { padding-left: 0; list-style: none; }
.bar { width: 10rem; }
.bar span { display: block; height: .55rem; margin-top: .5rem; border-radius: 3px;
  background: var(--accent); min-width: 2px; }
.columns { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(28rem, 100%), 1fr));
  gap: 0 3rem; align-items: start; }
details { margin-top: .6rem; }
summary { cursor: pointer; color: var(--accent); }
footer { margin-top: 3rem; border-top: 1px solid var(--rule); padding-top: .6rem;
  font-size: .85rem; }
"""
