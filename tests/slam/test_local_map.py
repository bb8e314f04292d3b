"""The local map: spacing and exact removal."""

import functools

import numpy as np
import pytest

from stillmap import _core
from stillmap.core import se2
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import SlamOptions, local_map
from stillmap.slam.local_map import LocalMap

OPTIONS = SlamOptions()


@functools.cache
def hall():
    return simulate(scene_by_name("hall", {"robot": {"scans": 120}}), 1)


def empty(e=None):
    recording = hall().recording
    e = np.full(recording.n_beams, 0.9, np.float32) if e is None else e
    grid = _core.OccupancyGrid2D(OPTIONS.resolution, 0.5)
    return LocalMap(grid, recording, e)


def assert_same(one, other):
    """Whatever a scan could be registered against."""
    first, alpha, beta = one.dense()
    rows, columns = np.indices(alpha.shape)
    cells = np.stack([columns + first[0], rows + first[1]], axis=-1).reshape(-1, 2)
    sums = np.stack([alpha, beta], axis=-1).reshape(-1, 2)
    np.testing.assert_array_equal(sums, other.alpha_beta(cells))
    points = hall().recording.points[hall().recording.hit][::7].copy()
    for T in hall().truth.T_world_base[::10]:
        costs, gradients = [], []
        for grid in (one, other):
            at = grid, points, np.ones(len(points), np.float32), T, 0.04, 2, 0.05, 0.2
            costs.append(_core.registration_cost(*at))
            gradients.append(_core.registration_gradient(*at))
        assert costs[0] == costs[1]
        np.testing.assert_array_equal(*gradients)


def test_removal_is_exact():
    poses = hall().truth.T_world_base
    e = np.random.default_rng(0).random(hall().recording.n_beams).astype(np.float32)
    whole, late = empty(e), empty(e)
    for t in range(0, 120, 4):
        for part in (whole, late) if t >= 60 else (whole,):
            part.add(t, poses[t], 0.1 * t)
    whole.remove_before(6.0)
    assert_same(whole.grid, late.grid)
    assert_same(late.grid, whole.grid)
    whole.remove_before(np.inf)
    assert not any(sums.any() for sums in whole.grid.dense()[1:])
    assert not whole.has_sensor(0)


@pytest.mark.parametrize(
    ("move", "kept"),
    [
        ((0.19, 0.0, 0.0), False),
        ((0.21, 0.0, 0.0), True),
        ((0.0, 0.0, -0.19), False),
        ((0.0, 0.0, 0.21), True),
        ((0.12, 0.0, 0.12), True),
    ],
)
def test_scans_are_spaced(monkeypatch, move, kept):
    # scan 1 is taken 0.2 s later, which counts as 0.04 of the 5 s that make a scan worth keeping
    monkeypatch.setattr(local_map, "SCAN_SPACING", 0.2 + 0.04)
    so_far, first = empty(), empty()
    so_far.add(0, np.eye(3), 0.0)
    first.add(0, np.eye(3), 0.0)
    so_far.add(1, se2.matrix(*move), 0.2)
    before, after = (one.grid.dense()[1].sum() for one in (first, so_far))
    assert (after > before) == kept


def test_sensors_are_spaced_separately():
    options = {"robot": {"scans": 80}, "laser": {"second_laser": True}}
    simulation = simulate(scene_by_name("hall", options), 1)
    recording, T = simulation.recording, simulation.truth.T_world_base
    assert recording.sensor[:4].tolist() == [0, 1, 0, 1]
    e = np.full(recording.n_beams, 0.9, np.float32)
    so_far = LocalMap(_core.OccupancyGrid2D(0.05, 0.5), recording, e)
    so_far.add(0, T[0], 0.0)
    assert so_far.has_sensor(0)
    assert not so_far.has_sensor(1)
    so_far.add(1, T[1], 0.0)  # as near as that: but it looks to the other side
    assert so_far.has_sensor(1)
