"""The report's tables and the way it words numbers.

The report's words and bars on what an estimator learned from the recording.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from stillmap.core.config import to_dict
from stillmap.core.json import to_jsonable
from stillmap.mapping.beam_statistics import count_beams
from stillmap.pipeline.estimate import IterationRecord
from stillmap.pipeline.result import Result

# a damaged file can have a remark on every line; run.json names them all
_MOST_ITEMS = 25


def share_text(share: float) -> str:
    """A share in percent, with two figures that say something."""
    percent = 100 * share
    if not math.isfinite(percent):
        return "unknown"
    return f"{percent:.1f} %" if percent >= 1 or percent == 0 else f"{percent:.2g} %"


def duration_text(seconds: float) -> str:
    """A time span as people say it."""
    if 0 < seconds < 0.001:
        return "under 1 ms"
    if seconds < 10:
        return f"{seconds:.2g} s"
    if seconds < 59.5:
        return f"{seconds:.0f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest} s"
    return f"{minutes // 60} h {minutes % 60} min"


def bytes_text(size: float) -> str:
    """A number of bytes in MB or GB (powers of ten)."""
    if not size:
        return "unknown"
    return f"{size / 1e6:,.0f} MB" if size < 1e9 else f"{size / 1e9:.2f} GB"


def number_text(value: float | None) -> str:
    """A number to seven figures, a dash where there is none."""
    return "-" if value is None or not math.isfinite(value) else f"{value:,.7g}"


def iterations_table(iterations: Sequence[IterationRecord], best: int) -> str:
    """One row per iteration, the best one marked."""
    names = ("iteration", "expected log likelihood", "bound", "held out", "changed", "time")
    rows = []
    for it in iterations:
        cells = [
            number_text(it.expected_log_likelihood),
            number_text(it.bound),
            number_text(it.held_out_log_likelihood),
            share_text(it.changed_share),
            duration_text(it.seconds),
        ]
        kept = " (kept)" if it.number == best else ""
        marked = ' class="best"' if kept else ""
        rows.append(
            f'<tr{marked}><th scope="row">{it.number}{kept}</th>'
            + "".join(f'<td class="number">{escape(cell)}</td>' for cell in cells)
            + "</tr>"
        )
    return _table(names, rows)


def stages_table(stages: Mapping[str, Mapping[str, Any]]) -> str:
    """Seconds and peak memory per stage."""
    longest = max((float(stage.get("seconds") or 0) for stage in stages.values()), default=0) or 1.0
    rows = []
    for name, stage in stages.items():
        seconds = float(stage.get("seconds") or 0)
        rows.append(
            f'<tr><th scope="row">{escape(name)}</th>'
            f'<td class="number">{duration_text(seconds)}</td>'
            f'<td class="bar"><span style="width:{100 * seconds / longest:.1f}%"></span></td>'
            f'<td class="number">{bytes_text(stage.get("peak_memory_bytes") or 0)}</td></tr>'
        )
    return _table(("stage", "time", "", "peak memory"), rows)


def shares_table(rows: Sequence[tuple[str, float]]) -> str:
    """Names with shares in percent, and bars that are full where the share is one."""
    lines = [
        f'<tr><th scope="row">{escape(name)}</th><td class="number">{share_text(share)}</td>'
        f'<td class="bar"><span style="width:{100 * share:.1f}%"></span></td></tr>'
        for name, share in rows
    ]
    return _table(("", "", ""), lines)


def options_table(options: Any) -> str:
    """Every option by its full name, as `--set` takes it."""
    rows = [
        f'<tr><th scope="row"><code>{escape(name)}</code></th>'
        f"<td><code>{escape(_scalar(value))}</code></td></tr>"
        for name, value in _flat(to_jsonable(to_dict(options)), "")
    ]
    return _table(("option", "value"), rows)


def name_value_table(values: Mapping[str, Any]) -> str:
    """JSON-able values by name, what is empty left out."""
    rows = [
        f'<tr><th scope="row">{_words(name)}</th><td>{_value(value)}</td></tr>'
        for name, value in values.items()
        if value not in ({}, [], None)
    ]
    return _table(("", ""), rows) if rows else ""


def skipped_list(skipped: Mapping[str, Mapping[str, Any]]) -> str:
    """Reasons with their counts and the first line numbers, the most frequent first."""
    items = []
    for reason, one in sorted(skipped.items(), key=lambda item: -int(item[1]["count"])):
        lines, count = one["lines"], int(one["count"])
        shown = ", ".join(str(line) for line in lines[:_MOST_ITEMS])
        more = count - min(len(lines), _MOST_ITEMS)
        rest = f" and {more:,} more, see run.json" if more and lines else ""
        where = f": line{'s' if count > 1 else ''} {shown}{rest}" if lines else ""
        times = "once" if count == 1 else f"{count:,} times"
        items.append(f"<li>{escape(reason)}, {times}{where}</li>")
    return f"<ul>{''.join(items)}</ul>"


def _table(names: Sequence[str], rows: Sequence[str]) -> str:
    # the first column names the row; numbers stand to the right
    head = "".join(
        f'<th scope="col"{" class=number" if i and "number" in rows[0] else ""}>{escape(name)}</th>'
        for i, name in enumerate(names)
    )
    thead = f"<thead><tr>{head}</tr></thead>" if any(names) else ""
    return f'<div class="wide"><table>{thead}<tbody>{"".join(rows)}</tbody></table></div>'


def _flat(values: Mapping[str, Any], prefix: str) -> list[tuple[str, Any]]:
    rows: list[tuple[str, Any]] = []
    for name, value in values.items():
        if isinstance(value, Mapping):
            rows.extend(_flat(value, f"{prefix}{name}."))
        else:
            rows.append((f"{prefix}{name}", value))
    return rows


def _scalar(value: Any) -> str:
    if value is None:
        return "not set"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.7g}" if isinstance(value, float) else str(value)


def _value(value: Any) -> str:
    """A JSON-able value as HTML: a list for lists and for what has names inside."""
    if isinstance(value, Mapping):
        lines = [f"{_words(name)}: {_value(inner)}" for name, inner in value.items()]
    elif isinstance(value, list) and not all(isinstance(v, int | float) for v in value):
        lines = [_value(item) for item in value]
    else:
        return _line(value)
    more = len(lines) - _MOST_ITEMS
    if more > 0:
        lines = [*lines[:_MOST_ITEMS], f"and {more:,} more, see <code>run.json</code>"]
    return "<ul>" + "".join(f"<li>{line}</li>" for line in lines) + "</ul>"


def _words(name: str) -> str:
    return escape(name.replace("_", " "))


def _line(value: Any) -> str:
    if isinstance(value, list):
        shown = ", ".join(_line(v) for v in value[:_MOST_ITEMS])
        return shown + (", …" if len(value) > _MOST_ITEMS else "")
    text = _scalar(value)
    return escape(text if len(text) <= 500 else text[:500] + "…")


_FEW = 100  # beams on moving things, of which less can be said than the bars would claim


def learned_section(result: Result) -> str:
    """Shares, scatter and dwell times in plain words; empty where nothing was learned."""
    learned = result.learned
    if not learned:
        return ""
    tables = [
        _bars(
            "Share of the looks, or of the views, that meet standing things",
            learned["static_occupied"],
            _percent,
        )
    ]
    moving = count_beams(result.recording, result.p_static)["dynamic"]
    if moving < _FEW:
        note = f"Only {moving:,} beams met something moving: too few to say how long it stays."
    else:
        note = (
            "Where things move, places fill and empty again; for how long and how often was "
            "learned along with the map."
        )
        stays = _bars(
            "Moving things stay in one place for", learned["mover_seconds"], duration_text
        )
        fill = _bars(
            "Share of the time that their places are taken", learned["mover_occupied"], _percent
        )
        tables = [stays, fill, *tables]
    return (
        f"<section><h2>What was learned</h2><p>{escape(_static_sentence(learned))}"
        f"{escape(_changing_sentence(result))}</p>"
        f"<p>{note} What never leaves while the robot looks is taken for standing still.</p>"
        f'<div class="row">{"".join(tables)}</div>'
        '<p class="soft">Each bar: share of the cells that hold such things, put down to the '
        "most fitting of a few steps.</p></section>"
    )


def _static_sentence(learned: Mapping[str, Any]) -> str:
    share, scatter = float(learned["p_static"]), float(learned["scatter"])
    text = (
        f"Of the cells in which beams ended, {share_text(share)} hold something that stands still."
    )
    if scatter > 0.0:
        text += (
            f" End points scatter by {100 * scatter:.2g}\u00a0cm across flat surfaces: "
            "errors of range and pose taken together."
        )
    return text


def _changing_sentence(result: Result) -> str:
    """In space what came to stay, or left, is dynamic; in the plane it is listed."""
    if result.recording.dimension == 2 or "changing" not in result.learned:
        return ""
    share = share_text(float(result.learned["changing"]))
    return f" In {share} of them something came to stay or left, which counts as moving."


def _bars(title: str, table: Sequence[Mapping[str, float]], text: Callable[[float], str]) -> str:
    """A learned table of values and their shares; the outer values stand for all beyond them."""
    rows = sorted((float(row["value"]), float(row["share"])) for row in table)
    lowest, highest = rows[0][0], rows[-1][0]
    ends = {lowest: " or less", highest: " or more"} if lowest < highest else {}
    named = [(f"{text(value)}{ends.get(value, '')}", share) for value, share in rows]
    return f"<figure><figcaption>{escape(title)}</figcaption>{shares_table(named)}</figure>"


def _percent(value: float) -> str:
    return f"{100 * value:.3g} %"
