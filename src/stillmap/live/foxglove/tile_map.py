"""The map, put together from the parts that changed."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.live.causal_labels import MapChange

UNKNOWN = 255
_OCCUPIED = 65  # per cent, of the voxels that are shown in 3D
# larger maps are shown in larger cells: viewers draw them as one texture
_MAX_CELLS = 4_000_000
_MAX_POINTS = 1_000_000


class Cells(NamedTuple):
    """A map as it is shown.

    Attributes:
        origin: (2,) m, the lower left corner.
        edge: m, of a cell.
        percent: (H, W) uint8 occupancy; UNKNOWN.
    """

    origin: NDArray[np.float64]
    edge: float
    percent: NDArray[np.uint8]


class TileMap:
    """Tiles of a map in 2D or 3D, per cent in a byte per cell."""

    def __init__(self) -> None:
        self._tiles: dict[tuple[int, ...], NDArray[np.uint8]] = {}
        self.resolution = 0.0

    @property
    def dimension(self) -> int:
        """2 or 3; 0: it is empty."""
        return len(next(iter(self._tiles), ()))

    def add(self, changes: list[MapChange], resolution: float) -> None:
        """Replace tiles; resolution: m, edge of a cell."""
        self.resolution = resolution
        for change in changes:
            key = tuple(change.first_cell.tolist())
            percent = to_percent(change.p_occupied)
            if (percent == UNKNOWN).all():
                self._tiles.pop(key, None)
            else:
                self._tiles[key] = percent

    def to_cells(self, max_cells: int = _MAX_CELLS) -> Cells:
        """The planar map; cells are joined until there are at most `max_cells`."""
        low = np.array(list(self._tiles))
        edge = next(iter(self._tiles.values())).shape[0]
        first = low.min(axis=0)
        width, height = low.max(axis=0) + edge - first
        percent = np.full((height, width), UNKNOWN, np.uint8)
        for (x, y), tile in self._tiles.items():
            row, column = y - first[1], x - first[0]
            percent[row : row + edge, column : column + edge] = tile
        k = int(np.ceil(np.sqrt(percent.size / max_cells)))
        return Cells(first * self.resolution, k * self.resolution, join_cells(percent, k))

    def to_points(self, max_points: int = _MAX_POINTS) -> NDArray[np.float32]:
        """(n, 3) centres of the occupied voxels, m; every k-th where there are too many."""
        found = []
        for first, tile in self._tiles.items():
            at = np.argwhere((tile > _OCCUPIED) & (tile != UNKNOWN))[:, ::-1]  # x y z
            found.append((at + first + 0.5) * self.resolution)
        points = np.concatenate([np.zeros((0, 3)), *found])
        return points[:: max(1, -(-len(points) // max_points))].astype(np.float32)


def to_percent(p_occupied: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Occupancy in per cent; UNKNOWN where it is NaN."""
    known = ~np.isnan(p_occupied)
    percent = np.rint(100.0 * np.where(known, p_occupied, 0.0))
    return np.where(known, percent, UNKNOWN).astype(np.uint8)


def join_cells(percent: NDArray[np.uint8], k: int) -> NDArray[np.uint8]:
    """Blocks of k by k cells as one: the most occupied of those that are known."""
    if k == 1:
        return percent
    rows, columns = (-(-n // k) * k for n in percent.shape)
    known = np.full((rows, columns), -1, np.int16)
    signed = percent.astype(np.int16)
    signed[percent == UNKNOWN] = -1
    known[: percent.shape[0], : percent.shape[1]] = signed
    most = known.reshape(rows // k, k, columns // k, k).max(axis=(1, 3))
    return np.where(most < 0, UNKNOWN, most).astype(np.uint8)
