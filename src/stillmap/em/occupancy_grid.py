"""The occupancy map: (15), or the probabilities of an estimator."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core import tiles
from stillmap.core.array_types import Float, Float32, Int64
from stillmap.core.grid_map import GridMap
from stillmap.core.square_box import SquareBox, bound_box
from stillmap.em.types import CellProbabilities, Grid

BLOCK_CELLS = 32  # edge of the blocks of the grid
# blocks of the box of a map: up to which it is always whole (a square of 580 m at 0.05 m), and at
# most (2^31 cells: what readers of images take)
_LEAST_BLOCKS, _MOST_BLOCKS = 1 << 17, 1 << 21


class ObservedCells(NamedTuple):
    """Cells that beams observed; none outside the mask.

    Attributes:
        first_cell: (2,) int64 lowest column and row of the mask.
        mask: (h, w) bool.
    """

    first_cell: Int64
    mask: tiles.TiledArray


class GridWindow(NamedTuple):
    """Rectangle of cells.

    Attributes:
        first_cell: (2,) int64 lowest column and row.
        shape: rows and columns.
    """

    first_cell: Int64
    shape: tuple[int, int]


@dataclass(frozen=True, eq=False)
class OccupancyMap(GridMap):
    """A 2D map with the sums that it is made from.

    Attributes:
        alpha: (H, W) float32, expected number of static hits.
        beta: (H, W) float32, expected number of dynamic hits + beam length through the cell.
    """

    alpha: Float32
    beta: Float32

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
    places: Float | None = None,
) -> OccupancyMap:
    """Makes the map of a grid. Large layers are `TiledArray`s, which NumPy takes for arrays.

    Args:
        grid: 2D counts (10).
        occupied: probabilities of cells in which beams ended; cells that beams only passed get
            the free prior, lowered by e for every cell length passed. None: (15) everywhere.
        observed: the observed cells, which give the size of the map; None: all that beams crossed.
        window: cells to return instead.
        scratch: folder of temporary files for layers larger than memory; None: the system's.
        places: see `map_window`.

    Raises:
        ValueError: the grid is 3D.
    """
    if not isinstance(grid, _core.OccupancyGrid2D):
        raise ValueError("grid: expected 2 dimensions")
    if observed is not None:
        window = GridWindow(observed.first_cell, observed.mask.shape)
    if window is None:
        window = map_window(grid, places)
    p_occupied = tiles.TiledArray(window.shape, np.float32, np.nan, scratch)
    a, b = (tiles.TiledArray(window.shape, np.float32, 0.0, scratch) for _ in range(2))
    for k, ((i, j), alpha, beta) in enumerate(_iter_tiles(grid, window)):
        if k % tiles.TILES_PER_RELEASE == 0:
            for layer in (p_occupied, a, b):
                layer.release()
        p_occupied.set_tile(i, j, _probabilities(alpha, beta, occupied))
        a.set_tile(i, j, alpha)
        b.set_tile(i, j, beta)
    if occupied is not None:
        _overlay(p_occupied, occupied, window.first_cell)
    if observed is not None:
        for block, p in p_occupied.tiles():
            p[~tiles.crop(observed.mask, block)] = np.nan
    x, y = (float(c) * grid.resolution for c in window.first_cell)
    layers = tiles.compact(p_occupied), tiles.compact(a), tiles.compact(b)
    for layer in layers:
        tiles.release(layer)
    return OccupancyMap(layers[0], (x, y, 0.0), grid.resolution, *layers[1:])


def observed_cells(
    grid: _core.OccupancyGrid2D, scratch: Path | None = None, places: Float | None = None
) -> ObservedCells:
    """The cells of `map_window` that any beam of a grid crossed or ended in."""
    window = map_window(grid, places)
    mask = tiles.TiledArray(window.shape, np.bool_, False, scratch)
    for (i, j), alpha, beta in _iter_tiles(grid, window):
        mask.set_tile(i, j, alpha + beta > 0.0)
    return ObservedCells(window.first_cell, mask)


def map_window(grid: _core.OccupancyGrid2D, places: Float | None = None) -> GridWindow:
    """The box of all observed cells; where it is nearly empty, that around most of the hits.

    Args:
        grid: 2D counts.
        places: (K, 2) m, around which the map is to lie if it cannot be whole; None: around most
            of the hits.
    """
    first_cell, (height, width) = grid.bounding_box()
    observed = SquareBox(first_cell, first_cell + np.array([width, height]) - 1)
    if observed.area <= _LEAST_BLOCKS * BLOCK_CELLS**2:
        return GridWindow(first_cell, (height, width))
    near = None
    if places is not None:
        near = np.floor(places / (BLOCK_CELLS * grid.resolution)).astype(np.int64)
    whole = SquareBox(observed.low // BLOCK_CELLS, observed.high // BLOCK_CELLS)
    blocks = _hit_blocks(grid)
    box = bound_box(blocks, _LEAST_BLOCKS, _MOST_BLOCKS, places=near, around=whole)
    low = np.maximum(box.low * BLOCK_CELLS, observed.low)
    high = np.minimum((box.high + 1) * BLOCK_CELLS - 1, observed.high)
    return GridWindow(low, SquareBox(low, high).shape)


def find_hits_beyond(grid: _core.OccupancyGrid2D, window: GridWindow) -> Float:
    """(K, 2) m, middles of the blocks of a grid that hold hits and lie outside a map's window."""
    _, (height, width) = grid.bounding_box()
    if height * width <= _LEAST_BLOCKS * BLOCK_CELLS**2:
        return np.zeros((0, 2))  # `map_window` is whole
    low = window.first_cell // BLOCK_CELLS
    high = (window.first_cell + np.array(window.shape[::-1]) - 1) // BLOCK_CELLS
    blocks = _hit_blocks(grid)
    beyond = blocks[~SquareBox(low, high).contains(blocks)]
    return np.asarray((beyond + 0.5) * (BLOCK_CELLS * grid.resolution))


def _hit_blocks(grid: _core.OccupancyGrid2D) -> Int64:
    """(B, 2) column and row of the blocks in which beams ended; all blocks where none did."""
    blocks = grid.block_cells
    shape = BLOCK_CELLS, BLOCK_CELLS
    hit = [bool(grid.dense(block, shape)[1].any()) for block in blocks.tolist()]
    return (blocks[hit] if any(hit) else blocks) // BLOCK_CELLS


def _iter_tiles(
    grid: _core.OccupancyGrid2D, window: GridWindow
) -> Iterator[tuple[tuple[int, int], Float, Float]]:
    """Tiles with counts: row and column of the tile in the window, alpha, beta."""
    height, width = window.shape
    for i, j in tiles.tiles_around(grid.block_cells - window.first_cell, BLOCK_CELLS, window.shape):
        shape = min(tiles.TILE, height - i * tiles.TILE), min(tiles.TILE, width - j * tiles.TILE)
        first = window.first_cell + tiles.TILE * np.array([j, i])
        _, alpha, beta = grid.dense(first.tolist(), shape)
        if beta.any() or alpha.any():
            yield (i, j), alpha, beta


def _probabilities(alpha: Float, beta: Float, occupied: CellProbabilities | None) -> Float32:
    """(15), or the occupancy of cells that beams only passed; NaN where none did."""
    crossed = alpha + beta > 0.0
    p = np.full(alpha.shape, np.nan, np.float32)
    if occupied is None:
        np.divide(alpha, alpha + beta, out=p, where=crossed, casting="same_kind")  # (15)
    else:
        odds = occupied.free_prior / (1.0 - occupied.free_prior) * np.exp(-beta[crossed])
        p[crossed] = odds / (1.0 + odds)
    return p


def _overlay(p_occupied: tiles.TiledArray, occupied: CellProbabilities, first_cell: Int64) -> None:
    """Adds surfaces to a map of passed cells, in place: p + (1 - p) * p_passed."""
    at = (occupied.cells - first_cell)[:, ::-1]
    inside = ((at >= 0) & (at < p_occupied.shape)).all(axis=1)
    row, column = at[inside].T
    passed, p = p_occupied.take(row, column), occupied.p_occupied[inside]
    p_occupied.put(row, column, p + (1.0 - p) * passed)
