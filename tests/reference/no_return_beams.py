"""Beams without a return: which of them tell something, and up to where."""

from collections.abc import Sequence
from itertools import accumulate

import numpy as np
from numpy.typing import ArrayLike

from reference.beam_counting import Beam, passed_cells, usable_beams
from reference.occupancy_grid import Cell, OccupancyGrid

IN_A_ROW = 3  # beams without a return that did not just get lost


def in_a_row(beams: Sequence[Beam]) -> set[int]:
    """Numbers of beams without a return that have others beside them, IN_A_ROW at least."""
    scan_of = {beam.number: beam.scan for beam in beams if not beam.hit}
    found: set[int] = set()
    for first in scan_of:
        row = range(first, first + IN_A_ROW)
        if all(scan_of.get(n) == scan_of[first] for n in row):
            found.update(row)
    return found


def add_no_return_beams(
    grid: OccupancyGrid,
    rest: OccupancyGrid,
    points: ArrayLike,
    hit: ArrayLike,
    offset: ArrayLike,
    T_map_sensor: ArrayLike,
    stop_cells: ArrayLike,
    end_margin: float,
    threads: int = 1,  # noqa: ARG001  the core's signature
) -> None:
    """Add what `add_beams` adds for beams without a return: to `grid` as far as they are believed.

    What they are not believed about goes to `rest`. Fewer than IN_A_ROW of them side by side are
    not believed. The others are up to the first of `stop_cells` (S, D), and not about cells that
    they leave within the last `end_margin` metres.
    """
    if not end_margin >= 0:
        raise ValueError(f"end_margin: expected a length that is not negative, got {end_margin}")
    opaque = {tuple(cell) for cell in np.asarray(stop_cells, np.int64).tolist()}
    beams = list(usable_beams(grid.dimension, points, hit, offset, T_map_sensor))
    told = in_a_row(beams)
    for beam in beams:
        if beam.hit:
            continue
        way = list(passed_cells(grid, beam))
        length = float(np.linalg.norm(beam.end - beam.start))
        limit = (length - end_margin) / grid.resolution if beam.number in told else 0.0
        n = cells_within(way, opaque, limit)
        for k, (cell, chord) in enumerate(way):
            (grid if k < n else rest).add(cell, 0.0, chord)


def cells_within(way: Sequence[tuple[Cell, float]], opaque: set[Cell], limit: float) -> int:
    """How many of the first cells are left within `limit` cell widths, with none of `opaque`."""
    left_at = accumulate(chord for _, chord in way)
    for k, ((cell, _), left) in enumerate(zip(way, left_at, strict=True)):
        if cell in opaque or left > limit:
            return k
    return len(way)
