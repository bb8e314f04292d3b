"""Hand-eye calibration on motions that are made up."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.slam.hand_eye import HandEye, correct_odometry, mirror
from stillmap.slam.scan_motion import MotionWindows

T = 161
SECONDS = 0.2 * np.arange(T)
NOMINAL = {"theta0": 0.0, "x0": 0.0, "y0": 0.0, "scale": 1.0, "rotation_gain": 1.0}
MOUNTS = {"turned": (np.pi, 0.1, 0.0), "aslant": (-1.2, -0.4, 0.3), "ahead": (0.02, 0.35, 0.0)}
NOISE = (0.003, 0.003, 0.002)


def true_path(turns=True):
    """Straight on and in turns on the spot, alternately."""
    steps = np.zeros((T - 1, 3))
    if turns:
        steps[:, 0] = np.where(np.arange(T - 1) // 8 % 2 == 0, 0.1, 0.0)
        steps[:, 2] = np.where(steps[:, 0] > 0, 0.0, 0.12 * np.sign(np.sin(np.arange(T - 1))))
        steps[8::16, 2] = 0.15
    else:
        steps[:, 0] = 0.1
    poses = [np.eye(3)]
    for step in se2.exp(steps):
        poses.append(poses[-1] @ step)
    return np.array(poses)


def windows_of(poses, mount, rng, spacing=8):
    X = se2.matrix(mount[1], mount[2], mount[0])
    first = np.arange(0, T - spacing, spacing)
    last = first + spacing
    motion = se2.parameters(se2.inverse(poses[first] @ X) @ poses[last] @ X)
    motion += rng.standard_normal(motion.shape) * NOISE
    none = np.zeros(0, np.intp)
    covariance = np.tile(np.diag(np.square(NOISE)), (len(first), 1, 1))
    steps = np.zeros((0, 2), np.intp)
    segment = np.arange(len(first)) // 2
    return MotionWindows(first, last, segment, motion, covariance, steps, np.zeros(0), none)


@pytest.mark.parametrize("mount", MOUNTS.values(), ids=MOUNTS)
@pytest.mark.parametrize("upside_down", [False, True])
def test_pose_of_a_laser_wherever_it_is(mount, upside_down):
    poses, rng = true_path(), np.random.default_rng(0)
    seen = windows_of(poses, mount, rng)
    problem = HandEye([mirror(seen) if upside_down else seen], [upside_down], poses, NOMINAL)
    fit = problem.fit_globally(list(NOMINAL))
    for name, true in zip(("theta0", "x0", "y0"), mount, strict=True):
        off = fit.values[name] - true
        off = float(se2.wrap(off)) if name == "theta0" else off
        assert abs(off) < min(4 * fit.std[name], 0.02), name
        assert fit.std[name] < 0.01


def test_scale_and_gain_are_recorded_over_true():
    poses, rng = true_path(), np.random.default_rng(1)
    recorded = correct_odometry(SECONDS, poses, scale=1 / 1.1, rotation_gain=1 / 0.9)
    problem = HandEye([windows_of(poses, (0, 0, 0), rng)], [False], recorded, NOMINAL)
    fit = problem.fit(NOMINAL, ["scale", "rotation_gain"])
    assert fit.values["scale"] == pytest.approx(1.1, abs=0.01)
    assert fit.values["rotation_gain"] == pytest.approx(0.9, abs=0.01)
    again = correct_odometry(SECONDS, recorded, scale=1.1, rotation_gain=0.9)
    np.testing.assert_allclose(again, poses, atol=1e-9)


def test_half_a_turn_is_no_negative_scale():
    poses, rng = true_path(), np.random.default_rng(5)
    problem = HandEye([windows_of(poses, MOUNTS["turned"], rng)], [False], poses, NOMINAL)
    assert problem.fit(NOMINAL, list(NOMINAL)).values["scale"] < 0.0
    fit = problem.fit_globally(list(NOMINAL))
    assert fit.values["scale"] == pytest.approx(1.0, abs=0.01)
    assert abs(se2.wrap(fit.values["theta0"] - np.pi)) < 0.01


def test_outliers_do_not_count():
    poses, rng = true_path(), np.random.default_rng(2)
    windows = windows_of(poses, MOUNTS["ahead"], rng, spacing=4)
    windows.motion[::5] += [0.5, -0.4, 0.6]
    problem = HandEye([windows], [False], poses, NOMINAL)
    fit = problem.fit_globally(list(NOMINAL))
    assert fit.values["x0"] == pytest.approx(0.35, abs=0.02)
    assert fit.values["y0"] == pytest.approx(0.0, abs=0.02)


def test_without_turns_the_position_is_unknown():
    poses, rng = true_path(turns=False), np.random.default_rng(3)
    problem = HandEye([windows_of(poses, MOUNTS["ahead"], rng)], [False], poses, NOMINAL)
    fit = problem.fit_globally(list(NOMINAL))
    assert fit.std["x0"] > 0.2
    assert fit.std["theta0"] < 0.01


def test_late_odometry_is_moved_back():
    poses = true_path()
    late = correct_odometry(SECONDS, poses, scale=1.0, rotation_gain=1.0, latency=-0.3)
    again = correct_odometry(SECONDS, late, scale=1.0, rotation_gain=1.0, latency=0.3)
    inner = slice(4, -4)
    off = se2.parameters(se2.inverse(poses[inner]) @ again[inner])
    assert np.abs(off).max() < 0.08  # within one scan's motion at the corners
    assert np.median(np.abs(off)) < 1e-6
