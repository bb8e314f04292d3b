"""Wrong odometry, no odometry, and two lasers."""

import dataclasses
import functools

import numpy as np
import pytest
from driven import ate, chained, mapped, picked, prior, silent
from marks import slow_params
from rooms import drive

from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import SlamOptions, odometry_2d


@functools.cache
def room():
    """Ahead, a quarter turn from scan 48 on, and ahead again."""
    return drive(2, laser={"range_noise": 0.01, "max_range": 8.0}, robot={"scans": 80})


def survived(T_odom_base):
    """The scans where odometry was disbelieved; poses are as good as ever."""
    recording = dataclasses.replace(room().recording, T_odom_base=T_odom_base)
    found = odometry_2d.register_scans(recording, prior(recording), SlamOptions(), silent)
    assert ate(found, room().truth) < 0.01
    assert found.diagnostics.breaks == []
    return found.diagnostics.odometry_faults


def steps():
    T = room().recording.T_odom_base
    return se2.inverse(T[:-1]) @ T[1:]


def test_valid_odometry_is_accepted():
    assert survived(room().recording.T_odom_base) == []


@pytest.mark.parametrize(
    "origin", [(0.0, 0.0, 0.0), (-25.0, 40.0, 2.0), (3000.0, -1000.0, -3.0)], ids=str
)
def test_odometry_restart(origin):
    T = room().recording.T_odom_base.copy()
    T[30:] = se2.matrix(*origin) @ se2.inverse(T[30]) @ T[30:]
    assert survived(T) == [30]


@pytest.mark.parametrize(("first", "last", "least"), [(44, 62, 10), (15, 40, 20)])
def test_slip_while_turning_and_while_driving(first, last, least):
    before, after = room().truth.T_world_base[[first, last]]
    x, y, turn = se2.parameters(se2.inverse(before) @ after)
    assert np.hypot(x, y) > 2.0 or abs(turn) > np.radians(80)
    moved = steps()
    moved[first:last] = np.eye(3)
    disagreeing = survived(chained(moved))
    assert len(disagreeing) >= least
    assert set(disagreeing) <= set(range(first + 1, last + 1))


@pytest.mark.parametrize("times", [3.5, 0.0, -1.0], ids=["spinning", "blocked", "backwards"])
def test_wrong_wheel_odometry(times):
    moved = se2.parameters(steps())
    moved[20:30, 0] *= times
    assert survived(chained(se2.matrix(*moved.T))) == list(range(21, 31))


def error(recording, T_world_base):
    return compute_absolute_errors(mapped(recording).poses, T_world_base).rmse


@functools.cache
def office(seed):
    return simulate(scene_by_name("office", {"robot": {"scans": 500}}), seed)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "seed"), [(1, 0), (3, 0), (1, 1), (3, 1)])
def test_without_odometry(n, seed):
    # a third of the scans: 0.3 m and up to 28 degrees from one to the next
    kept = np.arange(0, office(seed).recording.n_scans, n)
    recording, T = picked(office(seed).recording, kept), office(seed).truth.T_world_base[kept]
    with_odometry = error(recording, T)
    without = error(recording.without_odometry(), T)
    assert with_odometry < 0.04
    assert without < 1.5 * with_odometry + 0.01


def two_lasers(seed, both):
    robot = {"scans": 200 * (1 + both), "speed": 1.0}
    options = {"robot": robot, "laser": {"second_laser": both, "beams": 120}}
    simulation = simulate(scene_by_name("hall", options), seed)
    return ate(mapped(simulation.recording), simulation.truth)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *slow_params(1)])
def test_two_lasers_without_odometry(seed):
    assert two_lasers(seed, both=True) < 1.2 * two_lasers(seed, both=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *slow_params(1)])
def test_two_lasers_without_overlap_or_odometry(seed):
    options = {"robot": {"scans": 800}, "laser": {"second_laser": True}}
    simulation = simulate(scene_by_name("office", options), seed)
    assert ate(mapped(simulation.recording.without_odometry()), simulation.truth) < 0.04
