"""Late odometry: what is interpolated, and what is left."""

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.prepare.plausibility import interpolate_late_odometry

STEP = 0.2  # s


def driven(speed=1.0, turn_rate=0.0, n=40):
    """Stamps in ns and odometry poses of a robot at constant speed, with 2 mm and 2 mrad noise."""
    seconds = STEP * np.arange(n)
    motion = np.stack([speed * seconds, 0 * seconds, turn_rate * seconds], axis=1)
    noise = 0.002 * np.random.default_rng(0).standard_normal((len(seconds), 3))
    poses = se2.exp(motion) @ se2.matrix(*noise.T)
    return (1e9 * seconds).astype(np.int64), poses


def late(poses, scans, by):
    """Poses of which some show where the robot was so many seconds before."""
    out, scans = poses.copy(), np.array(scans)
    speed = se2.log(se2.inverse(poses[scans - 1]) @ poses[scans]) / STEP
    out[scans] = poses[scans] @ se2.exp(-by * speed)
    return out


def off(found, poses):
    d = se2.parameters(se2.inverse(poses) @ found)
    return np.hypot(d[:, 0], d[:, 1]).max(), np.abs(d[:, 2]).max()


@pytest.mark.parametrize(("speed", "turn_rate"), [(2.0, 0.0), (0.0, 2.0), (2.0, 1.0)])
def test_one_late_reading(speed, turn_rate):
    stamps, poses = driven(speed, turn_rate)
    given = late(poses, [20], 0.18)
    assert max(off(given, poses)) > 0.3
    found, scans = interpolate_late_odometry(stamps, given)
    assert scans.tolist() == [20]
    assert max(off(found, poses)) < 0.03


def test_readings_late_one_after_another():
    stamps, poses = driven(2.0, n=200)
    given = late(poses, [60], 0.19)
    given[61] = given[60]
    found, scans = interpolate_late_odometry(stamps, given)
    assert scans.tolist() == [60, 61]
    assert max(off(found, poses)) < 0.03


def test_a_stall_is_none():
    """Odometry that stood still never catches up."""
    stamps, poses = driven(2.0)
    given = poses.copy()
    given[20:] = given[19] @ se2.inverse(poses[20]) @ poses[20:]
    found, scans = interpolate_late_odometry(stamps, given)
    assert scans.tolist() == []
    assert found is given or np.array_equal(found, given)


def test_stopping_starting_and_turning_are_none():
    seconds = STEP * np.arange(60)
    speed = np.where((seconds > 3) & (seconds < 5), 0.0, 1.0)
    rate = np.where(seconds > 8, 1.5, 0.0)
    steps = se2.exp(STEP * np.stack([speed, 0 * speed, rate], axis=1))
    poses = [np.eye(3)]
    for step in steps[:-1]:
        poses.append(poses[-1] @ step)
    _, scans = interpolate_late_odometry((1e9 * seconds).astype(np.int64), np.array(poses))
    assert scans.tolist() == []
