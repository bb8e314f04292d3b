"""Interpolation of odometry."""

import math

import numpy as np

from stillmap.io.trajectory import interpolate

STAMPS = np.array([20, 10, 30], np.int64)  # out of order: sorted first
POSES = np.array([[2.0, 0.0, 3.0], [0.0, 0.0, 0.0], [2.0, 4.0, -3.0]])


def test_linear_and_shortest_arc():
    poses, outside = interpolate(STAMPS, POSES, np.array([10, 15, 20, 25, 30], np.int64))
    np.testing.assert_allclose(poses[:, 0], [0, 1, 2, 2, 2])
    np.testing.assert_allclose(poses[:, 1], [0, 0, 0, 2, 4])
    turn = 2 * math.pi - 6.0  # from 3 to -3 the short way, over pi
    expected = [0, 1.5, 3.0, 3.0 + turn / 2, 3.0 + turn]
    np.testing.assert_allclose(poses[:, 2], expected)
    assert outside == 0


def test_nearest_pose_outside():
    poses, outside = interpolate(STAMPS, POSES, np.array([-5, 99], np.int64))
    np.testing.assert_allclose(poses[:, :2], [[0, 0], [2, 4]])
    assert outside == 2


def test_one_pose_and_equal_stamps():
    at = np.array([1, 10, 11], np.int64)
    poses, outside = interpolate(np.array([10], np.int64), POSES[:1], at)
    np.testing.assert_array_equal(poses, POSES[[0, 0, 0]])
    assert outside == 2
    poses, _ = interpolate(np.array([10, 10], np.int64), POSES[:2], at)
    assert np.isfinite(poses).all()


def test_large_stamps_lose_nothing():
    start = 976_052_857_000_000_000
    stamps = np.array([start, start + 4], np.int64)
    poses, _ = interpolate(stamps, np.array([[0.0, 0, 0], [4.0, 0, 0]]), stamps[:1] + 1)
    assert poses[0, 0] == 1.0
