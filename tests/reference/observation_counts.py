"""In how many looks cells were looked at, and in how many of them nothing that moves was near."""

import itertools
from collections import Counter
from collections.abc import Sequence
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.beam_counting import Beam, passed_cells, usable_beams
from reference.no_return_beams import cells_within, in_a_row
from reference.occupancy_grid import Cell, OccupancyGrid
from reference.ray_traversal import cell_of

MOST = 65535  # looks are counted no further


class ObservationCounts:
    """Of each cell: the looks that saw it, and those of them that were clear.

    Args:
        resolution: edge of a cell, metres.
        dimension: 2 or 3.
        radius: metres around the end of a beam on something that moves within which a cell is not
            clear, between the middles of cells.
        stop_cells: (S, D) cells from which on beams without a return say nothing; None: they are
            believed all of their way, the end cell excepted.
        end_margin: metres before their end from which on they say nothing.
    """

    def __init__(
        self,
        resolution: float,
        dimension: int,
        *,
        radius: float,
        stop_cells: ArrayLike | None = None,
        end_margin: float = 0.0,
    ) -> None:
        if not (radius >= 0 and end_margin >= 0):
            raise ValueError("radius, end_margin: expected lengths that are not negative")
        self.grid = OccupancyGrid(resolution, dimension)  # where cells lie
        self.radius = radius
        self.stop_cells = (
            None if stop_cells is None else set(map(tuple, np.asarray(stop_cells).tolist()))
        )
        self.end_margin = end_margin
        self.looks: Counter[Cell] = Counter()
        self.clear: Counter[Cell] = Counter()

    def add(
        self,
        points: ArrayLike,
        hit: ArrayLike,
        is_dynamic: ArrayLike,
        offset: ArrayLike,
        T_map_sensor: ArrayLike,
        time_bin: ArrayLike,
        threads: int = 1,  # noqa: ARG002  the core's signature
    ) -> None:
        """Add scans; `is_dynamic` (M,): dynamic hits, `time_bin` (T,): time bin of each scan."""
        beams = list(usable_beams(self.grid.dimension, points, hit, offset, T_map_sensor))
        moves, number = np.asarray(is_dynamic, bool), np.asarray(time_bin, np.int64)
        in_rows = in_a_row(beams)
        for wanted in np.unique(number):
            mine = [beam for beam in beams if number[beam.scan] == wanted]
            seen = set().union(*(self._told_of(beam, in_rows) for beam in mine))
            ends = [beam for beam in mine if beam.hit and moves[beam.number]]
            self.looks.update(seen)
            self.clear.update(seen - self._disturbed(ends))

    def dense(
        self, first_cell: ArrayLike, shape: tuple[int, ...]
    ) -> tuple[NDArray[np.uint16], NDArray[np.uint16]]:
        """Looks and clear ones over a box of cells, axes as those of `OccupancyGrid.dense`."""
        looks, clear = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
        for cell, count in self.looks.items():
            index = tuple((np.array(cell) - np.asarray(first_cell))[::-1].tolist())
            if all(0 <= i < n for i, n in zip(index, shape, strict=True)):
                looks[index], clear[index] = min(count, MOST), min(self.clear[cell], MOST)
        return looks, clear

    def _told_of(self, beam: Beam, in_rows: set[int]) -> set[Cell]:
        """The cells that a beam tells something of: where it adds to the sums of (10)."""
        way = list(passed_cells(self.grid, beam))
        if beam.hit:
            return {cell for cell, chord in way if chord > 0} | {self._end(beam)}
        if self.stop_cells is not None:
            length = float(np.linalg.norm(beam.end - beam.start))
            limit = length - self.end_margin if beam.number in in_rows else 0.0
            way = way[: cells_within(way, self.stop_cells, limit / self.grid.resolution)]
        return {cell for cell, chord in way if chord > 0}

    def _disturbed(self, ends: Sequence[Beam]) -> set[Cell]:
        """The cells near the ends of beams on what moves."""
        reach = self.radius / self.grid.resolution * (1 + 1e-9)
        span = range(-int(reach), int(reach) + 1)
        steps = [
            step
            for step in itertools.product(span, repeat=self.grid.dimension)
            if np.linalg.norm(step) <= reach
        ]
        cells = {self._end(beam) for beam in ends}
        return {tuple((np.array(c) + step).tolist()) for c in cells for step in steps}

    def _end(self, beam: Beam) -> Cell:
        return tuple(cell_of(beam.end, self.grid.resolution).tolist())


ObservationCounts2D = partial(ObservationCounts, dimension=2)
ObservationCounts3D = partial(ObservationCounts, dimension=3)
