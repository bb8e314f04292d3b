"""The report's maps: raw beside filtered (Figs. 4, 6, 7), and how a part evolved (Fig. 8).

The report's part on places that changed: where they are, and when they did.
"""

import math
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core import se2
from stillmap.mapping import Change
from stillmap.mapping.beam_statistics import sample_dynamic_points
from stillmap.pipeline.result import Result
from stillmap.pipeline.snapshots import Snapshot, Window
from stillmap.results.map_npz import CHANGED, changed_cells, known_area
from stillmap.results.report.figures import (
    draw_map,
    draw_points,
    draw_poorly_observed,
    draw_snapshot,
    map_to_pixels,
    map_window,
    png_uri,
)
from stillmap.results.report.tables import share_text

_KEY = (
    '<p class="soft"><span class="key" style="margin-left:0;background:#fff"></span>free'
    '<span class="key" style="background:#bec4cc"></span>unknown'
    '<span class="key" style="background:#000"></span>occupied'
    '<span class="key" style="background:#f07800"></span>end of a beam that met something '
    'moving <span style="white-space:nowrap"><span class="key" style="background:#dbc2f4"></span>'
    "thin evidence</span></p>"
)

_TOGGLES = (
    '<input class="toggle" type="checkbox" id="show-dynamic" checked>'
    '<label for="show-dynamic">moving things</label>'
    '<input class="toggle" type="checkbox" id="show-thin" checked>'
    '<label for="show-thin">thin evidence</label>'
    '<input class="toggle" type="checkbox" id="show-path"><label for="show-path">trajectory</label>'
    '<input class="toggle" type="checkbox" id="large"><label for="large">large</label>'
)

_PATH_POINTS = 3000


def maps_section(result: Result) -> str:
    """The raw map beside the filtered one."""
    if not result.map.p_occupied.size:
        return "<section><h2>The map</h2><p>It is empty: no beam could be used.</p></section>"
    window = map_window([result.raw_map, result.map])
    raw, filtered = draw_map(result.raw_map, window), draw_map(result.map, window)
    dots = draw_points(
        sample_dynamic_points(result.seen, result.poses, result.p_static)[:, :2],
        window,
        filtered.size,
    )
    veil = draw_poorly_observed(result.map, result.evidence.thinly_observed, window)
    path = _path(
        se2.project_to_plane(result.poses) if result.recording.dimension == 3 else result.poses,
        window,
        filtered.size,
    )
    width, height = window[2] - window[0], window[3] - window[1]
    reduced = filtered.size[0] < round(width / result.map.resolution)
    size = f"{width:.0f} m by {height:.0f} m, cells of {100 * result.map.resolution:.3g} cm"
    return (
        f"<section><h2>The map</h2><p>{size}. {evidence_sentence(result)}</p>{_KEY}{_TOGGLES}"
        '<div class="pair">'
        + figure("Raw", "every beam counted in full", [(raw, "")], path, window, reduced)
        + figure(
            "Filtered",
            "what stands still; what moved in orange, what is hardly known in violet",
            [(filtered, ""), (veil, "thin"), (dots, "dynamic")],
            path,
            window,
            reduced,
        )
        + "</div></section>"
    )


def evidence_sentence(result: Result) -> str:
    """How much of the known map few looks saw, or only while something moved there."""
    area, evidence = known_area(result), result.evidence
    if not area["thin"]:
        return "No place that is known rests on thin evidence."
    share = share_text(area["thin"] / area["known"])
    return (
        f"{area['thin']:,.1f} m² of the filtered map, {share} of what is known, rest on thin "
        f"evidence: fewer than {evidence.min_observations} looks saw these places while nothing that moves "
        f"was within {evidence.mover_radius:g} m of them."
    )


_LATER = " What is taken for dynamic in the end, after one more E-step, is in the map above."


def evolution_section(result: Result) -> str:
    """The part of the map with most movement at the first, second, best and last iteration."""
    if not result.snapshots or not result.snapshots[0].p_occupied.size:
        return ""
    figures = "".join(_snapshot_figure(one, result.best_iteration) for one in result.snapshots)
    h, w = result.snapshots[0].p_occupied.shape
    step = result.snapshots[0].resolution
    title = "How the map evolved" if len(result.snapshots) > 1 else "Where most moved"
    later = _LATER if result.options.estimator == "stillmap" else ""
    return (
        f"<section><h2>{title}</h2>"
        f"<p>The {w * step:.0f} m by {h * step:.0f} m where most movement was seen; in orange "
        f"the ends of beams taken for dynamic at that iteration.{later}</p>"
        f'<div class="row">{figures}</div></section>'
    )


def _snapshot_figure(snapshot: Snapshot, best: int) -> str:
    h, w = snapshot.p_occupied.shape
    x, y, _ = snapshot.origin
    window = (x, y, x + w * snapshot.resolution, y + h * snapshot.resolution)
    kept = ", kept" if snapshot.number == best else ""
    return figure(
        f"Iteration {snapshot.number}{kept}",
        f"{len(snapshot.dynamic_points):,} dynamic ends",
        [(draw_snapshot(snapshot), "")],
        "",
        window,
        False,
    )


def figure(
    title: str,
    caption: str,
    layers: Sequence[tuple[Image.Image, str]],
    overlay: str,
    window: Window,
    reduced: bool,
) -> str:
    """A picture of a window: layers with their classes, and what lies over them."""
    width, height = layers[0][0].size
    images = ""
    for index, (image, kind) in enumerate(layers):
        # what a layer above the first shows is in the first one's caption
        alt = f"{title} map: {caption}" if index == 0 else ""
        classes = f"{kind} {'reduced' if reduced else ''}".strip()
        images += (
            f'<img class="{classes}" src="{png_uri(image)}" alt="{escape(alt)}" '
            f'width="{width}" height="{height}">'
        )
    return (
        f"<figure><figcaption><b>{escape(title)}</b>: {escape(caption)}</figcaption>"
        f'<div class="map" style="--ratio:{width / height:.5f}">{images}{overlay}'
        f"{_scale_bar(window)}</div></figure>"
    )


def _scale_bar(window: Window) -> str:
    width = window[2] - window[0]
    power = 10.0 ** math.floor(math.log10(width / 4))
    length = max(step * power for step in (1, 2, 5) if step * power <= width / 4)
    return f'<span class="scale" style="width:{100 * length / width:.3f}%">{length:g}&nbsp;m</span>'


def _path(poses: NDArray[np.float64], window: Window, size: tuple[int, int]) -> str:
    """The trajectory as a line over a map picture of `size` pixels."""
    every = max(1, math.ceil(len(poses) / _PATH_POINTS))
    positions = map_to_pixels(poses[::every, :2, -1], window, size)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in positions.tolist())
    return (
        f'<svg class="path" aria-hidden="true" viewBox="0 0 {size[0]} {size[1]}" '
        f'preserveAspectRatio="none"><polyline points="{points}"/></svg>'
    )


_MOST_ROWS = 50

_COLOURS = {"came": (20, 120, 60), "left": (190, 40, 120), "comes and goes": (40, 90, 200)}

_TITLES = ("middle, m", "size, m", "cells", "was as before until", "seen otherwise from", "times")


def changes_section(result: Result) -> str:
    """Everything about places that changed; empty where none was found."""
    if not result.changes or not result.map.p_occupied.size:
        return ""
    window = map_window([result.raw_map, result.map])
    picture = draw_map(result.map, window)
    reduced = picture.size[0] < round((window[2] - window[0]) / result.map.resolution)
    marks = _marks(result, window, picture.size)
    listed = _most(result.changes)
    rest = len(result.changes) - len(listed)
    return (
        f"<section><h2>What changed</h2><p>{escape(_summary(result.changes))} {_shown(result)}</p>"
        f"{_key()}"
        + figure(
            "Changes",
            "numbers as in the table",
            [(picture, ""), (marks, "")],
            _numbers(listed, window, picture.size),
            window,
            reduced,
        )
        + _table(listed, int(result.recording.stamp_ns[0]))
        + (f'<p class="soft">{rest} smaller ones are in run.json.</p>' if rest else "")
        + "</section>"
    )


def _shown(result: Result) -> str:
    """What the map has of them."""
    if result.recording.dimension == 3:
        return "The map shows their places as the labels of single voxels have it."
    last = result.options.output.map_state == "last"
    shown = "as it was last seen" if last else "as it was most"
    unless = "" if last else ", unless it was there for most of the time"
    return f"The map shows each {shown}; what comes and goes it shows free{unless}."


def _most(changes: Sequence[Change]) -> list[Change]:
    """The largest ones, in their order."""
    largest = sorted(range(len(changes)), key=lambda k: -len(changes[k].cells))[:_MOST_ROWS]
    return [changes[k] for k in sorted(largest)]


def _summary(changes: Sequence[Change]) -> str:
    kinds = [one.kind for one in changes]
    parts = [
        f"{count} where something {kind}" for kind in CHANGED if (count := kinds.count(kind)) > 0
    ]
    plural = "s" if len(changes) > 1 else ""
    return f"{len(changes)} place{plural} changed: {', '.join(parts)}."


def _key() -> str:
    keys = "".join(
        f'<span class="key" style="background:rgb{colour}"></span>{escape(kind)}'
        for kind, colour in _COLOURS.items()
    )
    return f'<p class="soft">{keys}</p>'


def _marks(result: Result, window: Window, size: tuple[int, int]) -> Image.Image:
    """The cells of all changes in their colours, on nothing, to lie over the map's picture."""
    width, height = size
    pixels = np.zeros((height, width), np.uint8)
    changed = changed_cells(result.map, result.changes)
    row, column = np.nonzero(changed)
    cell = result.map.resolution
    low = np.stack([column, row], axis=1) * cell + np.array(result.map.origin[:2])
    left, bottom = map_to_pixels(low, window, size).T
    right, top = map_to_pixels(low + cell, window, size).T
    # a cell may be several pixels or a part of one
    steps = max(1, round(width * cell / (window[2] - window[0])))
    for k in range(steps):
        for m in range(steps):
            x = np.floor(left + (k + 0.5) / steps * (right - left)).astype(np.int64)
            y = np.floor(top + (m + 0.5) / steps * (bottom - top)).astype(np.int64)
            inside = (x >= 0) & (y >= 0) & (x < width) & (y < height)
            pixels[y[inside], x[inside]] = changed[row[inside], column[inside]]
    image = Image.fromarray(pixels)
    image.putpalette([255, 255, 255, *(v for kind in CHANGED for v in _COLOURS[kind])])
    image.info["transparency"] = 0
    return image


def _numbers(changes: Sequence[Change], window: Window, size: tuple[int, int]) -> str:
    """The number of each change beside its place."""
    at = np.array([(one.x + one.size[0] / 2, one.y) for one in changes])
    positions = map_to_pixels(at, window, size)
    height = max(size) / 60
    texts = "".join(
        f'<text x="{x + height / 4:.1f}" y="{y:.1f}">{k}</text>'
        for k, (x, y) in enumerate(positions.tolist(), 1)
    )
    return (
        f'<svg class="numbers" aria-hidden="true" viewBox="0 0 {size[0]} {size[1]}" '
        f'font-size="{height:.1f}" preserveAspectRatio="none">{texts}</svg>'
    )


def _table(changes: Sequence[Change], start: int) -> str:
    rows = ""
    for k, one in enumerate(changes, 1):
        cells = (
            f"{one.x:.2f}, {one.y:.2f}" + ("" if one.z is None else f", {one.z:.2f}"),
            " x ".join(f"{metres:.2f}" for metres in one.size),
            f"{len(one.cells):,}",
            _clock(one.before_ns - start),
            _clock(one.stamp_ns - start),
            f"{one.times}",
        )
        rows += f"<tr><th>{k}</th><td>{escape(one.kind)}</td>"
        rows += "".join(f'<td class="number">{cell}</td>' for cell in cells) + "</tr>"
    head = "".join(f'<th class="number">{title}</th>' for title in _TITLES)
    return (
        '<div class="wide"><table><thead><tr><th>number</th><th>what</th>'
        f"{head}</tr></thead><tbody>{rows}</tbody></table></div>"
        '<p class="soft">Hours, minutes and seconds since the first scan.</p>'
    )


def _clock(ns: int) -> str:
    tenths = round(ns / 10**8)
    return f"{tenths // 36000}:{tenths // 600 % 60:02}:{tenths % 600 / 10:04.1f}"
