"""The map as `map.pgm` or `map.png` holds it, for the top of the report."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

import stillmap._core as _core
from stillmap.core.grid_map import GridMap
from stillmap.pipeline.options import MapMode
from stillmap.pipeline.snapshots import Window, extent
from stillmap.results.map_server import trinary_pixels
from stillmap.results.report.figures import (
    UNKNOWN_LEVEL,
    color_by_index,
    iter_strips,
    reduce_levels,
)

FREE, OCCUPIED, UNKNOWN = 254, 0, 205  # pixels of map.pgm
_MAX_EDGE = 4096  # pixels; a trinary map of that size takes a few hundred kB as PNG


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


# of occupancy in percent as `--map-mode scale` writes it, and of unknown cells
_PERCENT_GREYS = [round(255 * (1 - percent / 100)) for percent in range(UNKNOWN_LEVEL)] + [UNKNOWN]


def _reduce_states(p_occupied: NDArray[np.float32], factor: int) -> NDArray[np.uint8]:
    """0: a cell of the square is occupied, 2: at least half of its known cells are free, else 1."""
    states = trinary_pixels(p_occupied)
    occupied, free = states == OCCUPIED, states == FREE
    if factor > 1:
        n_free, n_known = (
            _core.count_in_squares(np.ascontiguousarray(cells), factor)
            for cells in (free, ~np.isnan(p_occupied))
        )
        occupied = _core.count_in_squares(occupied, factor) > 0
        free = (n_free > 0) & (2 * n_free >= n_known)
    return np.where(occupied, 0, np.where(free, 2, 1)).astype(np.uint8)
