"""Odometry and stamps that lie, and a robot that is carried elsewhere: only as asked for."""

import dataclasses

import numpy as np
import pytest
from marks import slow_params
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.sim import Simulation, scene_by_name, simulate
from stillmap.sim.episode import add_faults
from stillmap.sim.options import OdometryOptions

Float = NDArray[np.float64]

PERFECT = OdometryOptions(0.0, 0.0, 0.4, 0.0, 0.0, 0.0)
SECONDS = np.arange(3001) * 0.2  # ten minutes


def round_a_ring() -> Float:
    turn = SECONDS * 0.1
    return se2.matrix(5 * np.sin(turn), 5 - 5 * np.cos(turn), turn)


def moves(T: Float) -> Float:
    return se2.parameters(se2.inverse(T[:-1]) @ T[1:])


def short(seed: int = 3, name: str = "hall", **changes: dict[str, object]) -> Simulation:
    usual: dict[str, dict[str, object]] = {"robot": {"scans": 400}, "laser": {"beams": 30}}
    return simulate(scene_by_name(name, {**usual, **changes}), seed)


def test_a_stall_misses_what_the_robot_does_for_its_time() -> None:
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


def test_a_reset_begins_again_at_the_origin() -> None:
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
def test_a_carried_robot_goes_on_elsewhere_and_odometry_knows_nothing(seed: int) -> None:
    perfect = {"wheel_radius_error": 0.0, "wheel_base_error": 0.0, "translation_noise": 0.0,
               "rotation_noise": 0.0, "drift_noise": 0.0}  # fmt: skip
    run = short(seed, robot={"scans": 400, "carried_at": 0.6}, odometry=perfect)
    T, odometry = run.truth.T_world_base, run.recording.T_odom_base
    assert odometry is not None
    scan = run.truth.scene["carried_at_scan"]
    assert scan == 240
    jump = moves(T)[scan - 1]
    assert np.hypot(*jump[:2]) > 5.0
    steps = np.hypot(*moves(T)[:, :2].T)
    assert np.delete(steps, scan - 1).max() <= 0.1 + 1e-9
    np.testing.assert_allclose(moves(odometry)[scan - 1], 0.0, atol=1e-9)
    np.testing.assert_allclose(
        np.delete(moves(odometry), scan - 1, axis=0), np.delete(moves(T), scan - 1, axis=0),
        atol=2e-3,  # odometry takes the way between two scans for an arc
    )  # fmt: skip
    gap = np.diff(run.recording.stamp_ns) / 1e9
    assert gap[scan - 1] == pytest.approx(20.2)
    np.testing.assert_allclose(np.delete(gap, scan - 1), 0.2)
    # on its route again, and going on with it
    after = T[scan:, :2, 2]
    assert np.hypot(*np.diff(after, axis=0).T).sum() > 8.0


@pytest.mark.parametrize("tick", [0.1, 1.0])
def test_stamps_are_rounded(tick: float) -> None:
    robot = {"scans": 100, "scan_rate": 7.0}
    exact = short(robot=robot).recording.stamp_ns
    rounded = short(robot={**robot, "stamp_rounding": tick}).recording.stamp_ns
    assert np.all((rounded - exact[0]) % round(tick * 1e9) == 0)
    assert np.abs(rounded - exact).max() <= tick * 1e9 / 2 + 1
    assert np.abs(rounded - exact).max() > tick * 1e9 / 4
    assert np.all(np.diff(rounded) >= 0)
