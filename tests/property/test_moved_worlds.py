"""A map and a prior that are moved together move what a sweep is registered to."""

import numpy as np
import pytest

from stillmap import _core
from stillmap.core import se3

FIT = {
    "min_weight": 4.0,
    "max_flatness": 0.2,
    "min_extent": 0.02,
    "range_std": 0.03,
    "kernel_width": 3.0,
    "information_scale": 0.5,
}
STEPS = {"start_level": 1, "start_slack": 0.1, "max_iterations": 20, "tolerance": 1e-6}


def corner(seed):
    rng = np.random.default_rng(seed)
    points = rng.uniform(-2.0, 3.0, (4000, 3))
    points[np.arange(4000), rng.integers(0, 3, 4000)] = -2.0
    return (points + rng.normal(0.0, 0.01, points.shape)).astype(np.float32)


def registered(world):
    local = _core.NdtMap3D(0.5, 3, 100.0)
    points, weights = corner(1), np.ones(4000, np.float32)
    local.add(points, weights, world)
    prior = world @ se3.exp(np.array([0.05, -0.04, 0.03, 0.01, -0.02, 0.015]))
    sweep = corner(2)
    times = np.zeros(4000, np.float32)
    information = np.diag([1.0] * 6 + [100.0] * 6)
    T, *_ = _core.register_sweep(
        local, sweep, weights, times, prior, np.zeros(6), information, **FIT, **STEPS, threads=1
    )
    return T


def test_moved_by_whole_cells():
    shift = np.eye(4)
    shift[:3, 3] = np.array([3.0, -5.0, 7.0]) * 2.0  # edges of the coarsest cells
    assert registered(shift) == pytest.approx(shift @ registered(np.eye(4)), abs=1e-6)


@pytest.mark.parametrize("seed", range(4))
def test_moved_anyhow(seed):
    """Other cells make slightly other planes."""
    world = se3.exp(np.random.default_rng(seed).normal(0.0, [10.0] * 3 + [0.8] * 3))
    apart = se3.log(np.linalg.inv(world @ registered(np.eye(4))) @ registered(world))
    assert np.abs(apart[:3]).max() < 0.005
    assert np.abs(apart[3:]).max() < 0.002
