"""The planar map of a live run: of the cells in 2D, in 3D of the obstacles above the ground."""

import numpy as np
from numpy.typing import NDArray

from stillmap.core.grid_map import GridMap
from stillmap.em import CellProbabilities, GroundMap
from stillmap.em.ground import fit_ground
from stillmap.mapping.projection import project_cells

Float = NDArray[np.float64]

STANDS = 0.5  # P(static and occupied) of a cell that counts as surface


def empty_map(resolution: float) -> GridMap:
    """A map without cells; resolution: m."""
    return GridMap(np.zeros((0, 0), np.float32), (0.0, 0.0, 0.0), resolution)


def project_obstacles(
    known: CellProbabilities, positions: Float, band: tuple[float, float], cell: float
) -> GridMap:
    """Occupancy of the columns in which something stands above the ground; NaN: unknown.

    Columns with ground alone are free.

    Args:
        known: of (K, 3) cells in which beams ended.
        positions: (T, 3) of the sensor; z points up.
        band: m above the ground, lowest and highest of obstacles.
        cell: m, edge of a cell.
    """
    stands = known.p_occupied >= STANDS
    if not stands.any():
        return empty_map(cell)
    cells = known.cells[stands]
    ground = find_ground(known, positions, cell)
    obstacles = project_cells(known, ground, band, cell)
    columns = np.concatenate([cells[:, :2], obstacles.cells])
    first, last = columns.min(axis=0), columns.max(axis=0)
    p_occupied = np.full((last - first + 1)[::-1], np.nan, np.float32)
    for xy, p in ((cells[:, :2], 0.0), (obstacles.cells, obstacles.p_occupied)):
        column, row = (xy - first).T
        p_occupied[row, column] = p
    x, y = (first * cell).tolist()
    return GridMap(p_occupied, (x, y, 0.0), cell)


def find_ground(known: CellProbabilities, positions: Float, cell: float) -> GroundMap:
    """The ground, as level surface shows it; see `project_obstacles`."""
    cells = known.cells[known.p_occupied >= STANDS].reshape(-1, 3)
    floor = cells[is_level(cells)] if len(cells) else cells
    return fit_ground(np.asarray((floor + 0.5) * cell, np.float64), positions)


def is_level(cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    """(K,) cells (K, 3) without one right above: those of walls have one."""
    low = cells.min(axis=0)
    size = cells.max(axis=0) - low + 2
    key = np.ravel_multi_index(tuple((cells - low).T), tuple(size))
    return np.isin(key + 1, key, invert=True)
