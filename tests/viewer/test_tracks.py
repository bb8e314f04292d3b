"""Poses and boxes of moving objects at a time."""

import numpy as np
import pytest

from stillmap.results.object_poses import (
    headings,
    interpolate_pose,
    is_present,
    object_poses_at,
)
from stillmap.results.reader import Track
from stillmap.results.viewer.objects import box_edges

NOW = 1_700_000_000_000_000_000


def track(seconds, xy, velocity, size=(2.0, 1.0, 1.5), z=0.7, number=1):
    stamp_ns = NOW + np.round(1e9 * np.array(seconds)).astype(np.int64)
    high = None if z is None else np.full(len(seconds), z)
    return Track(number, size, stamp_ns, np.array(xy, float), np.array(velocity, float), high)


def test_heading_is_kept_while_standing():
    velocity = np.array([[0, 0], [0, 2], [0, 0.01], [-2, 0]], float)
    angles = headings(velocity)
    assert angles[:2] == pytest.approx([np.pi / 2, np.pi / 2])
    assert angles[3] == pytest.approx(np.pi)
    assert angles[2] == pytest.approx(0.75 * np.pi)  # half-way on its turn


def test_position_is_interpolated():
    one = track([0, 1], [[0, 0], [4, 0]], [[4, 0], [4, 0]])
    T = interpolate_pose(one, NOW + 250_000_000)
    assert T[:3, 3] == pytest.approx([1.0, 0.0, 0.7])
    assert T[:3, :3] == pytest.approx(np.eye(3))
    assert interpolate_pose(one, NOW - 10**9)[:2, 3].tolist() == [0.0, 0.0]
    assert interpolate_pose(one, NOW + 10**10)[:2, 3].tolist() == [4.0, 0.0]


def test_object_poses_at_a_time():
    one = track([0, 1], [[0, 0], [1, 0]], [[1, 0], [1, 0]])
    late = track([5, 6], [[0, 0], [1, 0]], [[1, 0], [1, 0]])
    assert [is_present(one, NOW + s) for s in (-1, 0, 10**9, 10**9 + 1)] == [
        False,
        True,
        True,
        False,
    ]
    assert object_poses_at([late, one], NOW).track.tolist() == [1]
    nobody = object_poses_at([late], NOW)
    assert box_edges(nobody).shape == (0, 4, 2, 3)


def test_box_edges():
    one = track([0, 1], [[3, 4], [3, 5]], [[0, 1], [0, 1]])
    lines = box_edges(object_poses_at([one], NOW))
    assert lines.shape == (1, 12, 2, 3)
    lengths = np.linalg.norm(lines[0, :, 1] - lines[0, :, 0], axis=1)
    assert sorted(lengths) == pytest.approx([1.0] * 4 + [1.5] * 4 + [2.0] * 4)
    corners = lines.reshape(-1, 3)
    # it goes along y: its length lies along y
    assert corners.min(axis=0) == pytest.approx([2.5, 3.0, 0.7 - 0.75])
    assert corners.max(axis=0) == pytest.approx([3.5, 5.0, 0.7 + 0.75])
