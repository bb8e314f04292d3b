"""The report's maps: raw beside filtered (Figs. 4, 6, 7), and how a part evolved (Fig. 8)."""

import math
from collections.abc import Sequence
from html import escape

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap import se2
from stillmap.output.crops import Snapshot, Window
from stillmap.output.known import known_area
from stillmap.output.points import dynamic_points
from stillmap.output.protocols import ResultLike
from stillmap.output.report_figures import (
    dots_image,
    map_image,
    pixel_positions,
    png_uri,
    shown_window,
    snapshot_image,
    thin_image,
)
from stillmap.output.report_tables import share_text

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


def maps_section(result: ResultLike) -> str:
    """The raw map beside the filtered one."""
    if not result.map.p_occupied.size:
        return "<section><h2>The map</h2><p>It is empty: no beam could be used.</p></section>"
    window = shown_window([result.raw_map, result.map])
    raw, filtered = map_image(result.raw_map, window), map_image(result.map, window)
    dots = dots_image(
        dynamic_points(result.seen, result.poses, result.p_static)[:, :2],
        window,
        filtered.size,
    )
    veil = thin_image(result.map, result.evidence.thin, window)
    path = _path(
        se2.planar(result.poses) if result.recording.dimension == 3 else result.poses,
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


def evidence_sentence(result: ResultLike) -> str:
    """How much of the known map few looks saw, or only while something moved there."""
    area, evidence = known_area(result), result.evidence
    if not area["thin"]:
        return "No place that is known rests on thin evidence."
    share = share_text(area["thin"] / area["known"])
    return (
        f"{area['thin']:,.1f} m² of the filtered map, {share} of what is known, rest on thin "
        f"evidence: fewer than {evidence.least} looks saw these places while nothing that moves "
        f"was within {evidence.near:g} m of them."
    )


_LATER = " What is taken for dynamic in the end, after one more E-step, is in the map above."


def evolution_section(result: ResultLike) -> str:
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
        [(snapshot_image(snapshot), "")],
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
    positions = pixel_positions(poses[::every, :2, -1], window, size)
    points = " ".join(f"{x:.1f},{y:.1f}" for x, y in positions.tolist())
    return (
        f'<svg class="path" aria-hidden="true" viewBox="0 0 {size[0]} {size[1]}" '
        f'preserveAspectRatio="none"><polyline points="{points}"/></svg>'
    )
