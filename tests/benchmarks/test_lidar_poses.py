"""What poses in space are compared with."""

import lidar_poses
import numpy as np
import pytest

from stillmap.core import se3


def test_later_goes_on_as_to_the_next_pose():
    stamps = np.array([0, 200_000_000, 300_000_000])
    twists = np.array([[1.0, 0, 0, 0, 0, 0.5], [2.0, 0, 0, 0, 0.1, 0]])
    first = np.eye(4)
    second = first @ se3.exp(0.2 * twists[0])
    truth = np.array([first, second, second @ se3.exp(0.1 * twists[1])])
    moved = lidar_poses.later(truth, stamps, 0.05)
    for pose, start, twist in zip(moved, truth, twists[[0, 1, 1]], strict=True):
        assert pose == pytest.approx(start @ se3.exp(0.05 * twist), abs=1e-12)
