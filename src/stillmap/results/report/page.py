"""`report.html`: one page that shows what a run did, without a request to anywhere.

The frame and the looks of the report: no script, nothing from outside.
"""

import itertools
import math
from collections import Counter
from html import escape
from pathlib import Path
from string import Template

from stillmap.core.json import count_skipped, to_jsonable, version
from stillmap.mapping.beam_statistics import count_beams
from stillmap.pipeline.result import Result
from stillmap.results.report.figures import likelihood_svg
from stillmap.results.report.maps import changes_section, evolution_section, maps_section
from stillmap.results.report.objects import objects_section, tilting_section
from stillmap.results.report.previews import ModelPreviews, model_section
from stillmap.results.report.tables import (
    bytes_text,
    duration_text,
    iterations_table,
    learned_section,
    name_value_table,
    options_table,
    share_text,
    skipped_list,
    stages_table,
)
from stillmap.rig.build import TiltingResult

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

# titles of the two curves and the words below them, for each likelihood
_DEFAULT = (
    ("Expected log likelihood", "Bound: log likelihood of the cells"),
    "In nats, the kept iteration circled. Right, what the loop watches: how probable what was seen "
    "of the cells is in which beams ended. Left: the same without the entropy of what each holds.",
)

_PRINTED = (
    ("Expected log likelihood, (5)", "Bound: with the entropy of the labels"),
    "In nats, the kept iteration circled. Left: (5) of the paper, the curve of its Fig. 5. Right, "
    "what the loop watches: the same and the entropy of the labels, the log likelihood of the "
    "ranges.",
)


def write_report(
    path: Path,
    result: Result,
    tilting: TiltingResult | None = None,
    stills: ModelPreviews | None = None,
) -> None:
    """Write the report as one HTML page of a few megabytes at most, whatever the map's size."""
    path.write_text(render_report(result, tilting, stills), encoding="utf-8")


def render_report(
    result: Result, tilting: TiltingResult | None = None, stills: ModelPreviews | None = None
) -> str:
    """The page. All pictures lie in it; it holds no script and reads without one."""
    name = _name(result)
    sections = [
        _header(result, name),
        _headline(result),
        _warnings(result),
        maps_section(result),
        changes_section(result),
        objects_section(result),
        tilting_section(result, tilting),
        model_section(stills),
        learned_section(result),
        _estimate_section(result),
        evolution_section(result),
        f'<div class="columns">{_recording_section(result)}{_stages_section(result)}</div>',
        _options_section(result),
        f'<footer class="soft">Written by stillmap {escape(version())}.</footer>',
    ]
    body = "\n".join(section for section in sections if section)
    return PAGE.substitute(title=escape(f"{name}: stillmap report"), style=STYLE, body=body)


def likelihood_sentence(result: Result) -> str:
    """Whether and where the bound fell from one iteration to the next."""
    if len(result.iterations) < 2:
        return "There was one iteration only."
    records = [it for it in result.iterations if math.isfinite(it.bound)]
    falls = [
        (after.number, (before.bound - after.bound) / max(abs(before.bound), 1e-300))
        for before, after in itertools.pairwise(records)
        if after.bound < before.bound
    ]
    if not falls:
        return "The likelihood (its bound) never fell from one iteration to the next."
    where = ", ".join(str(number) for number, _ in falls)
    number, share = max(falls, key=lambda fall: fall[1])
    most = f"by {share_text(share)}" if len(falls) == 1 else f"most, by {share_text(share)}"
    most += "" if len(falls) == 1 else f", at iteration {number}"
    plural = "s" if len(falls) > 1 else ""
    return (
        f"The likelihood (its bound) fell at iteration{plural} {where} ({most}). That can "
        "happen: poses are found scan by scan and by a measure of their own, so what helps one "
        "may cost another."
    )


def held_out_sentence(result: Result) -> str:
    """How well the kept iteration foresees scans that were left out of its map."""
    figures = {it.number: it.held_out_log_likelihood for it in result.iterations}
    kept = figures.get(result.best_iteration)
    if kept is None or not math.isfinite(kept):
        return ""
    return (
        f"Scans that were left out of the map are foreseen with {kept:.3f} nats per beam more than "
        "without a map: the higher the better, among maps of the same recording."
    )


def loops_sentence(result: Result) -> str:
    """How many loops were closed, and why others were not."""
    if not result.loops:
        return ""
    reasons = Counter(one.refused for one in result.loops if one.refused)
    tried, refused = len(result.loops), reasons.total()
    text = f"Places seen again: {tried - refused:,} of {tried:,} closed a loop"
    if refused:
        why = ", ".join(f"{reason} ({n:,})" for reason, n in reasons.most_common())
        text += f"; the rest was refused: {why}"
    return text + "."


def _name(result: Result) -> str:
    path = str(result.recording.source.get("path", ""))
    return Path(path).name or "recording"


def _header(result: Result, name: str) -> str:
    source = result.recording.source
    path, kind = str(source.get("path", "")), str(source.get("format", ""))
    details = ", ".join(text for text in (path, kind) if text)
    return (
        f"<header><h1>What stands still in {escape(name)}</h1>"
        f'<p class="soft">{escape(details)}</p></header>'
    )


def _headline(result: Result) -> str:
    recording = result.recording
    counts = count_beams(recording, result.p_static)
    stamps = recording.stamp_ns
    seconds = float(stamps[-1] - stamps[0]) / 1e9 if len(stamps) else 0.0
    took = sum(float(stage.get("seconds") or 0) for stage in result.stages.values())
    memory = max(
        (stage.get("peak_memory_bytes") or 0 for stage in result.stages.values()), default=0
    )
    cards = [
        ("Scans", f"{recording.n_scans:,}", _skipped_note(result)),
        ("Beams", f"{counts['beams']:,}", f"{counts['hits']:,} hit something"),
        (
            "Dynamic",
            share_text(counts["dynamic"] / max(counts["hits"], 1)),
            f"{counts['dynamic']:,} of the hits",
        ),
        ("Recorded", duration_text(seconds), "from first to last scan"),
        ("Computed in", duration_text(took), f"{_per_scan(took, recording.n_scans)} per scan"),
        ("Peak memory", bytes_text(memory), ""),
        (
            "Iterations",
            f"{len(result.iterations)}",
            f"number {result.best_iteration} kept; "
            + ("converged" if result.converged else "stopped at the limit"),
        ),
    ]
    items = "".join(
        f"<div><dt>{escape(title)}</dt><dd>{escape(value)}<small>{escape(note)}</small></dd></div>"
        for title, value, note in cards
    )
    return f'<dl class="cards">{items}</dl>'


def _per_scan(seconds: float, scans: int) -> str:
    milliseconds = 1e3 * seconds / max(scans, 1)
    return f"{milliseconds:.0f} ms" if milliseconds >= 10 else f"{milliseconds:.2g} ms"


def _skipped_note(result: Result) -> str:
    skipped = count_skipped(result.recording.source)
    return f"{skipped:,} damaged, skipped" if skipped else "none skipped"


def _warnings(result: Result) -> str:
    if not result.warnings:
        return ""
    items = "".join(f"<li>{escape(text)}</li>" for text in result.warnings)
    return f'<section class="warnings"><h2>Warnings</h2><ul>{items}</ul></section>'


def _estimate_section(result: Result) -> str:
    if not result.iterations:
        return ""
    end = (
        "The loop stopped by itself."
        if result.converged
        else "The loop stopped at its limit, before it had converged."
    )
    return (
        "<section><h2>How the estimate went</h2>"
        f"<p>{escape(likelihood_sentence(result))} {end} "
        f"The result is that of iteration {result.best_iteration}. "
        f"{escape(held_out_sentence(result))}</p><p>{escape(loops_sentence(result))}</p>"
        f"{_curve(result)}<details><summary>The numbers</summary>"
        f"{iterations_table(result.iterations, result.best_iteration)}</details></section>"
    )


def _curve(result: Result) -> str:
    if len(result.iterations) < 2:
        return ""
    titles, caption = _DEFAULT if result.options.estimator == "stillmap" else _PRINTED
    return (
        f'<figure role="img" aria-label="Likelihood over {len(result.iterations)} iterations; '
        f'the numbers are in the table below.">'
        f"{likelihood_svg(result.iterations, result.best_iteration, titles)}"
        f'<figcaption class="below">{caption}</figcaption></figure>'
    )


def _recording_section(result: Result) -> str:
    source = to_jsonable(result.recording.source)
    skipped, odometry = source.pop("skipped", None), source.pop("skipped_odometry", None)
    counts = count_beams(result.recording, result.p_static)
    beams = (
        f"Of {counts['beams']:,} beams {counts['hits']:,} hit something, {counts['max_range']:,} "
        f"met nothing within range and {counts['unusable']:,} are unusable."
    )
    text = (
        "<section><h2>The recording, and what was guessed about it</h2>"
        f"<p>{beams}</p>{name_value_table(source)}"
    )
    if skipped:
        text += f"<h2>Scans that were skipped</h2>{skipped_list(skipped)}"
    if odometry:
        text += f"<h2>Odometry that was skipped</h2>{skipped_list(odometry)}"
    return text + "</section>"


def _stages_section(result: Result) -> str:
    if not result.stages:
        return ""
    return (
        "<section><h2>Where time and memory went</h2>"
        '<p class="soft">Writing these files comes on top.</p>'
        f"{stages_table(result.stages)}</section>"
    )


def _options_section(result: Result) -> str:
    return (
        "<section><h2>Options</h2><details><summary>Every option as this run used it</summary>"
        f"{options_table(result.options)}</details></section>"
    )
