"""Cells with surfaces of a planar place: what is near them, and the lines through them."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Bool = NDArray[np.bool_]
Cells = NDArray[np.int64]

_MIN_HITS, _MIN_DYNAMIC_HITS = 2, 5  # in a cell with a surface; mirrors make some look dynamic
_MAX_CELLS, _MAX_LINES = 10_000, 40
_ANGLES = 180  # directions of lines that are tried
_LINE_WIDTH = 0.1  # m, in which the cells of a line lie
_MAX_BINS = 1 << 17  # of the distances of lines, 6 km; of places farther apart gaps count as one
_MIN_LINE, _MIN_LINE_CELLS = 1.0, 5  # m and cells of wall on a line, such as frames of mirrors


class SurfaceCells(NamedTuple):
    """Cells with a surface.

    Attributes:
        cells: (K, 2) columns and rows.
        keys: (L,) sorted numbers of these and the cells around them.
        own_keys: (K,) sorted numbers of these alone.
        resolution: m.
    """

    cells: Cells
    keys: Cells
    own_keys: Cells
    resolution: float

    @classmethod
    def of(cls, points: Float, is_static: Bool, resolution: float) -> "SurfaceCells":
        """The cells in which several of the points (N, 2) lie, fewer if they are static (N,)."""
        keys = cell_keys(np.floor(points / resolution).astype(np.int64))
        weight = np.where(is_static, 1.0 / _MIN_HITS, 1.0 / _MIN_DYNAMIC_HITS)
        own, number = np.unique(keys, return_inverse=True)
        own = own[np.bincount(number, weights=weight, minlength=len(own)) > 1.0 - 1e-9]
        cells = np.stack([own >> 32, (own & 0xFFFFFFFF) - (1 << 31)], axis=-1)
        around = [cells + np.array([i, j]) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        return cls(cells, np.unique(cell_keys(np.concatenate(around))), own, resolution)

    def are_near(self, points: Float) -> Bool:
        """(...) whether there is a surface in the cells of points (..., 2) or around them."""
        return contains(self.keys, points, self.resolution)

    def are_in(self, points: Float) -> Bool:
        """(...) whether there is a surface in the cells of points (..., 2) themselves."""
        return contains(self.own_keys, points, self.resolution)


def contains(keys: Cells, points: Float, resolution: float) -> Bool:
    """(...) whether sorted numbers (L,) contain those of the cells of points (..., 2)."""
    wanted = cell_keys(np.floor(points / resolution).astype(np.int64))
    at = np.minimum(np.searchsorted(keys, wanted), len(keys) - 1)
    return np.asarray(keys[at] == wanted) if len(keys) else np.zeros(wanted.shape, np.bool_)


def cell_keys(cells: Cells) -> Cells:
    """(...) a number for each cell (..., 2)."""
    return np.asarray((cells[..., 0] << 32) + cells[..., 1] + (1 << 31))


def iter_lines(cells: Cells, resolution: float) -> Iterator[tuple[Float, float]]:
    """Normals (2,) and distances of lines with many cells, longest first (Hough transform)."""
    centers = (cells[:: max(1, len(cells) // _MAX_CELLS)] + 0.5) * resolution
    if not len(centers):
        return
    angle = np.arange(_ANGLES) * (np.pi / _ANGLES)
    normals = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    bins = np.floor(centers @ normals.T / (0.5 * _LINE_WIDTH)).astype(np.int64)
    if int(np.ptp(bins)) > _MAX_BINS:
        bins = np.stack([_close_gaps(column) for column in bins.T], axis=-1)
    first = int(bins.min())
    width = int(bins.max()) - first + 2  # at least one pair
    bins += np.arange(_ANGLES) * width - first
    votes = np.bincount(bins.ravel(), minlength=_ANGLES * width)
    left = np.ones(len(centers), np.bool_)
    needed = max(_MIN_LINE_CELLS, _MIN_LINE / resolution * min(1.0, _MAX_CELLS / len(cells)))
    for _ in range(_MAX_LINES):
        of_angle = votes.reshape(_ANGLES, width)
        pairs = of_angle[:, :-1] + of_angle[:, 1:]  # lines of _LINE_WIDTH
        k, low = divmod(int(np.argmax(pairs)), width - 1)
        if pairs[k, low] < needed:
            return
        best = k * width + low
        on = left & ((bins[:, k] == best) | (bins[:, k] == best + 1))
        votes -= np.bincount(bins[on].ravel(), minlength=len(votes))
        left &= ~on
        middle = centers[on].mean(axis=0)
        _, _, axes = np.linalg.svd(centers[on] - middle, full_matrices=False)
        yield axes[1], float(middle @ axes[1])


def _close_gaps(numbers: Cells) -> Cells:
    """Numbers (N,) in the same order, with one between those that are not successive."""
    known, of = np.unique(numbers, return_inverse=True)
    return np.asarray(np.cumsum(np.minimum(np.diff(known, prepend=known[:1]), 2))[of])
