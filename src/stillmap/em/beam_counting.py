"""The printed E-step (6), (8) and its likelihood (5).

The rule of today's mappers: a cell that more beams pass than hit is free.
"""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording
from stillmap.em.types import CellProbabilities, EStepResult, Grid, Likelihood, fill_beams

Float = NDArray[np.float64]


def paper_e_step(
    recording: Recording, poses: Float, grid: Grid, prior: float, threads: int = 1
) -> EStepResult:
    """e of (6), (8) for every beam, and (5) at the map of `grid`."""
    e = recording.allocate_per_beam(np.float32)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(recording, release=[e]):
        e[beams] = _core.e_step(
            grid,
            recording.points[beams],
            recording.hit[beams],
            offset,
            T_map_sensor[scans],
            prior,
            threads,
        )
    return EStepResult(e, log_likelihood(recording, poses, grid, e, prior, threads))


def log_likelihood(
    recording: Recording,
    poses: Float,
    grid: Grid,
    e: NDArray[np.float32],
    prior: float,
    threads: int = 1,
) -> Likelihood:
    """(5) and the bound of EM, at the map of `grid`."""
    total = np.zeros(4)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(recording, release=[e]):
        per_scan = _core.log_likelihood(
            grid,
            recording.points[beams],
            recording.hit[beams],
            e[beams],
            offset,
            T_map_sensor[scans],
            prior,
            threads,
        )
        total += per_scan.sum(axis=0)
    expected = float(total[:3].sum())
    return Likelihood(expected=expected, bound=expected + float(total[3]))


def hit_ratio_e_step(
    recording: Recording,
    poses: Float,
    grid: _core.OccupancyGrid2D,
    threshold: float,
    threads: int = 1,
) -> EStepResult:
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
    found = paper_e_step(recording, poses, grid, 1.0 - threshold, threads)
    p = found.p_static
    for _, beams, _ in iter_chunks(recording, release=[p]):
        p[beams] = fill_beams(
            recording.points[beams], recording.hit[beams], p[beams], 1.0 - threshold
        )
    return EStepResult(p, found.likelihood, threshold_hit_ratio(grid, threshold))


def threshold_hit_ratio(grid: _core.OccupancyGrid2D, threshold: float) -> CellProbabilities:
    """One where alpha / (alpha + beta) reaches the threshold, else zero."""
    first, alpha, beta = grid.dense()
    ratio = np.divide(alpha, alpha + beta, out=np.zeros_like(alpha), where=alpha + beta > 0.0)
    rows = np.argwhere(alpha > 0.0)
    cells = np.ascontiguousarray(rows[:, ::-1] + first)
    keeps = ratio[tuple(rows.T)] >= threshold
    return CellProbabilities(cells, keeps.astype(np.float32), 0.0)
