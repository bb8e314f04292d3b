"""The occupancy map: (15), or the probabilities of an estimator."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.grid_map import GridMap
from stillmap.em.types import CellProbabilities, Float, Grid

_TILE = 2000  # cells, edge of the tiles that are read at once: maps are large, and mostly unknown


class ObservedCells(NamedTuple):
    """Cells that beams observed; none outside the mask.

    Attributes:
        first_cell: (2,) int64 lowest column and row of the mask.
        mask: (h, w) bool.
    """

    first_cell: NDArray[np.int64]
    mask: NDArray[np.bool_]


class GridWindow(NamedTuple):
    """Rectangle of cells.

    Attributes:
        first_cell: (2,) int64 lowest column and row.
        shape: rows and columns.
    """

    first_cell: NDArray[np.int64]
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class OccupancyMap(GridMap):
    """A 2D map with the sums that it is made from.

    Attributes:
        alpha: (H, W) float32, expected number of static hits.
        beta: (H, W) float32, expected number of dynamic hits + beam length through the cell.
    """

    alpha: NDArray[np.float32]
    beta: NDArray[np.float32]

    @property
    def window(self) -> GridWindow:
        """The cells of the map."""
        first_cell = np.round(np.array(self.origin[:2]) / self.resolution).astype(np.int64)
        height, width = self.p_occupied.shape
        return GridWindow(first_cell, (height, width))


def make_occupancy_map(
    grid: Grid,
    occupied: CellProbabilities | None = None,
    observed: ObservedCells | None = None,
    window: GridWindow | None = None,
) -> OccupancyMap:
    """Makes the map of a grid.

    Args:
        grid: 2D counts (10).
        occupied: probabilities of cells in which beams ended; cells that beams only passed get
            the free prior, lowered by e for every cell length passed. None: (15) everywhere.
        observed: the observed cells, which give the size of the map; None: all that beams crossed.
        window: cells to return instead.

    Raises:
        ValueError: the grid is 3D.
    """
    if not isinstance(grid, _core.OccupancyGrid2D):
        raise ValueError("grid: expected one of 2 dimensions")
    if observed is not None:
        window = GridWindow(observed.first_cell, observed.mask.shape)
    if window is None:
        first_cell, (height, width) = grid.bounding_box()
        window = GridWindow(first_cell, (height, width))
    p_occupied = np.full(window.shape, np.nan, np.float32)
    a, b = np.zeros(window.shape, np.float32), np.zeros(window.shape, np.float32)
    for at, alpha, beta in _iter_tiles(grid, window):
        p_occupied[at], a[at], b[at] = _probabilities(alpha, beta, occupied), alpha, beta
    if occupied is not None:
        _overlay(p_occupied, occupied, window.first_cell)
    if observed is not None:
        p_occupied[~observed.mask] = np.nan
    x, y = (float(c) * grid.resolution for c in window.first_cell)
    return OccupancyMap(p_occupied, (x, y, 0.0), grid.resolution, a, b)


def _iter_tiles(
    grid: _core.OccupancyGrid2D, window: GridWindow
) -> Iterator[tuple[tuple[slice, slice], Float, Float]]:
    """Tiles with counts: rows and columns in the window, alpha, beta."""
    height, width = window.shape
    for row, column in itertools.product(range(0, height, _TILE), range(0, width, _TILE)):
        shape = min(_TILE, height - row), min(_TILE, width - column)
        _, alpha, beta = grid.dense((window.first_cell + np.array([column, row])).tolist(), shape)
        if beta.any() or alpha.any():
            yield (slice(row, row + shape[0]), slice(column, column + shape[1])), alpha, beta


def _probabilities(
    alpha: Float, beta: Float, occupied: CellProbabilities | None
) -> NDArray[np.float32]:
    """(15), or the occupancy of cells that beams only passed; NaN where none did."""
    crossed = alpha + beta > 0.0
    p = np.full(alpha.shape, np.nan, np.float32)
    if occupied is None:
        np.divide(alpha, alpha + beta, out=p, where=crossed, casting="same_kind")  # (15)
    else:
        odds = occupied.free_prior / (1.0 - occupied.free_prior) * np.exp(-beta[crossed])
        p[crossed] = odds / (1.0 + odds)
    return p


def _overlay(
    p_occupied: NDArray[np.float32], occupied: CellProbabilities, first_cell: NDArray[np.int64]
) -> None:
    """Adds surfaces to a map of passed cells, in place: p + (1 - p) * p_passed."""
    at = (occupied.cells - first_cell)[:, ::-1]
    inside = ((at >= 0) & (at < p_occupied.shape)).all(axis=1)
    row, column = at[inside].T
    passed, p = p_occupied[row, column], occupied.p_occupied[inside]
    p_occupied[row, column] = p + (1.0 - p) * passed
