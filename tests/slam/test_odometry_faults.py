"""Wrong odometry, no odometry, and two lasers."""

import dataclasses
import functools
from itertools import accumulate

import numpy as np
import pytest
from marks import slow_params
from rooms import drive

from stillmap.core import se2
from stillmap.results.eval.trajectory import compute_absolute_errors
from stillmap.sim import scene_by_name, simulate
from stillmap.slam import SlamOptions, m_step, odometry_2d

OPTIONS = SlamOptions()


def silent(*_):
    """Ignores progress."""


def followed(recording):
    e = np.full(recording.n_beams, 0.9, np.float32)
    return odometry_2d.register_scans(recording, e, OPTIONS, silent)


@functools.cache
def room():
    """Ahead, a quarter turn from scan 48 on, and ahead again."""
    return drive(2, laser={"range_noise": 0.01, "max_range": 8.0}, robot={"scans": 80})


def survived(T_odom_base):
    """The scans where odometry was disbelieved; poses are as good as ever."""
    recording = dataclasses.replace(room().recording, T_odom_base=T_odom_base)
    found = followed(recording)
    assert compute_absolute_errors(found.poses, room().truth.T_world_base).rmse < 0.01
    assert found.diagnostics.breaks == []
    return found.diagnostics.odometry_faults


def steps():
    T = room().recording.T_odom_base
    return se2.inverse(T[:-1]) @ T[1:]


def chained(steps):
    return np.array([*accumulate(steps, np.matmul, initial=np.eye(3))])


def test_valid_odometry_is_accepted():
    assert survived(room().recording.T_odom_base) == []


@pytest.mark.parametrize(
    "origin", [(0.0, 0.0, 0.0), (-25.0, 40.0, 2.0), (3000.0, -1000.0, -3.0)], ids=str
)
def test_odometry_restart(origin):
    T = room().recording.T_odom_base.copy()
    T[30:] = se2.matrix(*origin) @ se2.inverse(T[30]) @ T[30:]
    assert survived(T) == [30]


def test_slip_while_turning():
    turn = room().truth.T_world_base[[44, 62]]
    assert abs(se2.parameters(se2.inverse(turn[0]) @ turn[1])[2]) > np.radians(80)
    moved = steps()
    moved[44:62] = np.eye(3)
    disagreeing = survived(chained(moved))
    assert len(disagreeing) >= 10
    assert set(disagreeing) <= set(range(45, 63))


def test_slip_while_driving():
    way = room().truth.T_world_base[[15, 40]]
    assert np.linalg.norm(way[1] - way[0]) > 2.0
    moved = steps()
    moved[15:40] = np.eye(3)
    disagreeing = survived(chained(moved))
    assert len(disagreeing) >= 20
    assert set(disagreeing) <= set(range(16, 41))


@pytest.mark.parametrize("times", [3.5, 0.0, -1.0], ids=["spinning", "blocked", "backwards"])
def test_wrong_wheel_odometry(times):
    moved = se2.parameters(steps())
    moved[20:30, 0] *= times
    assert survived(chained(se2.matrix(*moved.T))) == list(range(21, 31))


def picked(recording, scans):
    """Some of the scans of a recording, as often as they are named."""
    beams = np.concatenate([np.r_[recording.beams_of(t)] for t in scans])
    in_order = bool(np.all(np.diff(scans) > 0))
    return dataclasses.replace(
        recording,
        stamp_ns=recording.stamp_ns[scans if in_order else slice(len(scans))],
        offset=np.concatenate([[0], np.cumsum(np.diff(recording.offset)[scans])]),
        points=recording.points[beams],
        hit=recording.hit[beams],
        sensor=recording.sensor[scans],
        T_odom_base=recording.T_odom_base[scans],
    )


def error(recording, T_world_base):
    e = np.full(recording.n_beams, 0.9, np.float32)
    found = m_step(recording, e, OPTIONS, None, 1, silent)
    return compute_absolute_errors(found.poses, T_world_base).rmse


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
    options = {
        "robot": {"scans": 200 * (1 + both), "speed": 1.0},
        "laser": {"second_laser": both, "beams": 120},
    }
    simulation = simulate(scene_by_name("hall", options), seed)
    return error(simulation.recording, simulation.truth.T_world_base)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *slow_params(1)])
def test_two_lasers_without_odometry(seed):
    assert two_lasers(seed, both=True) < 1.2 * two_lasers(seed, both=False)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, *slow_params(1)])
def test_two_lasers_without_overlap_or_odometry(seed):
    options = {"robot": {"scans": 800}, "laser": {"second_laser": True}}
    simulation = simulate(scene_by_name("office", options), seed)
    recording = simulation.recording.without_odometry()
    assert error(recording, simulation.truth.T_world_base) < 0.04
