"""E-steps by counting: the printed one, (6) and (8), with its likelihood (5); and the hit ratio.

The hit ratio alpha / (alpha + beta) of a reflection map (Haehnel et al.) is what mappers without a
model of dynamics use: a cell is free where more beams pass than end.
"""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_beams, iter_chunks
from stillmap.core.recording import Recording
from stillmap.em.occupancy_grid import BLOCK_CELLS
from stillmap.em.types import CellProbabilities, EStepResult, Float, Grid, Likelihood, fill_beams

MIN_HIT_RATIO = 0.25  # hits / (hits + passes) below which such mappers drop a cell


def paper_e_step(
    recording: Recording, poses: Float, grid: Grid, prior: float, threads: int = 1
) -> EStepResult:
    """The printed E-step.

    Args:
        recording: 2D or 3D, M beams.
        poses: (T, D+1, D+1) T_map_base.
        grid: counts (10).
        prior: p(c = 1).
        threads: does not change the result.
    """
    e = recording.allocate_per_beam(np.float32)
    for _, beams, data in iter_beams(recording, poses, release=[e]):
        e[beams] = _core.e_step(grid, *data, prior, threads)  # (6), (8)
    return EStepResult(e, log_likelihood(recording, poses, grid, e, prior, threads))


def log_likelihood(
    recording: Recording,
    poses: Float,
    grid: Grid,
    e: NDArray[np.float32],
    prior: float,
    threads: int = 1,
) -> Likelihood:
    """Expected log likelihood (5) and the bound of EM at the map of `grid`."""
    total = np.zeros(4)  # the terms of (5), and the entropy of the posterior
    for _, beams, (points, hit, offset, T) in iter_beams(recording, poses, release=[e]):
        per_scan = _core.log_likelihood(grid, points, hit, e[beams], offset, T, prior, threads)
        total += per_scan.sum(axis=0)
    expected = float(total[:3].sum())  # (5)
    return Likelihood(expected=expected, bound=expected + float(total[3]))


def hit_ratio_e_step(
    recording: Recording, poses: Float, grid: _core.OccupancyGrid2D, threads: int = 1
) -> EStepResult:
    """P(static) by the hit ratio r of the end cell, 1/2 at the threshold MIN_HIT_RATIO.

    Args:
        recording: 2D.
        poses: (T, 3, 3) T_map_base.
        grid: counts with e = 1, so that r = alpha / (alpha + beta).
        threads: does not change the result.

    The odds are those of r relative to those of the threshold: monotone in r, and above one half
    exactly where such mappers keep the cell.
    """
    # (8) with prior 1 - threshold is exactly r (1 - threshold) / (r (1 - threshold) + ...)
    prior = 1.0 - MIN_HIT_RATIO
    found = paper_e_step(recording, poses, grid, prior, threads)
    p = found.p_static
    for _, beams, _ in iter_chunks(recording, release=[p]):
        points, hit = recording.points[beams], recording.hit[beams]
        p[beams] = fill_beams(points, hit, p[beams], prior)
    return EStepResult(p, found.likelihood, threshold_hit_ratio(grid))


def threshold_hit_ratio(grid: _core.OccupancyGrid2D) -> CellProbabilities:
    """Occupancy 1 where alpha / (alpha + beta) reaches the threshold MIN_HIT_RATIO, else 0."""
    found, stands = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.float32)]
    for first in grid.block_cells:
        _, alpha, beta = grid.dense(first.tolist(), (BLOCK_CELLS, BLOCK_CELLS))
        rows = np.argwhere(alpha > 0.0)
        alpha, beta = alpha[tuple(rows.T)], beta[tuple(rows.T)]
        found.append(rows[:, ::-1] + first)
        stands.append((alpha / (alpha + beta) >= MIN_HIT_RATIO).astype(np.float32))
    cells, p_occupied = np.concatenate(found), np.concatenate(stands)
    order = np.lexsort(cells.T)  # row by row
    return CellProbabilities(cells[order], p_occupied[order], 0.0)
