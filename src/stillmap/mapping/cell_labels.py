"""Occupancy of cells whose beams got other labels after the E-step."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.em.types import DYNAMIC_BELOW

Float = NDArray[np.float64]
Labels = NDArray[np.float32]

_STRAY_SHARE = 0.15  # of the time, of readings where nothing stands


def update_occupancy(
    recording: Recording,
    poses: Float,
    before: Labels,
    after: Labels,
    histories: em.CellHistories,
    occupied: em.CellProbabilities,
    threads: int = 1,
) -> em.CellProbabilities:
    """Occupancy of cells in which P(dynamic) or P(static) of the beams became less.

    P(dynamic) of a cell becomes less by the same factor as that of the beams that ended in it
    together: it belongs to the movers among them. The rest is clutter, which is an obstacle where
    it was there for much of the time: a stray reading of the floor is none. So does P(static).

    Args:
        recording: M beams.
        poses: (T, 3, 3) T_map_base.
        before, after: (M,) P(c = 1) of each beam.
        histories: with the surfels of the same cells.
        occupied: with the labels before.
        threads: number of threads; the result does not depend on it.
    """
    if not np.array_equal(occupied.cells, histories.cells):
        raise ValueError("occupied: expected the cells of the final E-step")
    sums, static = np.zeros((2, 2, len(occupied.cells)))
    for _, beams, data in iter_beams(recording, poses, release=[before, after]):
        surfel = histories.surfel_map.associate_beams(*data, threads)
        old, new = before[beams], after[beams]
        ended = np.flatnonzero((surfel >= 0) & (old < DYNAMIC_BELOW))
        for row, p_static in zip(sums, (old, new), strict=True):
            row += np.bincount(surfel[ended], 1.0 - p_static[ended], minlength=len(row))
        ended = np.flatnonzero((surfel >= 0) & ~np.isnan(old))
        for row, p_static in zip(static, (old, np.minimum(old, new)), strict=True):
            row += np.bincount(surfel[ended], p_static[ended], minlength=len(row))
    factor, kept = (
        np.divide(new, old, out=np.ones(len(old)), where=old > 0.0) for old, new in (sums, static)
    )
    share = histories.occupied_share
    p_clutter = histories.p_in_cell * share / (share + _STRAY_SHARE)
    factor = np.minimum(factor, 1.0)
    p = kept * (factor * occupied.p_occupied + (1.0 - factor) * p_clutter)
    return dataclasses.replace(occupied, p_occupied=p.astype(np.float32))
