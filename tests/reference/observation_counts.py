"""Number of time bins in which cells were observed, and were clear of moving objects."""

# ruff: noqa: ARG002  (threads: as the kernels have it)

import itertools
from collections import Counter
from functools import partial

import numpy as np

from reference.beam_counting import passed_cells, usable_beams
from reference.no_return_beams import beams_in_runs, count_cells_within
from reference.occupancy_grid import Cell, OccupancyGrid
from reference.ray_traversal import cell_of

MAX_COUNT = 65535  # counts saturate


class ObservationCounts:
    """Number of time bins in which each cell was observed, and was observed clear.

    Args:
        resolution: edge of a cell, metres.
        dimension: 2 or 3.
        radius: metres between cell centres within which a dynamic return makes a cell not
            clear.
        stop_cells: (S, D) beams without a return are not trusted from these cells on; None:
            they are trusted up to their end cell.
        end_margin: metres before their end in which they are not trusted.
    """

    def __init__(self, resolution, dimension, *, radius, stop_cells=None, end_margin=0.0):
        if not (radius >= 0 and end_margin >= 0):
            raise ValueError("radius, end_margin: expected lengths that are not negative")
        self.grid = OccupancyGrid(resolution, dimension)  # where cells lie
        self.radius = radius
        self.stop_cells = (
            None if stop_cells is None else set(map(tuple, np.asarray(stop_cells).tolist()))
        )
        self.end_margin = end_margin
        self.observed: Counter[Cell] = Counter()
        self.clear: Counter[Cell] = Counter()

    def add(self, points, hit, is_dynamic, offset, T_map_sensor, time_bin, threads=1):
        """Add scans; `is_dynamic` (M,): dynamic hits, `time_bin` (T,): time bin of each scan."""
        beams = list(usable_beams(self.grid.dimension, points, hit, offset, T_map_sensor))
        moves, number = np.asarray(is_dynamic, bool), np.asarray(time_bin, np.int64)
        in_rows = beams_in_runs(beams)
        for wanted in np.unique(number):
            mine = [beam for beam in beams if number[beam.scan] == wanted]
            seen = set().union(*(self._observed_cells(beam, in_rows) for beam in mine))
            ends = [beam for beam in mine if beam.hit and moves[beam.number]]
            self.observed.update(seen)
            self.clear.update(seen - self._cells_near(ends))

    def dense(self, first_cell, shape):
        """Observed and clear counts over a box of cells, axes as of `OccupancyGrid.dense`."""
        observed, clear = np.zeros(shape, np.uint16), np.zeros(shape, np.uint16)
        for cell, count in self.observed.items():
            index = tuple((np.array(cell) - np.asarray(first_cell))[::-1].tolist())
            if all(0 <= i < n for i, n in zip(index, shape, strict=True)):
                observed[index], clear[index] = (
                    min(count, MAX_COUNT),
                    min(self.clear[cell], MAX_COUNT),
                )
        return observed, clear

    def _observed_cells(self, beam, in_rows):
        """Cells that a beam observes: those where it adds to the sums of (10)."""
        way = list(passed_cells(self.grid, beam))
        if beam.hit:
            return {cell for cell, chord in way if chord > 0} | {self._end(beam)}
        if self.stop_cells is not None:
            length = float(np.linalg.norm(beam.end - beam.start))
            limit = length - self.end_margin if beam.number in in_rows else 0.0
            way = way[: count_cells_within(way, self.stop_cells, limit / self.grid.resolution)]
        return {cell for cell, chord in way if chord > 0}

    def _cells_near(self, ends):
        """Cells near dynamic returns."""
        reach = self.radius / self.grid.resolution * (1 + 1e-9)
        span = range(-int(reach), int(reach) + 1)
        steps = [
            step
            for step in itertools.product(span, repeat=self.grid.dimension)
            if np.linalg.norm(step) <= reach
        ]
        cells = {self._end(beam) for beam in ends}
        return {tuple((np.array(c) + step).tolist()) for c in cells for step in steps}

    def _end(self, beam):
        return tuple(cell_of(beam.end, self.grid.resolution).tolist())


ObservationCounts2D = partial(ObservationCounts, dimension=2)
ObservationCounts3D = partial(ObservationCounts, dimension=3)
