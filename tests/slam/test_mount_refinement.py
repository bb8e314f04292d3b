"""Positions of lasers from registered poses."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam.mount_calibration import Calibration, Parameter, refine_positions

T = 300
TRUE = (0.35, -0.05, 0.0)  # x, y, yaw of the laser


def recording_of(x, y):
    """Odometry without errors, of a robot that turns on the spot now and then."""
    steps = np.zeros((T - 1, 3))
    turning = np.arange(T - 1) % 20 < 6
    steps[:, 0], steps[:, 2] = np.where(turning, 0.0, 0.1), np.where(turning, 0.15, 0.0)
    poses = [np.eye(3)]
    for step in se2.exp(steps):
        poses.append(poses[-1] @ step)
    return Recording(
        stamp_ns=np.arange(T, dtype=np.int64) * 200_000_000,
        offset=np.zeros(T + 1, np.int64),
        points=np.zeros((0, 2), np.float32),
        hit=np.zeros(0, np.bool_),
        T_base_sensor=se2.matrix([x], [y], [0.0]),
        sensor=np.zeros(T, np.int32),
        T_odom_base=np.array(poses),
    )


def found(x, y, *, significant):
    position = {
        "x": Parameter(0.08, x, 0.02, significant),
        "y": Parameter(0.0, y, 0.02, significant),
    }
    return Calibration([{"theta": Parameter(0.0, 0.001, 0.002, False), **position}], [False])


def registered(recording, noise):
    """Poses of the base, by registered poses of the laser and a wrong position of it."""
    rng = np.random.default_rng(0)
    laser = recording.T_odom_base @ se2.matrix(*TRUE)
    laser[:, :2, 2] += noise * rng.standard_normal((T, 2))
    return laser @ se2.inverse(recording.T_base_sensor[0])


def test_position():
    recording = recording_of(0.37, -0.02)
    before = found(0.37, -0.02, significant=True)
    after = refine_positions(recording, registered(recording, 0.002), before)
    x, y = after.lasers[0]["x"], after.lasers[0]["y"]
    assert x.value == pytest.approx(TRUE[0], abs=0.002)
    assert y.value == pytest.approx(TRUE[1], abs=0.002)
    assert max(x.std, y.std) < 0.002
    assert (x.nominal, x.significant) == (0.08, True)
    assert after.lasers[0]["theta"] is before.lasers[0]["theta"]


def test_only_what_was_applied():
    recording = recording_of(0.37, -0.02)
    before = found(0.37, -0.02, significant=False)
    assert refine_positions(recording, registered(recording, 0.0), before) is before
