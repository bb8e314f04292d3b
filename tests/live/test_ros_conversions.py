"""ROS messages and arrays, without ROS: messages are objects with the same fields."""

import math

import numpy as np
import pytest
from ros_messages import laser_scan

from stillmap.live.ros import messages
from stillmap.live.ros.messages import Mount

LEVEL = Mount(np.eye(3))
INF, NAN = math.inf, math.nan


def test_readings_become_beams_in_their_order():
    message = laser_scan(5_000_000_007, [2.0, INF, 25.0, NAN, 0.05, 1.0])
    beams = messages.to_scan_beams(message, "scan", LEVEL)
    assert beams.stamp_ns == 5_000_000_007
    assert beams.sensor == "scan"
    np.testing.assert_array_equal(beams.hit, [True, False, False, False, False, True])
    length = np.linalg.norm(beams.points, axis=1)
    np.testing.assert_allclose(length, [2.0, 20.0, 20.0, NAN, NAN, 1.0], rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(*beams.points[5, ::-1]), -0.5, rtol=1e-6)
    assert beams.beam_time is None


def test_limits_of_the_parameters():
    message = laser_scan(1, [0.3, 8.0, 3.0])
    beams = messages.to_scan_beams(message, "scan", LEVEL, min_range=0.5, max_range=5.0)
    np.testing.assert_array_equal(beams.hit, [False, False, True])
    length = np.linalg.norm(beams.points, axis=1)
    np.testing.assert_allclose(length, [NAN, 5.0, 3.0], rtol=1e-6)


@pytest.mark.parametrize(
    ("increment", "times"), [(0.01, [0.0, 0.01, 0.02]), (0.0, None), (1.0, None), (-0.1, None)]
)
def test_times_of_beams(increment, times):
    message = laser_scan(1, [1.0, 1.0, 1.0], time_increment=increment)
    found = messages.to_scan_beams(message, "scan", LEVEL).beam_time
    if times is None:
        assert found is None
    else:
        np.testing.assert_allclose(found, times)


def test_cells_as_nav2_reads_them():
    p = np.array([[0.0, 0.19, 0.3], [0.66, 1.0, NAN]], np.float32)
    np.testing.assert_array_equal(messages.to_cells(p, "trinary"), [[0, 0, -1], [100, 100, -1]])
    np.testing.assert_array_equal(messages.to_cells(p, "raw"), [[0, 19, 30], [66, 100, -1]])
