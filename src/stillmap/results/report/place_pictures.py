"""Pictures of the map of a place as of its sessions."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from stillmap.core.grid_map import GridMap
from stillmap.pipeline.snapshots import Window, extent
from stillmap.results.colors import KIND_COLORS
from stillmap.results.report.figures import (
    MAX_PIXELS,
    UNKNOWN_LEVEL,
    MapView,
    color_levels,
    map_levels,
    map_window,
    reduction_factor,
)
from stillmap.results.timeline import Timeline

_OCCUPIED_LEVEL = 100
_CAME, _LEFT, _CLEAR = UNKNOWN_LEVEL + 2, UNKNOWN_LEVEL + 3, UNKNOWN_LEVEL + 4
_MARGIN = 8  # cells around changed cells that a picture shows at least


class Patch(NamedTuple):
    """A part of a picture: column and row of its upper left pixel."""

    left: int
    top: int
    image: Image.Image


class PlacePictures:
    """Draws the map of a place as of its sessions.

    Attributes:
        view: window and size of the pictures.
    """

    def __init__(self, occupancy: GridMap, timeline: Timeline, max_pixels: int = MAX_PIXELS):
        """Draw the map as it was written.

        Args:
            occupancy: the map of the place, with at least one cell.
            timeline: of the place.
            max_pixels: of a picture.
        """
        cells, self._timeline = timeline.cells, timeline
        window = _window_of(occupancy, timeline)
        factor = reduction_factor(window, occupancy.resolution, max_pixels)
        at = np.floor((cells.centers - np.array(window[:2])) / occupancy.resolution)
        local = at.astype(np.int64)
        self._levels = map_levels(occupancy, window, max_pixels=max_pixels)
        self._cleared = map_levels(occupancy, window, local, max_pixels)
        height, width = self._levels.shape
        self.view = MapView(window, (width, height), factor)
        row, column = height - 1 - local[:, 1] // factor, local[:, 0] // factor
        inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
        self._drawn = np.flatnonzero(inside)
        self._row, self._column = row[inside], column[inside]

    def draw_map(self) -> Image.Image:
        """The map as it was written."""
        return color_levels(self._levels)

    def draw(self, session: int) -> Image.Image:
        """The map as of a session, in color what came and left since the one before."""
        colors = KIND_COLORS["appeared"], KIND_COLORS["gone"]
        return color_levels(self._levels_as_of(session), *colors)

    def draw_difference(self, session: int) -> Patch | None:
        """The difference of `draw` of a session from `draw_map`, transparent elsewhere."""
        levels = self._levels_as_of(session)
        differs = levels != self._levels
        if not differs.any():
            return None
        rows, columns = (np.flatnonzero(differs.any(axis=axis)) for axis in (1, 0))
        part = slice(rows[0], rows[-1] + 1), slice(columns[0], columns[-1] + 1)
        pixels = np.where(differs, levels, np.uint8(_CLEAR))[part]
        image = color_levels(pixels, KIND_COLORS["appeared"], KIND_COLORS["gone"], (0, 0, 0))
        image.info["transparency"] = _CLEAR
        return Patch(int(columns[0]), int(rows[0]), image)

    def _levels_as_of(self, session: int) -> NDArray[np.uint8]:
        now, came, left = (one[self._drawn] for one in self._timeline.cells_as_of(session))
        out, at = self._levels.copy(), (self._row, self._column)
        redrawn = np.zeros(out.shape, np.bool_)
        differs = now != self._timeline.cells.shown[self._drawn]
        redrawn[self._row[differs], self._column[differs]] = True
        out[redrawn] = self._cleared[redrawn]
        for cells, level in (
            (now & redrawn[at], _OCCUPIED_LEVEL),
            (left, _LEFT),
            (came, _CAME),
        ):
            out[self._row[cells], self._column[cells]] = level
        return out


def _window_of(occupancy: GridMap, timeline: Timeline) -> Window:
    """The window of the map, widened by changed cells at its border."""
    x0, y0, x1, y1 = map_window([occupancy])
    cells, whole = timeline.cells, extent(occupancy)
    if not len(cells.cells):
        return x0, y0, x1, y1
    low = (cells.cells.min(axis=0) - _MARGIN) * cells.resolution
    high = (cells.cells.max(axis=0) + 1 + _MARGIN) * cells.resolution
    left, bottom = np.minimum([x0, y0], np.maximum(low, whole[:2])).tolist()
    right, top = np.maximum([x1, y1], np.minimum(high, whole[2:])).tolist()
    return left, bottom, right, top
