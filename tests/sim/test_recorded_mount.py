"""A recorder that is wrong about its laser, and odometry with systematic errors."""

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.results.eval.readers import read_truth
from stillmap.sim import Simulation, load_truth, scene_by_name, simulate, write_simulation
from stillmap.sim.episode import delay_odometry, simulate_odometry
from stillmap.sim.options import OdometryOptions

Float = NDArray[np.float64]
PERFECT = OdometryOptions(0.0, 0.0, 0.4, 0.0, 0.0, 0.0)


def hall(**changes: dict[str, object]) -> Simulation:
    usual: dict[str, dict[str, object]] = {"robot": {"scans": 60}, "laser": {"beams": 60}}
    return simulate(scene_by_name("hall", {**usual, **changes}), 4)


def test_only_the_recorded_mount_is_wrong(tmp_path: Path) -> None:
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


def moves(T: Float) -> Float:
    return se2.parameters(se2.inverse(T[:-1]) @ T[1:])


def ring(T: int) -> Float:
    turn = np.arange(T) * 0.02
    return se2.matrix(5 * np.sin(turn), 5 - 5 * np.cos(turn), turn)


def test_scale_and_gain_are_factors() -> None:
    true = ring(200)
    odometry = OdometryOptions(0.0, 0.0, 0.4, 0.0, 0.0, 0.0, scale=1.1, rotation_gain=0.95)
    exact = moves(simulate_odometry(true, PERFECT, np.random.default_rng(0)))
    wrong = moves(simulate_odometry(true, odometry, np.random.default_rng(0)))
    np.testing.assert_allclose(wrong[:, 2], 0.95 * exact[:, 2], rtol=1e-9)
    np.testing.assert_allclose(
        np.hypot(*wrong[:, :2].T), 1.1 * np.hypot(*exact[:, :2].T), rtol=1e-4
    )


def test_late_odometry_is_that_of_then() -> None:
    T, seconds = ring(100), np.arange(100) * 0.2
    late = delay_odometry(T, seconds, 0.5)
    np.testing.assert_allclose(late[:3], np.eye(3)[None].repeat(3, axis=0), atol=1e-12)
    # two and a half scans: half way between two
    np.testing.assert_allclose(late[10], T[7] @ se2.matrix(*(0.5 * moves(T)[7])), atol=1e-12)
    np.testing.assert_allclose(delay_odometry(T, seconds, 0.4)[2:], T[:-2], atol=1e-9)
    assert delay_odometry(T, seconds, 0.0) is T


@pytest.mark.parametrize("by", [8.0, -8.0])
def test_a_robot_is_carried_as_far_as_said(by: float) -> None:
    robot = {"scans": 200, "carried_at": 0.7, "carried_by": by, "carried_turn": 0.0}
    run = hall(robot={**robot, "carried_time": 0.0}, crowd={"people": 0})
    T, scan = run.truth.T_world_base, run.truth.scene["carried_at_scan"]
    jump = moves(T)[scan - 1]
    assert 4.0 < np.hypot(*jump[:2]) < 8.3
    assert np.all(np.diff(run.recording.stamp_ns) == 2 * 10**8)
    # set down along the route: it goes on without turning first
    assert np.abs(moves(T)[scan : scan + 5, 2]).max() < 0.1
    path = np.concatenate([np.eye(3)[None], T])[1:, :2, 2]
    before = np.hypot(*(path[:scan] - path[scan]).T).min()
    assert (before < 0.3) == (by < 0)
