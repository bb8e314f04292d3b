"""Planar maps of sweeps: obstacles above the ground, and what was seen of a place."""

from typing import Any

import numpy as np

from stillmap.core.array_types import Bool, Float, Int64
from stillmap.core.arrays import unique_cells
from stillmap.core.grid_map import GridMap
from stillmap.em import CellProbabilities, GroundMap
from stillmap.em.ground import fit_ground
from stillmap.live.causal_labels import CausalLabels
from stillmap.live.local_map import MappedScan
from stillmap.mapping.projection import project_cells

STANDS = 0.5  # P(static and occupied) of a cell that counts as surface

# m from the sensor to which the surroundings are compared: farther off sweeps show little of them
_MAX_RANGE = 40.0
# m above the ground below which beams show that nothing stands there: higher ones pass over cars;
# m before their ends, which may be surface
_CLEARANCE, _MARGIN = 0.6, 0.15
_STEP = 0.5  # cells along a beam


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
    return _draw([(cells[:, :2], 0.0), (obstacles.cells, obstacles.p_occupied)], cell)


def _draw(layers: list[tuple[Int64, Any]], edge: float) -> GridMap:
    """The map of (N, 2) cells with probabilities, later layers over earlier ones; NaN: unknown."""
    every = np.concatenate([cells for cells, _ in layers])
    if not len(every):
        return empty_map(edge)
    first = every.min(axis=0)
    p_occupied = np.full((every.max(axis=0) + 1 - first)[::-1], np.nan, np.float32)
    for cells, p in layers:
        column, row = (cells - first).T
        p_occupied[row, column] = p
    x, y = (first * edge).tolist()
    return GridMap(p_occupied, (x, y, 0.0), edge)


def find_ground(known: CellProbabilities, positions: Float, cell: float) -> GroundMap:
    """The ground, as level surface shows it; see `project_obstacles`."""
    cells = known.cells[known.p_occupied >= STANDS].reshape(-1, 3)
    floor = cells[is_level(cells)] if len(cells) else cells
    return fit_ground(np.asarray((floor + 0.5) * cell, np.float64), positions)


def is_level(cells: Int64) -> Bool:
    """(K,) cells (K, 3) without one right above: those of walls have one."""
    low = cells.min(axis=0)
    size = cells.max(axis=0) - low + 2
    key = np.ravel_multi_index(tuple((cells - low).T), tuple(size))
    return np.isin(key + 1, key, invert=True)


def count_up(counts: Int64) -> tuple[Int64, Int64]:
    """Of counts (n,): which one each is of, and its number, from 0 on: (m,) both."""
    of = np.repeat(np.arange(len(counts)), counts)
    return of, np.arange(len(of)) - np.repeat(np.cumsum(counts) - counts, counts)


class SweepView:
    """The planar view.

    Args:
        band: m above the ground, lowest and highest of obstacles.
    """

    def __init__(self, band: tuple[float, float]) -> None:
        self._band = band
        self._positions = np.zeros((0, 3))  # of the sensor
        self._ground: GroundMap | None = None
        self._free = np.zeros((0, 2), np.int64)  # cells, each once

    def add(self, labels: CausalLabels, scan: MappedScan, pose: Float) -> None:
        """Add the free space of a sweep.

        Args:
            labels: of what was seen so far.
            scan: the sweep.
            pose: (4, 4) of the robot in the frame of the labels.
        """
        beams, T, edge = scan.beams, pose @ scan.beams.T_base_sensor, labels.resolution
        self._positions = np.concatenate([self._positions, T[None, :3, 3]])
        self._ground = find_ground(labels.known_cells(), self._positions, edge)
        near = beams.hit & (np.einsum("ni,ni->n", beams.points, beams.points) < _MAX_RANGE**2)
        ends = beams.points[near].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        free = _trace_low(T[:3, 3], ends, self._ground, _STEP * edge)
        cells = np.floor(free / edge).astype(np.int64)
        self._free = unique_cells(np.concatenate([self._free, cells]))[0]

    def draw(self, labels: CausalLabels) -> GridMap:
        """The view, in the frame of the labels; NaN: unknown."""
        assert self._ground is not None
        edge = labels.resolution
        near = self._select_near(labels.known_cells(is_seen_alone=True), edge)
        columns = project_cells(near, self._ground, self._band, edge)
        return _draw([(self._free, 0.0), (columns.cells, columns.p_occupied)], edge)

    def _select_near(self, seen: CellProbabilities, edge: float) -> CellProbabilities:
        from scipy import spatial  # slow to load

        tree = spatial.cKDTree(self._positions[:, :2])
        distance, _ = tree.query((seen.cells[:, :2] + 0.5) * edge)
        near = distance < _MAX_RANGE
        return CellProbabilities(seen.cells[near], seen.p_occupied[near], seen.free_prior)


def _trace_low(start: Float, ends: Float, ground: GroundMap, step: float) -> Float:
    """(n, 2) positions along beams where these run low above the ground.

    Args:
        start: (3,) of the sensor.
        ends: (N, 3).
        ground: height of the ground.
        step: m between positions.
    """
    length = np.linalg.norm(ends[:, :2] - start[:2], axis=1)
    top = start[2] - float(ground.height_at(start[None, :2])[0])
    bottom = ends[:, 2] - ground.height_at(ends[:, :2])
    low = (bottom < _CLEARANCE) & (length > _MARGIN)
    ends, length, bottom = ends[low], length[low], bottom[low]
    first = np.clip((top - _CLEARANCE) / np.maximum(top - bottom, 1e-6), 0.0, 1.0) * length
    counts = np.maximum(np.floor((length - _MARGIN - first) / step), 0.0).astype(np.int64)
    of, number = count_up(counts)
    share = (first[of] + (number + 0.5) * step) / length[of]
    return np.asarray(start[:2] + share[:, None] * (ends[of, :2] - start[:2]))
