"""Poses of moving objects along their tracks, and their boxes."""

import numpy as np
import pytest

from stillmap.results.objects import headings, interpolate_pose, iter_present_tracks
from stillmap.results.reader import Track
from stillmap.results.viewer.objects import box_edges

NOW = 1_700_000_000_000_000_000


def track(seconds, xy, velocity):
    stamp_ns = NOW + np.round(1e9 * np.array(seconds)).astype(np.int64)
    z, size = np.full(len(seconds), 0.7), (2.0, 1.0, 1.5)
    return Track(1, size, stamp_ns, np.array(xy, float), np.array(velocity, float), z)


def test_heading_is_kept_while_standing():
    velocity = np.array([[0, 0], [0, 2], [0, 0.01], [-2, 0]], float)
    # at 2 half-way on its turn
    assert headings(velocity) == pytest.approx(np.pi * np.array([0.5, 0.5, 0.75, 1.0]))


def test_position_is_interpolated():
    one = track([0, 1], [[0, 0], [4, 0]], [[4, 0], [4, 0]])
    T = interpolate_pose(one, NOW + 250_000_000)
    assert T[:3, 3] == pytest.approx([1.0, 0.0, 0.7])
    assert T[:3, :3] == pytest.approx(np.eye(3))
    assert interpolate_pose(one, NOW - 10**9)[:2, 3].tolist() == [0.0, 0.0]
    assert interpolate_pose(one, NOW + 10**10)[:2, 3].tolist() == [4.0, 0.0]


def test_tracks_present_at_each_scan():
    tracks = [track(ends, np.zeros((2, 2)), np.zeros((2, 2))) for ends in ([2, 3], [0, 1], [1, 1])]
    seconds = np.array([-1, 0, 1, 1.5, 2, 3, 4])
    present = list(iter_present_tracks(tracks, NOW + (1e9 * seconds).astype(np.int64)))
    assert present == [[], [1], [1, 2], [], [0], [0], []]
    assert list(iter_present_tracks([], np.array([NOW]))) == [[]]


def test_box_edges():
    one = track([0, 1], [[3, 4], [3, 5]], [[0, 1], [0, 1]])
    lines = box_edges(interpolate_pose(one, NOW)[None], np.array([one.size]))
    assert lines.shape == (1, 12, 2, 3)
    lengths = np.linalg.norm(lines[0, :, 1] - lines[0, :, 0], axis=1)
    assert sorted(lengths) == pytest.approx([1.0] * 4 + [1.5] * 4 + [2.0] * 4)
    corners = lines.reshape(-1, 3)
    # it goes along y: its length lies along y
    assert corners.min(axis=0) == pytest.approx([2.5, 3.0, 0.7 - 0.75])
    assert corners.max(axis=0) == pytest.approx([3.5, 5.0, 0.7 + 0.75])
    assert box_edges(np.zeros((0, 4, 4)), np.zeros((0, 3))).shape == (0, 4, 2, 3)
