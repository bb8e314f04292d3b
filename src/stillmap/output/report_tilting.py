"""The report's part on a second laser that builds in 3D: what was cut out of its points."""

from collections.abc import Mapping
from html import escape
from typing import Any

from stillmap.output.points import dynamic_points
from stillmap.output.protocols import ResultLike, TiltingLike
from stillmap.output.report_figures import dots_image, map_image, shown_window
from stillmap.output.report_maps import figure
from stillmap.output.report_tables import share_text
from stillmap.output.tilting import tilting_record


def tilting_section(result: ResultLike, tilting: TiltingLike | None) -> str:
    """How much was cut out and by what, and where; empty where there is no such laser."""
    if tilting is None:
        return ""
    text = escape(cut_sentences(tilting_record(tilting)))
    picture = _where(result, tilting)
    return f"<section><h2>What the second laser built</h2><p>{text}</p>{picture}</section>"


def cut_sentences(record: Mapping[str, Any]) -> str:
    """What `tilting` in `run.json` says, in words."""
    counts, dynamic = record["counts"], record["dynamic"]
    share = share_text(dynamic / max(counts["hits"], 1))
    boxes = f"{record['boxes']:,} boxes around what the flat laser saw to move"
    evidence = " and by what it saw itself to come and go" if record["learned"] else ""
    said = (
        f"Of {counts['beams']:,} beams {counts['hits']:,} hit something; {dynamic:,} of these, "
        f"{share}, are dynamic. They are in dynamic.ply, cut out of static.ply by {boxes}"
        f"{evidence}. {record['objects']:,} of the things that moved have points in 3D."
    )
    if counts["left_out"]:
        said += (
            f" {counts['left_out']:,} beams were left out: nobody knows where the robot was then."
        )
    return said


def _where(result: ResultLike, tilting: TiltingLike) -> str:
    if not result.map.p_occupied.size:
        return ""
    window = shown_window([result.map])
    picture = map_image(result.map, window)
    ends = dynamic_points(tilting.seen, tilting.poses, tilting.p_static)[:, :2]
    reduced = picture.size[0] < round((window[2] - window[0]) / result.map.resolution)
    layers = [(picture, ""), (dots_image(ends, window, picture.size), "")]
    caption = "from above, in orange, on the flat laser's map"
    return '<div class="row">' + figure("Cut out", caption, layers, "", window, reduced) + "</div>"
