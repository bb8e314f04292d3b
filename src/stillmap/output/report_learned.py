"""The report's words and bars on what an estimator learned from the recording."""

from collections.abc import Callable, Mapping, Sequence
from html import escape
from typing import Any

from stillmap.output.points import beam_counts
from stillmap.output.protocols import ResultLike
from stillmap.output.report_tables import duration_text, share_text, shares_table

_FEW = 100  # beams on moving things, of which less can be said than the bars would claim


def learned_section(result: ResultLike) -> str:
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
    moving = beam_counts(result.recording, result.p_static)["dynamic"]
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


def _changing_sentence(result: ResultLike) -> str:
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
