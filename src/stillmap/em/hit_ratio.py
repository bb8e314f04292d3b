"""The rule of today's mappers: a cell that more beams pass than hit is free."""

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em import paper
from stillmap.em.chunks import chunks
from stillmap.em.expectations import CellProbabilities, Expectations, per_beam
from stillmap.recording.model import Recording

Float = NDArray[np.float64]


def e_step(
    recording: Recording, poses: Float, grid: _core.Grid2D, threshold: float, threads: int = 1
) -> Expectations:
    """p_static by the hit ratio r of the end cell, 1/2 at the threshold.

    Args:
        recording: 2D.
        poses: (T, 3, 3) T_map_base.
        grid: of every hit counted as static: r = alpha / (alpha + beta).
        threshold: ratio below which a cell is dropped.
        threads: same result with any number.

    The odds are those of r against those of the threshold: in the order of r, and with hard
    decisions where the mappers make them.
    """
    # (8) with prior 1 - threshold is exactly r (1 - threshold) / (r (1 - threshold) + ...)
    found = paper.e_step(recording, poses, grid, 1.0 - threshold, threads)
    p = found.p_static
    for _, beams, _ in chunks(recording, beside=[p]):
        p[beams] = per_beam(
            recording.points[beams], recording.hit[beams], p[beams], 1.0 - threshold
        )
    return Expectations(p, found.likelihood, kept_cells(grid, threshold))


def kept_cells(grid: _core.Grid2D, threshold: float) -> CellProbabilities:
    """One where alpha / (alpha + beta) reaches the threshold, else zero."""
    first, alpha, beta = grid.dense()
    ratio = np.divide(alpha, alpha + beta, out=np.zeros_like(alpha), where=alpha + beta > 0.0)
    rows = np.argwhere(alpha > 0.0)
    cells = np.ascontiguousarray(rows[:, ::-1] + first)
    keeps = ratio[tuple(rows.T)] >= threshold
    return CellProbabilities(cells, keeps.astype(np.float32), 0.0)
