"""EM with fixed poses: the loop of Fig. 2 without its registration."""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import reference  # the package itself: its names are looked up when called


@dataclass(frozen=True)
class EmStep:
    """One M-step and the E-step after it."""

    grid: Any  # the map of the M-step
    e: NDArray[np.float32]  # (M,) after the E-step
    bound_after_m: float  # nats, with the e that the map was made from
    bound: float  # nats, with the new e: ln p(z | x, m)


def m_step_map(points, hit, e, offset, T_map_sensor, resolution, kernels=None):
    """Equations (10) to (15) for fixed poses: the grid whose m_j maximises (5)."""
    k = kernels or reference
    grid = (
        k.OccupancyGrid2D(resolution) if np.shape(points)[1] == 2 else k.OccupancyGrid3D(resolution)
    )
    k.add_beams(grid, points, hit, e, offset, T_map_sensor)
    return grid


def em_fixed_poses(points, hit, offset, T_map_sensor, prior, resolution, iterations, kernels=None):
    """Fig. 2 with given poses: e := p, then M-step and E-step in turn.

    Args:
        points: (M, D) metres, sensor frame.
        hit: (M,) bool.
        offset: (T+1,).
        T_map_sensor: (T, D+1, D+1), kept as it is.
        prior: p(c), in [0, 1].
        resolution: metres.
        iterations: how many times both steps are done.
        kernels: a module with the same functions, `reference` by default.
    """
    k = kernels or reference
    beams = points, hit, offset, T_map_sensor
    e = np.full(len(np.asarray(points)), prior, np.float32)
    history = []
    for _ in range(iterations):
        grid = m_step_map(points, hit, e, offset, T_map_sensor, resolution, k)
        after_m = k.log_likelihood(grid, points, hit, e, offset, T_map_sensor, prior)
        e = k.e_step(grid, *beams, prior)
        after_e = k.log_likelihood(grid, points, hit, e, offset, T_map_sensor, prior)
        history.append(EmStep(grid, e, float(after_m.sum()), float(after_e.sum())))
    return history
