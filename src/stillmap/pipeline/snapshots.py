"""Small parts of a map, to show how it evolves (Fig. 8) without keeping every map."""

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.errors import InputError
from stillmap.core.grid_map import GridMap
from stillmap.core.square_box import find_busiest
from stillmap.core.tiles import crop

Window = tuple[float, float, float, float]
Value = TypeVar("Value", np.float32, np.bool_)
_MOST_POINTS = 50_000


@dataclass(frozen=True, eq=False)
class Snapshot(GridMap):
    """A part of the map at one iteration.

    Attributes:
        number: the iteration, from 1.
        dynamic_points: (K, 2) float32, end points in the map frame that lie in this part; float64
            where that is far from the origin.
    """

    number: int
    dynamic_points: NDArray[np.floating]


def extent(occupancy: GridMap) -> Window:
    """x0, y0, x1, y1 of the whole map in metres, in the map frame.

    Raises:
        InputError: its rows are not parallel to the x axis.
    """
    x, y, yaw = occupancy.origin
    if yaw != 0:
        raise InputError(f"a map turned by {yaw:g} rad cannot be cut along its axes")
    height, width = occupancy.p_occupied.shape
    return x, y, x + width * occupancy.resolution, y + height * occupancy.resolution


def choose_window(
    whole: Window, resolution: float, points: Float | Float32, size_m: float = 12.0
) -> Window:
    """The square of edge `size_m` that holds most points, within the map's bounds.

    Args:
        whole: x0, y0, x1, y1 of the map in metres.
        resolution: edge of its cells in metres.
        points: (K, 2) end points of dynamic beams in the map frame.
        size_m: edge in metres; smaller where the map is smaller.

    Returns:
        x0, y0, x1, y1 in metres. Without points: the middle of the map.
    """
    x0, y0, x1, y1 = whole
    size = np.minimum(size_m, [x1 - x0, y1 - y0])
    low, high = np.array([x0, y0]), np.array([x1, y1]) - size
    points = points[_within(points, whole)]
    corner = (low + high) / 2
    if len(points):
        step = size_m / 8
        busiest = find_busiest(np.floor((points - low) / step).astype(np.int64), 8)
        corner = np.clip(low + (busiest + 0.5) * step - size_m / 2, low, high)
    # on the grid's own lines, so that every iteration shows the same cells
    corner = low + np.floor((corner - low) / resolution + 1e-6) * resolution
    (left, bottom), (right, top) = corner.tolist(), (corner + size).tolist()
    return left, bottom, right, top


def snapshot(number: int, occupancy: GridMap, points: Float | Float32, window: Window) -> Snapshot:
    """The part of iteration `number`'s map that lies in `window`; points as `choose_window`."""
    p_occupied, origin = cut(occupancy, window)
    inside = np.flatnonzero(_within(points, window))
    if len(inside) > _MOST_POINTS:
        inside = inside[np.arange(_MOST_POINTS) * len(inside) // _MOST_POINTS]
    return Snapshot(
        number=number,
        p_occupied=p_occupied.copy(),
        origin=origin,
        resolution=float(occupancy.resolution),
        dynamic_points=points[inside].astype(np.float32),
    )


def cut(occupancy: GridMap, window: Window) -> tuple[Float32, tuple[float, float, float]]:
    """The cells (h, w) in `window` and their origin; NaN where the window leaves the map."""
    return cut_layer(occupancy, occupancy.p_occupied, window, np.nan)


def cut_layer(
    occupancy: GridMap, layer: NDArray[Value], window: Window, outside: float
) -> tuple[NDArray[Value], tuple[float, float, float]]:
    """The same of any (H, W) layer of a map; `outside` where the window leaves it."""
    x, y, _, _ = extent(occupancy)
    step = occupancy.resolution
    left, bottom = round((window[0] - x) / step), round((window[1] - y) / step)
    w, h = round((window[2] - window[0]) / step), round((window[3] - window[1]) / step)
    height, width = layer.shape
    origin = (x + left * step, y + bottom * step, 0.0)
    if left >= 0 and bottom >= 0 and left + w <= width and bottom + h <= height:
        return crop(layer, (slice(bottom, bottom + h), slice(left, left + w))), origin
    cells = np.full((h, w), outside, layer.dtype)
    i0, i1 = np.clip([bottom, bottom + h], 0, height)
    j0, j1 = np.clip([left, left + w], 0, width)
    inside = slice(int(i0), int(i1)), slice(int(j0), int(j1))
    cells[i0 - bottom : i1 - bottom, j0 - left : j1 - left] = crop(layer, inside)
    return cells, origin


def _within(points: Float | Float32, window: Window) -> Bool:
    x0, y0, x1, y1 = window
    x, y = points.T
    return np.asarray((x >= x0) & (x < x1) & (y >= y0) & (y < y1))
