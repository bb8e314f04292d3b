"""Beams without a return: which of them are evidence of free space, and up to which range."""

# ruff: noqa: ARG001  (threads: as the kernels have it)

from itertools import accumulate

import numpy as np

from reference.beam_counting import passed_cells, usable_beams

MIN_RUN = 3  # adjacent beams without a return; shorter runs are not trusted


def beams_in_runs(beams):
    """Numbers of the beams without a return in runs of at least MIN_RUN."""
    scan_of = {beam.number: beam.scan for beam in beams if not beam.hit}
    found: set[int] = set()
    for first in scan_of:
        row = range(first, first + MIN_RUN)
        if all(scan_of.get(n) == scan_of[first] for n in row):
            found.update(row)
    return found


def add_no_return_beams(
    grid, rest, points, hit, offset, T_map_sensor, stop_cells, end_margin, threads=1
):
    """Add beams without a return as `add_beams` does, the trusted part to `grid`.

    The remainder goes to `rest`. Runs of fewer than MIN_RUN beams are not trusted. The others are
    trusted up to the first of `stop_cells` (S, D), and not in cells that they leave within the
    last `end_margin` metres.
    """
    if not end_margin >= 0:
        raise ValueError(f"end_margin: expected a length that is not negative, got {end_margin}")
    opaque = {tuple(cell) for cell in np.asarray(stop_cells, np.int64).tolist()}
    beams = list(usable_beams(grid.dimension, points, hit, offset, T_map_sensor))
    trusted = beams_in_runs(beams)
    for beam in beams:
        if beam.hit:
            continue
        way = list(passed_cells(grid, beam))
        length = float(np.linalg.norm(beam.end - beam.start))
        limit = (length - end_margin) / grid.resolution if beam.number in trusted else 0.0
        n = count_cells_within(way, opaque, limit)
        for k, (cell, chord) in enumerate(way):
            (grid if k < n else rest).add(cell, 0.0, chord)


def count_cells_within(way, opaque, limit):
    """Number of leading cells that are left within `limit` cells and are not `opaque`."""
    left_at = accumulate(chord for _, chord in way)
    for k, ((cell, _), left) in enumerate(zip(way, left_at, strict=True)):
        if cell in opaque or left > limit:
            return k
    return len(way)
