"""The occupancy map: (15), or the probabilities of an estimator."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.grid_map import GridMap
from stillmap.core.tiles import (
    TILE,
    TILES_PER_RELEASE,
    TiledArray,
    compact,
    crop,
    release,
    tiles_around,
)
from stillmap.em.types import CellProbabilities, Float, Grid

BLOCK_CELLS = 32  # edge of the blocks of the grid


class ObservedCells(NamedTuple):
    """Cells that beams observed; none outside the mask.

    Attributes:
        first_cell: (2,) int64 lowest column and row of the mask.
        mask: (h, w) bool.
    """

    first_cell: NDArray[np.int64]
    mask: TiledArray


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
    scratch: Path | None = None,
) -> OccupancyMap:
    """Makes the map of a grid. Large layers are `TiledArray`s, which NumPy takes for arrays.

    Args:
        grid: 2D counts (10).
        occupied: probabilities of cells in which beams ended; cells that beams only passed get
            the free prior, lowered by e for every cell length passed. None: (15) everywhere.
        observed: the observed cells, which give the size of the map; None: all that beams crossed.
        window: cells to return instead.
        scratch: folder of temporary files for layers larger than memory; None: the system's.

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
    p_occupied = TiledArray(window.shape, np.float32, np.nan, scratch)
    a, b = (TiledArray(window.shape, np.float32, 0.0, scratch) for _ in range(2))
    for k, ((i, j), alpha, beta) in enumerate(_iter_tiles(grid, window)):
        if k % TILES_PER_RELEASE == 0:
            for layer in (p_occupied, a, b):
                layer.release()
        p_occupied.set_tile(i, j, _probabilities(alpha, beta, occupied))
        a.set_tile(i, j, alpha)
        b.set_tile(i, j, beta)
    if occupied is not None:
        _overlay(p_occupied, occupied, window.first_cell)
    if observed is not None:
        for block, p in p_occupied.tiles():
            p[~crop(observed.mask, block)] = np.nan
    x, y = (float(c) * grid.resolution for c in window.first_cell)
    layers = compact(p_occupied), compact(a), compact(b)
    for layer in layers:
        release(layer)
    return OccupancyMap(layers[0], (x, y, 0.0), grid.resolution, *layers[1:])


def observed_cells(grid: _core.OccupancyGrid2D, scratch: Path | None = None) -> ObservedCells:
    """The cells that any beam of a grid crossed or ended in."""
    first_cell, (height, width) = grid.bounding_box()
    mask = TiledArray((height, width), np.bool_, False, scratch)
    for (i, j), alpha, beta in _iter_tiles(grid, GridWindow(first_cell, (height, width))):
        mask.set_tile(i, j, alpha + beta > 0.0)
    return ObservedCells(first_cell, mask)


def _iter_tiles(
    grid: _core.OccupancyGrid2D, window: GridWindow
) -> Iterator[tuple[tuple[int, int], Float, Float]]:
    """Tiles with counts: row and column of the tile in the window, alpha, beta."""
    height, width = window.shape
    for i, j in tiles_around(grid.block_cells - window.first_cell, BLOCK_CELLS, window.shape):
        shape = min(TILE, height - i * TILE), min(TILE, width - j * TILE)
        first = window.first_cell + TILE * np.array([j, i])
        _, alpha, beta = grid.dense(first.tolist(), shape)
        if beta.any() or alpha.any():
            yield (i, j), alpha, beta


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
    p_occupied: TiledArray, occupied: CellProbabilities, first_cell: NDArray[np.int64]
) -> None:
    """Adds surfaces to a map of passed cells, in place: p + (1 - p) * p_passed."""
    at = (occupied.cells - first_cell)[:, ::-1]
    inside = ((at >= 0) & (at < p_occupied.shape)).all(axis=1)
    row, column = at[inside].T
    passed, p = p_occupied.take(row, column), occupied.p_occupied[inside]
    p_occupied.put(row, column, p + (1.0 - p) * passed)
