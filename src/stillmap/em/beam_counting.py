"""E-steps by counting: the printed one, (6) and (8), with its likelihood (5); and the hit ratio.

The hit ratio alpha / (alpha + beta) of a reflection map (Haehnel et al.) is what mappers without a
model of dynamics use: a cell is free where more beams pass than end.
"""

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Float, Float32
from stillmap.core.chunks import iter_beams, iter_chunks
from stillmap.core.recording import Recording
from stillmap.em.occupancy_grid import BLOCK_CELLS
from stillmap.em.types import CellProbabilities, EStepResult, Grid, Likelihood, fill_beams

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
    recording: Recording, poses: Float, grid: Grid, e: Float32, prior: float, threads: int = 1
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
    by_ratio = paper_e_step(recording, poses, grid, prior, threads)
    p = by_ratio.p_static
    for _, beams, _ in iter_chunks(recording, release=[p]):
        points, hit = recording.points[beams], recording.hit[beams]
        p[beams] = fill_beams(points, hit, p[beams], prior)
    return EStepResult(p, by_ratio.likelihood, threshold_hit_ratio(grid))


def threshold_hit_ratio(grid: _core.OccupancyGrid2D) -> CellProbabilities:
    """Occupancy 1 where alpha / (alpha + beta) reaches the threshold MIN_HIT_RATIO, else 0."""
    hit_cells, occupied = [np.zeros((0, 2), np.int64)], [np.zeros(0, np.float32)]
    for first in grid.block_cells:
        _, alpha, beta = grid.dense(first.tolist(), (BLOCK_CELLS, BLOCK_CELLS))
        rows = np.argwhere(alpha > 0.0)
        alpha, beta = alpha[tuple(rows.T)], beta[tuple(rows.T)]
        hit_cells.append(rows[:, ::-1] + first)
        occupied.append((alpha / (alpha + beta) >= MIN_HIT_RATIO).astype(np.float32))
    cells, p_occupied = np.concatenate(hit_cells), np.concatenate(occupied)
    order = np.lexsort(cells.T)  # row by row
    return CellProbabilities(cells[order], p_occupied[order], 0.0)


Box = tuple[float, float, float, float]


def beam_boxes(recording: Recording, poses: Float) -> Float:
    """(T, 4) x0, y0, x1, y1 in metres of the box around the beams of each scan; 2D.

    Args:
        recording: T scans.
        poses: (T, 3, 3) T_map_base.
    """
    out = np.empty((recording.n_scans, 4))
    for scans, _, (points, _, offset, T) in iter_beams(recording, poses):
        count = np.diff(offset)
        scan = np.repeat(np.arange(len(count)), count)
        ends = np.einsum("nij,nj->ni", T[scan, :2, :2], points) + T[scan, :2, 2]
        low, high = T[:, :2, 2].copy(), T[:, :2, 2].copy()
        some = count > 0
        first = offset[:-1][some]
        if len(first):
            low[some] = np.fmin(low[some], np.fmin.reduceat(ends, first))
            high[some] = np.fmax(high[some], np.fmax.reduceat(ends, first))
        out[scans] = np.concatenate([low, high], axis=1)
    return out


def count_in_window(
    recording: Recording,
    poses: Float,
    e: Float32,
    boxes: Float,
    window: Box,
    resolution: float,
    max_scans: int | None = None,
) -> _core.OccupancyGrid2D:
    """A grid whose counts (10) within a window are those of all beams.

    Args:
        recording: T scans with M beams; 2D.
        poses: (T, 3, 3) T_map_base.
        e: (M,) P(static).
        boxes: (T, 4) of `beam_boxes`.
        window: x0, y0, x1, y1 in metres.
        resolution: edge of a cell in metres.
        max_scans: if the beams of more scans come near the window, every k-th of them counts;
            None: all count.
    """
    grid = _core.OccupancyGrid2D(resolution, moments=False)
    x0, y0, x1, y1 = boxes.T
    is_near = (x0 <= window[2]) & (y0 <= window[3]) & (x1 >= window[0]) & (y1 >= window[1])
    near = np.flatnonzero(is_near)
    if max_scans is not None:
        near = near[:: max(-(-len(near) // max_scans), 1)]
    T_map_sensor = recording.T_map_sensor(poses)
    for t in recording.iter_scans(near.tolist(), e):
        beams = recording.beams_of(t)
        offset = np.array([0, beams.stop - beams.start])
        points, hit = recording.points[beams], recording.hit[beams]
        _core.add_beams(grid, points, hit, e[beams], offset, T_map_sensor[t : t + 1])
    return grid
