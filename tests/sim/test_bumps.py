"""Bumps show a planar laser the floor; in blind stretches nothing returns."""

import math

import numpy as np
import pytest

from stillmap.sim import scene_by_name, simulate
from stillmap.sim.laser import Returns
from stillmap.sim.options import LaserOptions, RobotOptions
from stillmap.sim.planar import FLOOR, Bumps, add_floor, find_blind_scans, simulate_bumps

EXACT = {"beams": 90, "range_noise": 0.0, "no_return_share": 0.0, "glass_no_return_share": 0.0}


def hall(**changes):
    usual = {"robot": {"scans": 300}, "crowd": {"people": 6}}
    sections = {**usual, **{k: {**usual.get(k, {}), **v} for k, v in changes.items()}}
    return simulate(scene_by_name("hall", sections), 2)


def ranges(run):
    r = np.hypot(*run.recording.points.T.astype(float))
    return r.reshape(run.recording.n_scans, -1)


def test_pitch_is_a_half_wave():
    bumps = Bumps(np.array([1.0]), np.array([0.5]), np.array([[0.04, -0.01]]))
    tilt = bumps.tilt(np.array([0.9, 1.25, 1.0 + 0.5 / 6, 1.6]))
    np.testing.assert_allclose(tilt[1], [0.04, -0.01])
    np.testing.assert_allclose(tilt[2], [0.02, -0.005])
    np.testing.assert_array_equal(tilt[[0, 3]], 0.0)


def test_floor_ahead_is_a_line_across_the_pitch():
    bearing = np.radians([[0.0, 60.0, 120.0, -60.0]])
    none = np.full((1, 4), -1, np.int32)
    exact = Returns(np.full((1, 4), 9.0), np.zeros((1, 4), np.int32), none)
    seen = add_floor(exact, bearing, np.tile([math.asin(0.05), 0.0], (1, 4, 1)), 0.3)
    # 0.3 / 0.05 = 6 m ahead, 12 m at 60 degrees, and behind there is the ceiling
    np.testing.assert_allclose(seen.range, [[6.0, 9.0, 9.0, 9.0]])
    np.testing.assert_array_equal(seen.mover, [[FLOOR, -1, -1, -1]])
    np.testing.assert_array_equal(seen.wall, [[-1, 0, 0, 0]])
    tail = add_floor(exact, bearing, np.tile([-math.asin(0.1), 0.0], (1, 4, 1)), 0.3)
    np.testing.assert_allclose(tail.range, [[9.0, 9.0, 6.0, 9.0]])
    left = add_floor(exact, bearing, np.tile([0.0, math.asin(0.05)], (1, 4, 1)), 0.3)
    np.testing.assert_allclose(left.range[0, 1:3], 6.0 / math.sin(math.radians(60)))


def test_bumps_come_at_their_rate():
    robot = np.column_stack([np.arange(4001) * 0.1, np.zeros((4001, 2))])
    options = RobotOptions(bump_rate=0.5, bump_pitch=0.06, bump_time=0.8)
    bumps = simulate_bumps(robot, np.arange(4001) * 0.2, options, np.random.default_rng(0))
    assert 160 <= len(bumps.start) <= 240  # 400 m
    assert 0.4 <= bumps.duration.min() < 0.5 < 1.1 < bumps.duration.max() <= 1.2
    pitch = np.abs(bumps.peak[:, 0])
    assert 0.03 <= pitch.min() < 0.04 < 0.08 < pitch.max() <= 0.09
    assert 0.35 < (bumps.peak[:, 0] > 0).mean() < 0.65
    np.testing.assert_array_equal(bumps.peak[:, 1], 0.0)


def test_bumps_shorten_beams_only_and_the_floor_is_not_static():
    plain = hall(laser=EXACT)
    bumpy = hall(laser=EXACT, robot={"bump_rate": 1.5})
    np.testing.assert_array_equal(plain.truth.T_world_base, bumpy.truth.T_world_base)
    np.testing.assert_array_equal(plain.recording.T_odom_base, bumpy.recording.T_odom_base)
    floor = (bumpy.truth.mover == FLOOR).reshape(300, -1)
    assert 0.01 < floor.mean() < 0.2
    assert not bumpy.truth.static.reshape(300, -1)[floor].any()
    a, b = ranges(plain), ranges(bumpy)
    np.testing.assert_array_equal(a[~floor], b[~floor])
    assert np.all(b[floor] < a[floor])
    # on lines ahead, or of a few that look backwards none: the field of view is half a circle
    x = bumpy.recording.points[:, 0].reshape(300, -1)
    for scan in np.flatnonzero(floor.sum(axis=1) > 3):
        assert np.ptp(x[scan, floor[scan]]) < 1e-4


def test_blind_stretches_take_their_time():
    seconds = np.arange(2000) * 0.2
    options = LaserOptions(blind_stretches=4, blind_time=30.0, blind_at=0.1)
    blind = find_blind_scans(seconds, options, np.random.default_rng(5))
    edges = np.diff(blind.astype(int))
    assert 1 <= np.count_nonzero(edges == 1) <= 5
    assert blind[200:350].all()  # from 40 to 70 s
    only = LaserOptions(blind_stretches=4, blind_time=30.0)
    blind = find_blind_scans(seconds, only, np.random.default_rng(5))
    assert blind.sum() == pytest.approx(4 * 150, abs=4)
    assert not find_blind_scans(seconds, LaserOptions(), np.random.default_rng(5)).any()


def test_nothing_returns_in_a_blind_stretch():
    plain = hall(laser={"beams": 60})
    run = hall(laser={"beams": 60, "blind_at": 0.5, "blind_time": 6.0, "blind_stretches": 1})
    hit = run.recording.hit.reshape(300, -1)
    blind = ~hit.any(axis=1)
    assert blind[150:179].all()
    assert 30 <= blind.sum() <= 61
    np.testing.assert_allclose(ranges(run)[blind], 30.0, rtol=1e-6)
    np.testing.assert_array_equal(ranges(run)[~blind], ranges(plain)[~blind])
    assert not run.truth.static.reshape(300, -1)[blind].any()
