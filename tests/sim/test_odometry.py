"""Odometry, stamps and mounts: exact without errors, wrong only as asked for; carried robots."""

import dataclasses

import numpy as np
import pytest
from marks import slow_params

from stillmap.core import se2
from stillmap.results.eval.readers import read_truth
from stillmap.sim import load_truth, scene_by_name, simulate, write_simulation
from stillmap.sim.episode import add_faults, delay_odometry, simulate_odometry
from stillmap.sim.options import OdometryOptions

PERFECT = OdometryOptions(0.0, 0.0, 0.4, 0.0, 0.0, 0.0)
SECONDS = np.arange(3001) * 0.2  # ten minutes


def moves(T):
    return se2.parameters(se2.inverse(T[:-1]) @ T[1:])


def round_a_ring(scans=3001):
    turn = SECONDS[:scans] * 0.1
    return se2.matrix(5 * np.sin(turn), 5 - 5 * np.cos(turn), turn)


def hall(seed=4, scans=60, beams=60, robot=None, **changes):
    usual = {"robot": {"scans": scans, **(robot or {})}, "laser": {"beams": beams}}
    return simulate(scene_by_name("hall", {**usual, **changes}), seed)


def arcs():
    """Poses along arcs, straight pieces and turns on the spot, in closed form per step."""
    steps = [(0.1, 0.0)] * 20 + [(0.1, 0.08)] * 30 + [(0.0, -0.1)] * 15 + [(0.08, -0.05)] * 40
    poses = [se2.matrix(3.0, -2.0, 0.7)]
    for d, turn in steps:
        radius = d / turn if turn else 0.0
        dx, dy = (radius * np.sin(turn), radius * (1 - np.cos(turn))) if turn else (d, 0.0)
        poses.append(poses[-1] @ se2.matrix(dx, dy, turn))
    return np.array(poses)


def test_perfect_wheels_give_the_true_motion():
    poses = arcs()
    odometry = simulate_odometry(poses, PERFECT, np.random.default_rng(0))
    np.testing.assert_allclose(odometry, se2.inverse(poses[:1]) @ poses, atol=1e-9)


@pytest.mark.parametrize("steps", [100, 1000])
def test_noise_does_not_depend_on_the_scan_rate(steps):
    poses = se2.matrix(np.linspace(0, 50, steps + 1), 0.0, 0.0)
    options = dataclasses.replace(PERFECT, drift_noise=0.01)
    rng = np.random.default_rng(8)
    headings = [se2.parameters(simulate_odometry(poses, options, rng))[-1, 2] for _ in range(400)]
    assert np.std(headings) == pytest.approx(0.01 * np.sqrt(50), rel=0.12)


def test_a_slipping_wheel_reads_too_far_on_short_pieces():
    poses = se2.matrix(np.arange(0, 200.01, 0.1), 0.0, 0.0)
    options = dataclasses.replace(PERFECT, slip_rate=0.1, slip=0.3, slip_length=0.5)
    odometry = simulate_odometry(poses, options, np.random.default_rng(5))
    x, y, turn = se2.parameters(se2.inverse(odometry[:-1]) @ odometry[1:]).T
    ahead = np.hypot(x, y)
    slips = np.abs(turn) > 1e-9
    # 20 slips of half a metre on 200 m, less what overlaps
    assert 0.5 * 0.05 < slips.mean() < 1.5 * 0.05
    np.testing.assert_allclose(ahead[~slips], 0.1, atol=1e-9)
    # one wheel 15 to 45 % too far, 0.4 m from the other; now and then both at once
    one = (np.abs(turn) > 0.149 * 0.1 / 0.4) & (np.abs(turn) < 0.451 * 0.1 / 0.4)
    assert one.sum() > 0.8 * slips.sum()
    np.testing.assert_allclose(ahead[one], 0.1 + np.abs(turn[one]) * 0.4 / 2, rtol=1e-3)
    assert (turn > 1e-9).any()
    assert (turn < -1e-9).any()


def test_a_stall_misses_what_the_robot_does_for_its_time():
    T = round_a_ring()
    options = dataclasses.replace(PERFECT, stall_rate=3.0, stall_time=4.0)
    odometry = add_faults(T, SECONDS, options, np.random.default_rng(1))
    np.testing.assert_array_equal(odometry[0], np.eye(3))
    got, true = moves(odometry), moves(T)
    lost = np.hypot(got[:, 0], got[:, 1]) < 1e-9
    np.testing.assert_allclose(got[lost], 0.0, atol=1e-9)
    np.testing.assert_allclose(got[~lost], true[~lost], atol=1e-9)
    # 30 stalls of 4 s in 600 s, less what overlaps
    assert 0.1 < lost.mean() < 0.25
    starts = np.flatnonzero(np.diff(lost.astype(int)) == 1)
    assert 15 <= len(starts) <= 40
    ends = np.flatnonzero(np.diff(lost.astype(int)) == -1)
    lasts = (ends[:10] - starts[:10])[ends[:10] > starts[:10]]
    assert lasts.min() >= 20


def test_a_reset_begins_again_at_the_origin():
    T = round_a_ring()
    options = dataclasses.replace(PERFECT, resets=3)
    odometry = add_faults(T, SECONDS, options, np.random.default_rng(1))
    again = np.flatnonzero(np.abs(odometry[1:] - np.eye(3)).max(axis=(1, 2)) < 1e-12)
    assert len(again) == 3
    got, true = moves(odometry), moves(T)
    others = np.setdiff1d(np.arange(3000), again)
    np.testing.assert_allclose(got[others], true[others], atol=1e-9)
    assert np.hypot(*got[again, :2].T).max() > 1.0


@pytest.mark.parametrize("seed", [0, *slow_params(1, 2, 3)])
def test_a_carried_robot_goes_on_elsewhere_and_odometry_knows_nothing(seed):
    run = hall(seed, 400, 30, {"carried_at": 0.6}, odometry=vars(PERFECT))
    T, odometry = run.truth.T_world_base, run.recording.T_odom_base
    scan = run.truth.scene["carried_at_scan"]
    assert scan == 240
    jump = moves(T)[scan - 1]
    assert np.hypot(*jump[:2]) > 5.0
    steps = np.hypot(*moves(T)[:, :2].T)
    assert np.delete(steps, scan - 1).max() <= 0.1 + 1e-9
    np.testing.assert_allclose(moves(odometry)[scan - 1], 0.0, atol=1e-9)
    got, true = (np.delete(moves(poses), scan - 1, axis=0) for poses in (odometry, T))
    np.testing.assert_allclose(got, true, atol=2e-3)  # an arc from scan to scan
    gap = np.diff(run.recording.stamp_ns) / 1e9
    assert gap[scan - 1] == pytest.approx(20.2)
    np.testing.assert_allclose(np.delete(gap, scan - 1), 0.2)
    # on its route again, and going on with it
    after = T[scan:, :2, 2]
    assert np.hypot(*np.diff(after, axis=0).T).sum() > 8.0


@pytest.mark.parametrize("tick", [0.1, 1.0])
def test_stamps_are_rounded(tick):
    exact, rounded = (
        hall(3, 100, 30, {"scan_rate": 7.0, "stamp_rounding": to}).recording.stamp_ns
        for to in (0.0, tick)
    )
    assert np.all((rounded - exact[0]) % round(tick * 1e9) == 0)
    assert np.abs(rounded - exact).max() <= tick * 1e9 / 2 + 1
    assert np.abs(rounded - exact).max() > tick * 1e9 / 4
    assert np.all(np.diff(rounded) >= 0)


def test_only_the_recorded_mount_is_wrong(tmp_path):
    true = {"beams": 60, "y": 0.3, "yaw": 0.2}
    told = hall(laser=true)
    wrong = hall(laser={**true, "recorded_x": 0.0, "recorded_y": 0.0, "recorded_yaw": 0.0})
    np.testing.assert_array_equal(told.recording.points, wrong.recording.points)
    np.testing.assert_allclose(wrong.recording.T_base_sensor[0], np.eye(3))
    np.testing.assert_allclose(told.recording.T_base_sensor[0], se2.matrix(0.08, 0.3, 0.2))
    assert told.truth.T_base_sensor is None
    np.testing.assert_array_equal(wrong.truth.T_base_sensor, told.recording.T_base_sensor)
    for name, run in (("told", told), ("wrong", wrong)):
        write_simulation(run, tmp_path / name)
    hits = [read_truth(tmp_path / name).static_hits() for name in ("told", "wrong")]
    np.testing.assert_array_equal(*hits)
    loaded = load_truth(tmp_path / "wrong").T_base_sensor
    np.testing.assert_array_equal(loaded, told.recording.T_base_sensor)
    assert not (tmp_path / "told" / "truth" / "T_base_sensor.npy").exists()


def test_scale_and_gain_are_factors():
    true = round_a_ring(200)
    odometry = dataclasses.replace(PERFECT, scale=1.1, rotation_gain=0.95)
    exact = moves(simulate_odometry(true, PERFECT, np.random.default_rng(0)))
    wrong = moves(simulate_odometry(true, odometry, np.random.default_rng(0)))
    np.testing.assert_allclose(wrong[:, 2], 0.95 * exact[:, 2], rtol=1e-9)
    np.testing.assert_allclose(
        np.hypot(*wrong[:, :2].T), 1.1 * np.hypot(*exact[:, :2].T), rtol=1e-4
    )


def test_late_odometry_is_that_of_then():
    T, seconds = round_a_ring(100), SECONDS[:100]
    late = delay_odometry(T, seconds, 0.5)
    np.testing.assert_allclose(late[:3], np.eye(3)[None].repeat(3, axis=0), atol=1e-12)
    # two and a half scans: half way between two
    np.testing.assert_allclose(late[10], T[7] @ se2.matrix(*(0.5 * moves(T)[7])), atol=1e-12)
    np.testing.assert_allclose(delay_odometry(T, seconds, 0.4)[2:], T[:-2], atol=1e-9)
    assert delay_odometry(T, seconds, 0.0) is T


@pytest.mark.parametrize("by", [8.0, -8.0])
def test_a_robot_is_carried_as_far_as_said(by):
    robot = {"carried_at": 0.7, "carried_by": by, "carried_turn": 0.0, "carried_time": 0.0}
    run = hall(scans=200, robot=robot, crowd={"people": 0})
    T, scan = run.truth.T_world_base, run.truth.scene["carried_at_scan"]
    jump = moves(T)[scan - 1]
    assert 4.0 < np.hypot(*jump[:2]) < 8.3
    assert np.all(np.diff(run.recording.stamp_ns) == 2 * 10**8)
    # set down along the route: it goes on without turning first
    assert np.abs(moves(T)[scan : scan + 5, 2]).max() < 0.1
    path = np.concatenate([np.eye(3)[None], T])[1:, :2, 2]
    before = np.hypot(*(path[:scan] - path[scan]).T).min()
    assert (before < 0.3) == (by < 0)
