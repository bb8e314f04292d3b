"""The map as plain arrays: (15), or what the estimator knows better."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em.expectations import CellProbabilities


class Seen(NamedTuple):
    """Cells of which beams tell something, in a box; none outside.

    Attributes:
        first_cell: (2,) the lowest column and row of the box.
        cells: (h, w) bool.
    """

    first_cell: NDArray[np.int64]
    cells: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class OccupancyMap:
    """A 2D map.

    Attributes:
        p_occupied: (H, W) float32; NaN where no beam tells anything: unknown is not free. Row 0
            has the lowest y.
        alpha: (H, W) float64, expected number of static hits.
        beta: (H, W) float64, expected number of dynamic hits + beam length through the cell.
        origin: x, y (metres) and yaw of the lower-left corner of the lower-left cell.
        resolution: metres.
    """

    p_occupied: NDArray[np.float32]
    alpha: NDArray[np.float64]
    beta: NDArray[np.float64]
    origin: tuple[float, float, float]
    resolution: float


def occupancy_map(
    grid: _core.Grid2D, occupied: CellProbabilities | None = None, seen: Seen | None = None
) -> OccupancyMap:
    """The closed-form maximum (15) of the counts in a grid, or an estimator's own probabilities.

    Args:
        grid: the sums of (10).
        occupied: None for (15). Else the probabilities of cells in which beams ended; cells that
            beams only passed are free for every cell length that was passed.
        seen: the cells of which beams tell something: the map is as large as their box. None: all
            that beams crossed.
    """
    first_cell, alpha, beta = grid.dense()
    p_occupied = np.full(alpha.shape, np.nan, dtype=np.float32)
    for a, b, p in zip(alpha, beta, p_occupied, strict=True):  # by rows: maps are large
        crossed = a + b > 0.0
        if occupied is None:
            np.divide(a, a + b, out=p, where=crossed, casting="same_kind")  # (15)
        else:
            odds = occupied.free_prior / (1.0 - occupied.free_prior) * np.exp(-b)
            np.copyto(p, odds / (1.0 + odds), where=crossed, casting="same_kind")
    if occupied is not None:
        _lay_over(p_occupied, occupied, first_cell)
    if seen is not None:
        p_occupied, alpha, beta = _seen_part(seen, first_cell, (p_occupied, alpha, beta))
        p_occupied[~seen.cells] = np.nan
        first_cell = seen.first_cell
    x, y = (float(c) * grid.resolution for c in first_cell)
    return OccupancyMap(p_occupied, alpha, beta, (x, y, 0.0), grid.resolution)


def _lay_over(
    p_occupied: NDArray[np.float32], occupied: CellProbabilities, first_cell: NDArray[np.int64]
) -> None:
    """Either a static surface runs through the cell, or it is as free as it looks."""
    column, row = (occupied.cells - first_cell).T
    free = p_occupied[row, column]
    p_occupied[row, column] = occupied.p_occupied + (1.0 - occupied.p_occupied) * free


def _seen_part(
    seen: Seen, first_cell: NDArray[np.int64], arrays: tuple[NDArray[Any], ...]
) -> tuple[NDArray[Any], ...]:
    """The parts (h, w) of arrays (H, W) in the box of the cells that were seen."""
    column, row = seen.first_cell - first_cell
    height, width = seen.cells.shape
    return tuple(a[row : row + height, column : column + width].copy() for a in arrays)
