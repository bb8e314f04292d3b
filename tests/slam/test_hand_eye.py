"""Hand-eye calibration on motions that are made up, and positions from registered poses."""

import dataclasses

import numpy as np
import pytest
from driven import chained
from recordings import of_one_sensor

from stillmap.core import se2
from stillmap.slam.hand_eye import HandEye
from stillmap.slam.mount_calibration import Calibration, Parameter, refine_positions
from stillmap.slam.scan_motion import MotionWindows

T = 161
NOMINAL = {"theta0": 0.0, "x0": 0.0, "y0": 0.0, "scale": 1.0, "rotation_gain": 1.0}
TURNED, AHEAD = (np.pi, 0.1, 0.0), (0.02, 0.35, 0.0)
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
    return chained(se2.exp(steps))


def windows_of(poses, mount, rng, spacing=8):
    X = se2.matrix(mount[1], mount[2], mount[0])
    first = np.arange(0, T - spacing, spacing)
    last = first + spacing
    motion = se2.parameters(se2.inverse(poses[first] @ X) @ poses[last] @ X)
    motion += rng.standard_normal(motion.shape) * NOISE
    covariance = np.tile(np.diag(np.square(NOISE)), (len(first), 1, 1))
    segment = np.arange(len(first)) // 2
    return MotionWindows(first, last, segment, motion, covariance)


def test_half_a_turn_is_no_negative_scale():
    poses, rng = true_path(), np.random.default_rng(5)
    problem = HandEye([windows_of(poses, TURNED, rng)], [False], poses, NOMINAL)
    assert problem.fit(NOMINAL, list(NOMINAL)).values["scale"] < 0.0
    fit = problem.fit_globally(list(NOMINAL))
    assert fit.values["scale"] == pytest.approx(1.0, abs=0.01)
    assert abs(se2.wrap(fit.values["theta0"] - np.pi)) < 0.01


def test_outliers_do_not_count():
    poses, rng = true_path(), np.random.default_rng(2)
    windows = windows_of(poses, AHEAD, rng, spacing=4)
    windows.motion[::5] += [0.5, -0.4, 0.6]
    problem = HandEye([windows], [False], poses, NOMINAL)
    fit = problem.fit_globally(list(NOMINAL))
    assert fit.values["x0"] == pytest.approx(0.35, abs=0.02)
    assert fit.values["y0"] == pytest.approx(0.0, abs=0.02)


def test_without_turns_the_position_is_unknown():
    poses, rng = true_path(turns=False), np.random.default_rng(3)
    problem = HandEye([windows_of(poses, AHEAD, rng)], [False], poses, NOMINAL)
    fit = problem.fit_globally(list(NOMINAL))
    assert fit.std["x0"] > 0.2
    assert fit.std["theta0"] < 0.01


TRUE = (0.35, -0.05, 0.0)  # x, y, yaw of the laser


@pytest.mark.parametrize("significant", [True, False])
def test_positions_that_were_applied_are_refined(significant):
    position = {
        "x": Parameter(0.08, 0.37, 0.02, significant),
        "y": Parameter(0.0, -0.02, 0.02, significant),
    }
    before = Calibration([{"theta": Parameter(0.0, 0.001, 0.002, False), **position}], [False])
    stamps, none = np.arange(T) * 200_000_000, np.zeros((0, 2), np.float32)
    recording = dataclasses.replace(
        of_one_sensor(stamps, np.zeros(T + 1, np.int64), none, np.zeros(0, np.bool_)),
        T_base_sensor=se2.matrix([0.37], [-0.02], [0.0]),
        T_odom_base=true_path(),
    )
    laser = recording.T_odom_base @ se2.matrix(*TRUE)
    laser[:, :2, 2] += 0.002 * np.random.default_rng(0).standard_normal((T, 2))
    registered = laser @ se2.inverse(recording.T_base_sensor[0])
    after = refine_positions(recording, registered, before)
    if not significant:
        assert after is before
        return
    x, y = after.lasers[0]["x"], after.lasers[0]["y"]
    assert x.value == pytest.approx(TRUE[0], abs=0.003)
    assert y.value == pytest.approx(TRUE[1], abs=0.003)
    assert max(x.std, y.std) < 0.004
    assert (x.nominal, x.significant) == (0.08, True)
    assert after.lasers[0]["theta"] is before.lasers[0]["theta"]
