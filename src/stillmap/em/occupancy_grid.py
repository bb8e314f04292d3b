"""The map as plain arrays: (15), or what the estimator knows better."""

import itertools
from collections.abc import Iterator
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.em.types import CellProbabilities, Grid

Cell = NDArray[np.int64]
Sums = NDArray[np.float64]

# edge in cells of the tiles in which sums are laid out: maps are large, and mostly unknown
_TILE = 2000


class ObservedCells(NamedTuple):
    """Cells of which beams tell something, in a box; none outside.

    Attributes:
        first_cell: (2,) the lowest column and row of the box.
        cells: (h, w) bool.
    """

    first_cell: Cell
    cells: NDArray[np.bool_]


class GridWindow(NamedTuple):
    """A part of a map.

    Attributes:
        first_cell: (2,) its lowest column and row.
        shape: rows and columns.
    """

    first_cell: Cell
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A 2D map.

    Attributes:
        p_occupied: (H, W) float32; NaN where no beam tells anything: unknown is not free. Row 0
            has the lowest y.
        alpha: (H, W) float32, expected number of static hits.
        beta: (H, W) float32, expected number of dynamic hits + beam length through the cell.
        origin: x, y (metres) and yaw of the lower-left corner of the lower-left cell.
        resolution: metres.
    """

    p_occupied: NDArray[np.float32]
    alpha: NDArray[np.float32]
    beta: NDArray[np.float32]
    origin: tuple[float, float, float]
    resolution: float

    @property
    def window(self) -> GridWindow:
        """Which cells these are."""
        first_cell = np.round(np.array(self.origin[:2]) / self.resolution).astype(np.int64)
        height, width = self.p_occupied.shape
        return GridWindow(first_cell, (height, width))


def make_occupancy_map(
    grid: Grid,
    occupied: CellProbabilities | None = None,
    observed: ObservedCells | None = None,
    window: GridWindow | None = None,
) -> OccupancyMap:
    """The closed-form maximum (15) of the counts in a grid, or an estimator's own probabilities.

    Args:
        grid: the sums of (10).
        occupied: None for (15). Else the probabilities of cells in which beams ended; cells that
            beams only passed are free for every cell length that was passed.
        seen: the cells of which beams tell something: the map is as large as their box. None: all
            that beams crossed.
        box: which cells are wanted, instead.
    """
    if not isinstance(grid, _core.OccupancyGrid2D):
        raise ValueError("grid: expected one of 2 dimensions")
    if observed is not None:
        window = GridWindow(observed.first_cell, observed.cells.shape)
    window = window or _whole(grid)
    p_occupied = np.full(window.shape, np.nan, np.float32)
    a, b = np.zeros(window.shape, np.float32), np.zeros(window.shape, np.float32)
    for at, alpha, beta in _tiles(grid, window):
        p_occupied[at], a[at], b[at] = _probabilities(alpha, beta, occupied), alpha, beta
    if occupied is not None:
        _lay_over(p_occupied, occupied, window.first_cell)
    if observed is not None:
        p_occupied[~observed.cells] = np.nan
    x, y = (float(c) * grid.resolution for c in window.first_cell)
    return OccupancyMap(p_occupied, a, b, (x, y, 0.0), grid.resolution)


def _whole(grid: _core.OccupancyGrid2D) -> GridWindow:
    first_cell, (height, width) = grid.bounding_box()
    return GridWindow(first_cell, (height, width))


def _tiles(
    grid: _core.OccupancyGrid2D, box: GridWindow
) -> Iterator[tuple[tuple[slice, slice], Sums, Sums]]:
    """Where in a box cells were crossed: rows and columns of a tile, and its alpha and beta."""
    height, width = box.shape
    for row, column in itertools.product(range(0, height, _TILE), range(0, width, _TILE)):
        shape = min(_TILE, height - row), min(_TILE, width - column)
        _, alpha, beta = grid.dense((box.first_cell + np.array([column, row])).tolist(), shape)
        if beta.any() or alpha.any():
            yield (slice(row, row + shape[0]), slice(column, column + shape[1])), alpha, beta


def _probabilities(
    alpha: Sums, beta: Sums, occupied: CellProbabilities | None
) -> NDArray[np.float32]:
    """(15), or how free cells look that beams passed; NaN where none did."""
    crossed = alpha + beta > 0.0
    p = np.full(alpha.shape, np.nan, np.float32)
    if occupied is None:
        np.divide(alpha, alpha + beta, out=p, where=crossed, casting="same_kind")  # (15)
    else:
        odds = occupied.free_prior / (1.0 - occupied.free_prior) * np.exp(-beta[crossed])
        p[crossed] = odds / (1.0 + odds)
    return p


def _lay_over(
    p_occupied: NDArray[np.float32], occupied: CellProbabilities, first_cell: Cell
) -> None:
    """Either a static surface runs through the cell, or it is as free as it looks."""
    at = (occupied.cells - first_cell)[:, ::-1]
    inside = ((at >= 0) & (at < p_occupied.shape)).all(axis=1)
    row, column = at[inside].T
    free, p = p_occupied[row, column], occupied.p_occupied[inside]
    p_occupied[row, column] = p + (1.0 - p) * free
