"""ROS messages and arrays, without ROS: messages are objects with the same fields."""

import math
from unittest.mock import MagicMock

import numpy as np
import pytest
from ros_messages import header, laser_scan

from stillmap.core import se2
from stillmap.core.grid_map import GridMap
from stillmap.live.ros import conversions
from stillmap.live.ros.conversions import Mount

LEVEL = Mount(np.eye(3))
INF, NAN = math.inf, math.nan


def heading(q):
    return 2.0 * math.atan2(q.z, q.w)


def test_readings_become_beams_in_their_order():
    message = laser_scan(5_000_000_007, [2.0, INF, 25.0, NAN, 0.05, 1.0])
    beams = conversions.to_scan_beams(message, "scan", LEVEL)
    assert beams.stamp_ns == 5_000_000_007
    assert beams.sensor == "scan"
    np.testing.assert_array_equal(beams.hit, [True, False, False, False, False, True])
    length = np.linalg.norm(beams.points, axis=1)
    np.testing.assert_allclose(length, [2.0, 20.0, 20.0, NAN, NAN, 1.0], rtol=1e-6)
    np.testing.assert_allclose(np.arctan2(*beams.points[5, ::-1]), -0.5, rtol=1e-6)
    assert beams.beam_time is None


def test_limits_of_the_parameters():
    message = laser_scan(1, [0.3, 8.0, 3.0])
    beams = conversions.to_scan_beams(message, "scan", LEVEL, min_range=0.5, max_range=5.0)
    np.testing.assert_array_equal(beams.hit, [False, False, True])
    length = np.linalg.norm(beams.points, axis=1)
    np.testing.assert_allclose(length, [NAN, 5.0, 3.0], rtol=1e-6)


def test_a_laser_upside_down_turns_the_other_way():
    message = laser_scan(1, [2.0, 2.0])
    beams = conversions.to_scan_beams(message, "scan", Mount(np.eye(3), is_upside_down=True))
    np.testing.assert_allclose(np.arctan2(beams.points[:, 1], beams.points[:, 0]), [1.0, 0.9])


@pytest.mark.parametrize(
    ("increment", "times"), [(0.01, [0.0, 0.01, 0.02]), (0.0, None), (1.0, None), (-0.1, None)]
)
def test_times_of_beams(increment, times):
    message = laser_scan(1, [1.0, 1.0, 1.0], time_increment=increment)
    found = conversions.to_scan_beams(message, "scan", LEVEL).beam_time
    if times is None:
        assert found is None
    else:
        np.testing.assert_allclose(found, times)


@pytest.mark.parametrize(
    "fields", [{"angle_increment": 0.0}, {"angle_increment": 3.0}, {"angle_min": NAN}]
)
def test_scans_that_are_none(fields):
    assert conversions.shape_of(laser_scan(1, [1.0] * 10, **fields)).find_fault() is not None


def test_what_stands_and_what_moves():
    ranges = np.array([1.0, 2.0, INF, NAN, 3.0], np.float32)
    hit = np.array([True, True, False, False, True])
    p_static = np.array([0.9, 0.1, 0.1, NAN, 0.5], np.float32)
    static, dynamic = conversions.split_ranges(ranges, hit, p_static)
    np.testing.assert_array_equal(static, np.float32([1.0, INF, INF, NAN, 3.0]))
    np.testing.assert_array_equal(dynamic, np.float32([INF, 2.0, INF, INF, INF]))


def test_a_scan_with_other_ranges():
    source, out = laser_scan(3_000_000_001, [1.0, 2.0], scan_time=0.1), MagicMock()
    conversions.copy_scan(out, source, np.array([1.0, INF]))
    assert (out.header.stamp.sec, out.header.stamp.nanosec) == (3, 1)
    assert out.header.frame_id == "laser"
    assert (out.angle_min, out.scan_time, out.range_max) == (-1.0, 0.1, 20.0)
    assert out.ranges.typecode == "f"
    assert list(out.ranges) == [1.0, INF]


def test_cells_as_nav2_reads_them():
    p = np.array([[0.0, 0.19, 0.3], [0.66, 1.0, NAN]], np.float32)
    np.testing.assert_array_equal(conversions.to_cells(p, "trinary"), [[0, 0, -1], [100, 100, -1]])
    np.testing.assert_array_equal(conversions.to_cells(p, "raw"), [[0, 19, 30], [66, 100, -1]])


def test_a_grid():
    grid = GridMap(np.array([[0.0, 1.0, NAN]], np.float32), (-2.0, 3.0, 0.0), 0.05)
    out = MagicMock()
    conversions.fill_grid(out, "map", 7_000_000_009, grid, "trinary")
    assert (out.info.width, out.info.height, out.info.resolution) == (3, 1, 0.05)
    assert (out.info.origin.position.x, out.info.origin.position.y) == (-2.0, 3.0)
    assert out.info.origin.orientation.w == 1.0
    assert out.data.typecode == "b"
    assert list(out.data) == [0, 100, -1]
    assert (out.header.frame_id, out.header.stamp.sec) == ("map", 7)


def test_poses_and_transforms():
    T = se2.matrix(1.0, -2.0, -3.0)
    pose, transform = MagicMock(), MagicMock()
    conversions.fill_pose(pose, "map", 1, T, np.arange(9.0).reshape(3, 3))
    assert (pose.pose.pose.position.x, pose.pose.pose.position.y) == (1.0, -2.0)
    assert heading(pose.pose.pose.orientation) == pytest.approx(-3.0)
    covariance = np.reshape(pose.pose.covariance, (6, 6))
    np.testing.assert_array_equal(covariance[np.ix_([0, 1, 5], [0, 1, 5])].ravel(), np.arange(9.0))
    assert np.count_nonzero(covariance) == 8
    conversions.fill_transform(transform, "map", "odom", 2, T)
    assert transform.child_frame_id == "odom"
    assert transform.transform.translation.y == -2.0
    assert heading(transform.transform.rotation) == pytest.approx(-3.0)


def test_poses_in_space():
    T = np.eye(4)
    T[:3, :3] = [[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]
    T[:3, 3] = 1.0, 2.0, 3.0
    pose = MagicMock()
    conversions.fill_pose(pose, "map", 1, T, np.arange(36.0).reshape(6, 6))
    assert pose.pose.pose.position.z == 3.0
    q = pose.pose.pose.orientation
    np.testing.assert_allclose([q.x, q.y, q.z, q.w], [0.5**0.5, 0.0, 0.0, 0.5**0.5])
    np.testing.assert_array_equal(pose.pose.covariance, np.arange(36.0))


def test_frames_without_their_old_slash():
    message = MagicMock(header=header(1, "/laser"))
    assert conversions.scan_frame(message) == "laser"
