"""The report's part on what moved: ways over the map, how often squares were crossed, a table.

The report's part on a second laser that builds in 3D: what was cut out of its points.
"""

from collections.abc import Mapping, Sequence
from html import escape
from typing import Any

import numpy as np
from PIL import Image

from stillmap.mapping.beam_statistics import sample_dynamic_points
from stillmap.pipeline.result import Result
from stillmap.pipeline.snapshots import Window
from stillmap.results.report.figures import draw_map, draw_points, map_to_pixels, map_window
from stillmap.results.report.maps import figure
from stillmap.results.report.tables import duration_text, share_text
from stillmap.results.rig import tilting_record
from stillmap.rig.build import TiltingResult
from stillmap.tracking import FlowMap, MovingObject

_MOST_WAYS, _MOST_ROWS = 500, 25

_COLOURS = 64

# from a square that was crossed once to the one that was crossed most
_PALE, _DARK = np.array([255.0, 226.0, 178.0]), np.array([150.0, 20.0, 10.0])

_WALL = 90  # shades of grey up to which a pixel is a wall, and stays one


def objects_section(result: Result) -> str:
    """Everything about what moved; empty where it was not asked for."""
    if not result.options.objects.enabled or not result.map.p_occupied.size:
        return ""
    objects = result.objects
    if not objects:
        return "<section><h2>What moved</h2><p>Nothing that could be followed.</p></section>"
    window = map_window([result.map])
    picture = draw_map(result.map, window)
    reduced = picture.size[0] < round((window[2] - window[0]) / result.map.resolution)
    ways, traffic = _ways(objects, window, picture.size), result.traffic
    most = f"the squares of {traffic.resolution:g} m crossed {int(traffic.crossings.max())} times "
    return (
        f"<section><h2>What moved</h2><p>{escape(_summary(objects))}</p>"
        '<div class="pair">'
        + figure("Ways", _ways_caption(objects), [(picture, "")], ways, window, reduced)
        + figure(
            "FlowMap",
            f"how often it was crossed: dark, {most}at most",
            [(draw_traffic(traffic, picture, window), "")],
            "",
            window,
            reduced,
        )
        + f"</div><details><summary>Those that were seen for longest</summary>{_table(objects)}"
        "</details></section>"
    )


def draw_traffic(traffic: FlowMap, picture: Image.Image, window: Window) -> Image.Image:
    """Squares that were crossed, laid over the picture of the map in the same window."""
    image = np.array(picture.convert("RGB"))
    height, width = image.shape[:2]
    x0, y0, x1, y1 = window
    x = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width
    y = y1 - (np.arange(height) + 0.5) * (y1 - y0) / height
    around = np.pad(traffic.crossings, 1)  # nothing crossed what lies outside
    column = np.floor((x - traffic.origin[0]) / traffic.resolution).astype(np.int64) + 1
    row = np.floor((y - traffic.origin[1]) / traffic.resolution).astype(np.int64) + 1
    row, column = row.clip(0, around.shape[0] - 1), column.clip(0, around.shape[1] - 1)
    crossings = around[row[:, None], column]
    shown = (crossings > 0) & (image.min(axis=2) > _WALL)
    # the second crossing says more than the twentieth
    share = np.log1p(crossings[shown]) / np.log1p(max(int(traffic.crossings.max()), 1))
    image[shown] = (_PALE + share[:, None] * (_DARK - _PALE)).astype(np.uint8)
    return Image.fromarray(image).quantize(_COLOURS)


def _seconds(one: MovingObject) -> float:
    return 1e-9 * float(one.stamp_ns[-1] - one.stamp_ns[0])


def _speed(one: MovingObject) -> float:
    return float(np.median(np.linalg.norm(one.velocity, axis=1)))


def _summary(objects: Sequence[MovingObject]) -> str:
    beams = sum(len(one.beams) for one in objects)
    seconds = float(np.median([_seconds(one) for one in objects]))
    things = f"{len(objects):,} things that moved were" if len(objects) > 1 else "One thing was"
    return (
        f"{things} followed, with {beams:,} beams on them; half of them for more than "
        f"{duration_text(seconds)}, and half faster than "
        f"{float(np.median([_speed(one) for one in objects])):.2f} m/s."
    )


def _longest(objects: Sequence[MovingObject], most: int) -> list[MovingObject]:
    return sorted(objects, key=_seconds, reverse=True)[:most]


def _ways_caption(objects: Sequence[MovingObject]) -> str:
    if len(objects) <= _MOST_WAYS:
        return "where each of them went"
    return f"where the {_MOST_WAYS} of them went that were seen for longest"


def _ways(objects: Sequence[MovingObject], window: Window, size: tuple[int, int]) -> str:
    """Lines over a map picture of `size` pixels."""
    lines = ""
    for one in _longest(objects, _MOST_WAYS):
        positions = map_to_pixels(one.xy, window, size)
        points = " ".join(f"{x:.1f},{y:.1f}" for x, y in positions.tolist())
        lines += f'<polyline points="{points}"/>'
    return (
        f'<svg class="ways" aria-hidden="true" viewBox="0 0 {size[0]} {size[1]}" '
        f'preserveAspectRatio="none">{lines}</svg>'
    )


def _table(objects: Sequence[MovingObject]) -> str:
    rows = ""
    for one in _longest(objects, _MOST_ROWS):
        cells = (
            f"{_seconds(one):.1f}",
            f"{len(one.scan):,}",
            f"{len(one.beams):,}",
            f"{_speed(one):.2f}",
            f"{one.size[0]:.2f} x {one.size[1]:.2f}",
            f"{one.p_dynamic:.2f}",
        )
        rows += f"<tr><th>{one.id}</th>"
        rows += "".join(f'<td class="number">{cell}</td>' for cell in cells) + "</tr>"
    titles = ("seen for, s", "scans", "beams", "speed, m/s", "size, m", "P(dynamic)")
    head = "".join(f'<th class="number">{title}</th>' for title in titles)
    return (
        f'<div class="wide"><table><thead><tr><th>number</th>{head}</tr></thead>'
        f"<tbody>{rows}</tbody></table></div>"
    )


def tilting_section(result: Result, tilting: TiltingResult | None) -> str:
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


def _where(result: Result, tilting: TiltingResult) -> str:
    if not result.map.p_occupied.size:
        return ""
    window = map_window([result.map])
    picture = draw_map(result.map, window)
    ends = sample_dynamic_points(tilting.seen, tilting.poses, tilting.p_static)[:, :2]
    reduced = picture.size[0] < round((window[2] - window[0]) / result.map.resolution)
    layers = [(picture, ""), (draw_points(ends, window, picture.size), "")]
    caption = "from above, in orange, on the flat laser's map"
    return '<div class="row">' + figure("Cut out", caption, layers, "", window, reduced) + "</div>"
