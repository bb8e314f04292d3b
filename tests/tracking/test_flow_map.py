"""Squares that were crossed, counted by hand."""

import numpy as np
import pytest

from stillmap.tracking.flow_map import compute_flow_map
from stillmap.tracking.objects import MovingObject


def went(xy, seconds, speed=1.0, number=0):
    xy = np.asarray(xy, float)
    none = np.zeros(0, np.intp)
    stamp_ns = np.round(1e9 * np.asarray(seconds)).astype(np.int64)
    velocity = np.tile([speed, 0.0], (len(xy), 1))
    return MovingObject(number, none, stamp_ns, xy, velocity, (0.5, 0.5), none, 1.0)


def test_a_straight_way():
    found = compute_flow_map([went([[0.1, 0.1], [3.9, 0.1]], [0.0, 3.8])], 1.0)
    assert found.origin == (0.0, 0.0, 0.0)
    assert found.resolution == 1.0
    np.testing.assert_array_equal(found.crossings, [[1, 1, 1, 1]])
    np.testing.assert_allclose(found.speed, [[1, 1, 1, 1]])


def test_two_ways_and_what_nobody_crossed():
    ways = [
        went([[-0.9, 0.5], [1.5, 0.5]], [0, 2], 1.0),
        went([[0.5, -0.9], [0.5, 1.5]], [0, 2], 3.0),
    ]
    found = compute_flow_map(ways, 1.0)
    assert found.origin == (-1.0, -1.0, 0.0)
    np.testing.assert_array_equal(found.crossings, [[0, 1, 0], [1, 2, 1], [0, 1, 0]])
    expected = [[np.nan, 3, np.nan], [1, 2, 1], [np.nan, 3, np.nan]]
    np.testing.assert_allclose(found.speed, expected)


def test_who_stays_or_comes_right_back_has_crossed_once():
    to_and_fro = went([[0.5, 0.5], [1.2, 0.5], [0.8, 0.5], [1.2, 0.5]], [0, 1, 2, 3])
    np.testing.assert_array_equal(compute_flow_map([to_and_fro], 1.0).crossings, [[1, 1]])
    stays = went([[0.5, 0.5]] * 50, np.arange(50))
    np.testing.assert_array_equal(compute_flow_map([stays], 1.0).crossings, [[1]])
    # who comes back after a while crosses again
    back = compute_flow_map([went([[0.5, 0.5], [9.5, 0.5], [0.5, 0.5]], [0, 9, 18])], 1.0)
    np.testing.assert_array_equal(back.crossings, [[2] * 7 + [1] * 3])


def test_one_who_is_far_away_is_left_out():
    near = [went([[0.1, 0.1], [3.9, 0.1]], [0.0, 3.8])]
    far = went([[9e4, -9e4], [9e4, -9e4 + 1.0]], [0.0, 1.0])
    found, expected = compute_flow_map([*near, far], 1.0), compute_flow_map(near, 1.0)
    assert found.origin == expected.origin
    np.testing.assert_array_equal(found.crossings, expected.crossings)
    np.testing.assert_array_equal(found.speed, expected.speed)


@pytest.mark.parametrize("objects", [[], [went([[0.2, 0.3]], [4.0])]])
def test_little(objects):
    found = compute_flow_map(objects)
    assert found.crossings.sum() == len(objects)
    assert found.crossings.dtype == np.int32
    assert found.speed.dtype == np.float32
