"""Maps of the report: as written, raw beside clean, over the iterations, and changed places."""

import math
from collections import Counter
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.grid_map import GridMap
from stillmap.mapping import Change
from stillmap.mapping.beam_statistics import sample_dynamic_points
from stillmap.pipeline.options import MapMode
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.snapshots import Snapshot, Window, extent
from stillmap.results.map_server import CHANGED, changed_cells, trinary_pixels
from stillmap.results.report.figures import (
    UNKNOWN_LEVEL,
    MapView,
    color_by_index,
    count_in_squares,
    data_uri,
    draw_map,
    draw_points,
    draw_snapshot,
    draw_thinly_observed,
    iter_strips,
    reduce_levels,
    reduce_squares,
)
from stillmap.results.run_json import known_area

FREE, OCCUPIED, UNKNOWN = 254, 0, 205  # pixels of map.pgm
_MAX_EDGE = 4096  # pixels; a trinary map of that size takes a few hundred kB as PNG
# of occupancy in percent as `--map-mode scale` writes it, and of unknown cells
_PERCENT_GREYS = [round(255 * (1 - percent / 100)) for percent in range(UNKNOWN_LEVEL)] + [UNKNOWN]
_MAX_PATH_POINTS = 3000
_MAX_ROWS = 50
_COLORS = {
    "came": (20, 120, 60),
    "left": (190, 40, 120),
    "comes and goes": (40, 90, 200),
    "door": (200, 120, 20),
}


class WrittenMap(NamedTuple):
    """The picture of a whole map.

    Attributes:
        picture: one pixel per cell, or per square of `factor` x `factor` cells from the lower left.
        window: x0, y0, x1, y1 of the picture in m, in the map frame.
        factor: cells along the edge of a pixel.
    """

    picture: Image.Image
    window: Window
    factor: int


def draw_written_map(occupancy: GridMap, mode: MapMode) -> WrittenMap:
    """Draw the cells as the map file of that mode has them, at most `_MAX_EDGE` pixels a side.

    Where cells share a pixel, it is occupied if any of them is, so that thin walls stay.
    """
    height, width = occupancy.p_occupied.shape
    factor = max(1, math.ceil(max(height, width) / _MAX_EDGE))
    strips = iter_strips(occupancy, occupancy.p_occupied, extent(occupancy), np.nan, factor)
    reduce = _reduce_states if mode == "trinary" else reduce_levels
    pixels = np.concatenate([reduce(cells, factor) for cells in strips])[::-1]
    x0, y0, _, _ = extent(occupancy)
    edge = factor * occupancy.resolution
    window = (x0, y0, x0 + pixels.shape[1] * edge, y0 + pixels.shape[0] * edge)
    greys = (OCCUPIED, UNKNOWN, FREE) if mode == "trinary" else _PERCENT_GREYS
    return WrittenMap(color_by_index(pixels, ((grey,) * 3 for grey in greys)), window, factor)


def _reduce_states(p_occupied: NDArray[np.float32], factor: int) -> NDArray[np.uint8]:
    """0: a cell of the square is occupied, 2: at least half of its known cells are free, else 1."""
    states = trinary_pixels(p_occupied)
    occupied, free = states == OCCUPIED, states == FREE
    if factor > 1:
        n_free, n_known = (
            count_in_squares(cells, factor) for cells in (free, ~np.isnan(p_occupied))
        )
        occupied = count_in_squares(occupied, factor) > 0
        free = (n_free > 0) & (2 * n_free >= n_known)
    return np.where(occupied, 0, np.where(free, 2, 1)).astype(np.uint8)


class MapFigure(NamedTuple):
    """The filtered map as several sections show it: its view, picture and `data:` URI."""

    view: MapView
    picture: Image.Image
    uri: str


def draw_filtered_map(result: MappingResult) -> MapFigure | None:
    """The filtered map in the window that also holds the raw one; None for a map without cells."""
    if not result.map.p_occupied.size:
        return None
    view = MapView.of([result.raw_map, result.map])
    picture = draw_map(result.map, view.window)
    return MapFigure(view, picture, data_uri(picture))


def map_data(result: MappingResult, filtered: MapFigure | None) -> dict[str, Any] | None:
    """The map as written, and the raw one beside the filtered one (Figs. 4, 6, 7).

    None for a map without cells.
    """
    if filtered is None:
        return None
    view = filtered.view
    ends = sample_dynamic_points(result.deskewed, result.poses, result.p_static)[:, :2]
    every = max(1, math.ceil(len(result.poses) / _MAX_PATH_POINTS))
    area = known_area(result)
    return {
        **written_map_data(result.map, result.options.output.map_mode, view),
        "raw": data_uri(draw_map(result.raw_map, view.window)),
        "filtered": filtered.uri,
        "dynamic": data_uri(draw_points(ends, view)),
        "thinly_observed": data_uri(
            draw_thinly_observed(result.map, result.evidence.thinly_observed, view.window)
        ),
        "path": view.svg_points(result.poses[::every, :2, -1]),
        "known_area": area["known"],
        "thinly_observed_area": area["thin"],
        "min_observations": result.evidence.min_observations,
        "radius": result.evidence.mover_radius,
    }


def written_map_data(occupancy: GridMap, mode: MapMode, view: MapView) -> dict[str, Any]:
    """A map, its picture as written placed in percent of a view, and the bounds of both in m."""
    written = draw_written_map(occupancy, mode)
    (x0, y0, x1, y1), (left, bottom, right, top) = view.window, written.window
    width, height = x1 - x0, y1 - y0
    return {
        "view": view,
        "meters": tuple(n * occupancy.resolution for n in occupancy.p_occupied.shape[::-1]),
        "cell": occupancy.resolution,
        "written": {
            "image": data_uri(written.picture, optimize=True),
            "size": written.picture.size,
            "factor": written.factor,
            "place": {
                "left": 100 * (left - x0) / width,
                "bottom": 100 * (bottom - y0) / height,
                "width": 100 * (right - left) / width,
                "height": 100 * (top - bottom) / height,
            },
            "bounds": (min(x0, left), min(y0, bottom), max(x1, right), max(y1, top)),
        },
    }


def changes_data(result: MappingResult, filtered: MapFigure | None) -> dict[str, Any] | None:
    """Changed places on the map and in a table; None where there are none."""
    if not result.changes or filtered is None:
        return None
    view = filtered.view
    largest = sorted(range(len(result.changes)), key=lambda k: -len(result.changes[k].cells))
    listed = [result.changes[k] for k in sorted(largest[:_MAX_ROWS])]
    corners = np.array([(one.x + one.size[0] / 2, one.y) for one in listed])
    counts = Counter[str](one.kind for one in result.changes)
    return {
        "view": view,
        "map": filtered.uri,
        "marks": data_uri(draw_changes(result, view)),
        "numbers": view.to_pixels(corners).tolist(),
        "colors": _COLORS,
        "counts": [(kind, counts[kind]) for kind in CHANGED if counts[kind]],
        "total": len(result.changes),
        "listed": [_change_row(one, int(result.recording.stamp_ns[0])) for one in listed],
    }


def _change_row(change: Change, start_ns: int) -> dict[str, Any]:
    center = (change.x, change.y) if change.z is None else (change.x, change.y, change.z)
    return {
        "kind": change.kind,
        "center": ", ".join(f"{v:.2f}" for v in center),
        "size": " x ".join(f"{v:.2f}" for v in change.size),
        "cells": len(change.cells),
        "before_ns": change.before_ns - start_ns,
        "after_ns": change.stamp_ns - start_ns,
        "times": change.times,
    }


def draw_changes(result: MappingResult, view: MapView) -> Image.Image:
    """The changed cells in the colors of their kinds, transparent elsewhere."""
    codes: Any = changed_cells(result.map, result.changes)  # may be tiled
    strips = [
        reduce_squares(np.maximum, cells, view.factor)
        for cells in iter_strips(result.map, codes, view.window, 0, view.factor)
    ]
    colors = ((255, 255, 255), *(_COLORS[kind] for kind in CHANGED))
    return color_by_index(np.concatenate(strips)[::-1], colors, 0)


def evolution_data(result: MappingResult) -> dict[str, Any] | None:
    """The part of the map with most dynamic returns over the iterations (Fig. 8)."""
    snapshots: Sequence[Snapshot] = result.snapshots
    if not snapshots or not snapshots[0].p_occupied.size:
        return None
    return {
        "meters": [n * snapshots[0].resolution for n in snapshots[0].p_occupied.shape[::-1]],
        "snapshots": [
            {
                "number": one.number,
                "dynamic": len(one.dynamic_points),
                "view": MapView(extent(one), (image := draw_snapshot(one)).size),
                "image": data_uri(image),
            }
            for one in snapshots
        ],
    }
