"""The printed E-step (6), (8) and its likelihood (5)."""

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em.chunks import chunks
from stillmap.em.expectations import Expectations, Grid, Likelihood
from stillmap.recording.model import Recording

Float = NDArray[np.float64]


def e_step(
    recording: Recording, poses: Float, grid: Grid, prior: float, threads: int = 1
) -> Expectations:
    """e of (6), (8) for every beam, and (5) at the map of `grid`."""
    e = recording.per_beam(np.float32)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in chunks(recording, beside=[e]):
        e[beams] = _core.e_step(
            grid,
            recording.points[beams],
            recording.hit[beams],
            offset,
            T_map_sensor[scans],
            prior,
            threads,
        )
    return Expectations(e, log_likelihood(recording, poses, grid, e, prior, threads))


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
    for scans, beams, offset in chunks(recording, beside=[e]):
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
