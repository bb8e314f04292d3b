"""Maps of the report: as written, raw beside clean, what changed and moved, the iterations."""

import math
from collections import Counter
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.array_types import Float32
from stillmap.core.grid_map import GridMap
from stillmap.mapping.labelled_recording import sample_points
from stillmap.pipeline.options import MapMode
from stillmap.pipeline.result import MappingResult
from stillmap.pipeline.snapshots import Snapshot, Window, extent
from stillmap.pipeline.tilting import TiltingResult
from stillmap.results.map_server import CHANGED, changed_cells, trinary_pixels
from stillmap.results.report import figures
from stillmap.results.report.figures import MapView, data_uri
from stillmap.results.run_json import known_area, thin_area
from stillmap.tracking import FlowMap
from stillmap.tracking.objects import mean_speed, track_length

FREE, OCCUPIED, UNKNOWN = 254, 0, 205  # pixels of map.pgm
_MAX_EDGE = 4096  # pixels; a trinary map of that size takes a few hundred kB as PNG
# of occupancy in percent as `--map-mode scale` writes it, and of unknown cells
_PERCENTS = range(figures.UNKNOWN_LEVEL)
_PERCENT_GREYS = [*(round(255 * (1 - percent / 100)) for percent in _PERCENTS), UNKNOWN]
_MAX_PATH_POINTS = 3000
_MAX_ROWS, _MAX_TRACKS, _MAX_OBJECTS = 50, 500, 25  # shown of changes, tracks, rows of objects
_TRAFFIC_COLORS = 64
# of cells crossed once, and of those crossed most often
_PALE, _DARK = np.array([255.0, 226.0, 178.0]), np.array([150.0, 20.0, 10.0])
_WALL = 90  # grey level up to which a pixel stays visible as a wall
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
    strips = figures.iter_strips(occupancy, occupancy.p_occupied, extent(occupancy), np.nan, factor)
    reduce = _reduce_states if mode == "trinary" else figures.reduce_levels
    pixels = np.concatenate([reduce(cells, factor) for cells in strips])[::-1]
    x0, y0, _, _ = extent(occupancy)
    edge = factor * occupancy.resolution
    window = (x0, y0, x0 + pixels.shape[1] * edge, y0 + pixels.shape[0] * edge)
    greys = (OCCUPIED, UNKNOWN, FREE) if mode == "trinary" else _PERCENT_GREYS
    picture = figures.color_by_index(pixels, ((grey,) * 3 for grey in greys))
    return WrittenMap(picture, window, factor)


def _reduce_states(p_occupied: Float32, factor: int) -> NDArray[np.uint8]:
    """0: a cell of the square is occupied, 2: at least half of its known cells are free, else 1."""
    states = trinary_pixels(p_occupied)
    occupied, free = states == OCCUPIED, states == FREE
    if factor > 1:
        masks = (free, ~np.isnan(p_occupied))
        n_free, n_known = (figures.count_in_squares(cells, factor) for cells in masks)
        occupied = figures.count_in_squares(occupied, factor) > 0
        free = (n_free > 0) & (2 * n_free >= n_known)
    return np.where(occupied, 0, np.where(free, 2, 1)).astype(np.uint8)


def draw_filtered_map(result: MappingResult) -> tuple[MapView, Image.Image] | None:
    """The filtered map in the view that also holds the raw one; None for a map without cells."""
    if not result.map.p_occupied.size:
        return None
    view = MapView.of([result.raw_map, result.map])
    return view, figures.draw_map(result.map, view.window)


def map_data(result: MappingResult, view: MapView, filtered: Image.Image) -> dict[str, Any]:
    """The map as written, and the raw one beside the filtered one (Figs. 4, 6, 7)."""
    thin = result.evidence.thinly_observed
    every = max(1, math.ceil(len(result.poses) / _MAX_PATH_POINTS))
    return {
        **written_map_data(result.map, result.options.output.map_mode, view),
        "raw": data_uri(figures.draw_map(result.raw_map, view.window)),
        "filtered": data_uri(filtered),
        "dynamic": draw_dynamic(result, view),
        "thinly_observed": data_uri(figures.draw_thinly_observed(result.map, thin, view.window)),
        "path": view.svg_points(result.poses[::every, :2, -1]),
        "known_area": known_area(result.map),
        "thinly_observed_area": thin_area(result),
        "min_observations": result.evidence.min_observations,
        "radius": result.evidence.mover_radius,
    }


def draw_dynamic(result: MappingResult | TiltingResult, view: MapView) -> str:
    """`data:` URI of the dynamic returns as a layer over the map."""
    ends = sample_points(result.deskewed, result.poses, result.p_static)[:, :2]
    return data_uri(figures.draw_points(ends, view))


def written_map_data(occupancy: GridMap, mode: MapMode, view: MapView) -> dict[str, Any]:
    """A map, its picture as written, and the view of what lies over it."""
    written = draw_written_map(occupancy, mode)
    return {
        "view": view,
        "meters": tuple(n * occupancy.resolution for n in occupancy.p_occupied.shape[::-1]),
        "cell": occupancy.resolution,
        "written": written,
        "image": data_uri(written.picture, optimize=True),
    }


def changes_data(result: MappingResult, view: MapView) -> dict[str, Any] | None:
    """Changed places on the map and for a table; None where there are none."""
    if not result.changes:
        return None
    largest = sorted(range(len(result.changes)), key=lambda k: -len(result.changes[k].cells))
    listed = [result.changes[k] for k in sorted(largest[:_MAX_ROWS])]
    corners = np.array([(one.x + one.size[0] / 2, one.y) for one in listed])
    counts = Counter[str](one.kind for one in result.changes)
    return {
        "marks": data_uri(draw_changes(result, view)),
        "numbers": view.to_pixels(corners).tolist(),
        "colors": _COLORS,
        "counts": [(kind, counts[kind]) for kind in CHANGED if counts[kind]],
        "listed": listed,
    }


def draw_changes(result: MappingResult, view: MapView) -> Image.Image:
    """The changed cells in the colors of their kinds, transparent elsewhere."""
    codes: Any = changed_cells(result.map, result.changes)  # may be tiled
    strips = [
        figures.reduce_squares(np.maximum, cells, view.factor)
        for cells in figures.iter_strips(result.map, codes, view.window, 0, view.factor)
    ]
    colors = ((255, 255, 255), *(_COLORS[kind] for kind in CHANGED))
    return figures.color_by_index(np.concatenate(strips)[::-1], colors, 0)


def objects_data(
    result: MappingResult, view: MapView, filtered: Image.Image
) -> dict[str, Any] | None:
    """Tracks and traffic on the map; None where objects were not tracked."""
    if not result.options.objects.enabled:
        return None
    rows = [
        (
            one,
            track_length(one.xy),
            mean_speed(one.velocity),
            1e-9 * float(one.stamp_ns[-1] - one.stamp_ns[0]),
        )
        for one in result.objects
    ]
    if not rows:
        return {"total": 0}
    rows.sort(key=lambda row: row[1], reverse=True)
    objects, _, speeds, seconds = zip(*rows, strict=True)
    return {
        "total": len(rows),
        "returns": sum(len(one.beams) for one in objects),
        "median_seconds": float(np.median(seconds)),
        "median_speed": float(np.median(speeds)),
        "tracks": [view.svg_points(one.xy) for one in objects[:_MAX_TRACKS]],
        "traffic": data_uri(draw_traffic(result.traffic, filtered, view.window)),
        "traffic_cell": result.traffic.resolution,
        "max_crossings": int(result.traffic.crossings.max()),
        "listed": rows[:_MAX_OBJECTS],
    }


def draw_traffic(traffic: FlowMap, picture: Image.Image, window: Window) -> Image.Image:
    """The map's `picture` of a window with the crossed cells colored, on a logarithmic scale."""
    image = np.array(picture.convert("RGB"))
    height, width = image.shape[:2]
    x0, y0, x1, y1 = window
    x = x0 + (np.arange(width) + 0.5) * (x1 - x0) / width
    y = y1 - (np.arange(height) + 0.5) * (y1 - y0) / height
    padded = np.pad(traffic.crossings, 1)  # zero outside the grid
    column = np.floor((x - traffic.origin[0]) / traffic.resolution).astype(np.int64) + 1
    row = np.floor((y - traffic.origin[1]) / traffic.resolution).astype(np.int64) + 1
    row, column = row.clip(0, padded.shape[0] - 1), column.clip(0, padded.shape[1] - 1)
    crossings = padded[row[:, None], column]
    colored = (crossings > 0) & (image.min(axis=2) > _WALL)
    share = np.log1p(crossings[colored]) / np.log1p(max(int(traffic.crossings.max()), 1))
    image[colored] = (_PALE + share[:, None] * (_DARK - _PALE)).astype(np.uint8)
    return Image.fromarray(image).quantize(_TRAFFIC_COLORS)


def evolution_data(result: MappingResult) -> list[tuple[Snapshot, MapView, str]]:
    """The part of the map with most dynamic returns over the iterations (Fig. 8): of each what was
    seen, its view, and the `data:` URI of its picture."""
    shown = [one for one in result.snapshots if one.p_occupied.size]
    pictures = map(figures.draw_snapshot, shown)
    return [
        (one, MapView(extent(one), picture.size), data_uri(picture))
        for one, picture in zip(shown, pictures, strict=True)
    ]
