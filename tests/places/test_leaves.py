"""Leaves of doors: straight, and hinged beside a gap in a wall."""

import numpy as np
import pytest

from stillmap.places.door_leaves import Leaf, fit_leaf, is_hinged, turn_about_hinge

CELL = 0.05


def _line(x0, y0, x1, y1):
    """Points a cell apart on a segment."""
    count = round(float(np.hypot(x1 - x0, y1 - y0)) / CELL) + 1
    return np.linspace([x0, y0], [x1, y1], count)


def _leaf(x0, y0, x1, y1):
    leaf = fit_leaf(_line(x0, y0, x1, y1))
    assert leaf is not None
    return leaf


# a wall along x with a gap of 0.9 m
WALL = np.concatenate([_line(-2.0, 0.0, 0.0, 0.0), _line(0.9, 0.0, 3.0, 0.0)])


def test_a_leaf_is_straight_and_as_long_as_a_door():
    assert _leaf(0.0, 0.0, 0.8, 0.3).length == pytest.approx(np.hypot(0.8, 0.3))
    corner = np.concatenate([_line(0, 0, 0.6, 0), _line(0.6, 0, 0.6, 0.6)])
    assert fit_leaf(corner) is None
    assert fit_leaf(_line(0, 0, 3.0, 0)) is None


@pytest.mark.parametrize("angle", [0.0, 0.7, 1.5, -1.2])
def test_a_leaf_hangs_beside_the_gap_that_it_shuts(angle):
    u = np.array([np.cos(angle), np.sin(angle)])
    # its first and last decimetre were not seen, beside the wall
    leaf = _leaf(*(0.1 * u), *(0.8 * u))
    assert is_hinged(leaf, WALL)
    assert not is_hinged(leaf, _line(-2.0, 0.0, 3.0, 0.0) - [0.0, 0.2])  # no gap
    assert not is_hinged(Leaf(np.add(leaf.ends, [0.0, 1.5]), leaf.length), WALL)  # not beside it
    assert not is_hinged(leaf, np.zeros((0, 2)))


def test_a_leaf_shuts_no_wide_gap_and_no_slit():
    for width in (0.4, 2.0):
        wall = np.concatenate([_line(-2.0, 0.0, 0.0, 0.0), _line(width, 0.0, 4.0, 0.0)])
        assert not is_hinged(_leaf(0.0, 0.1, 0.0, 0.8), wall)


def test_two_positions_share_the_hinge():
    shut, ajar = _leaf(0.1, 0.0, 0.8, 0.0), _leaf(0.07, 0.07, 0.6, 0.6)
    assert turn_about_hinge(shut, ajar)
    assert not turn_about_hinge(shut, _leaf(0.1, 0.0, 0.8, 0.02))  # has not turned
    assert not turn_about_hinge(shut, _leaf(2.0, 0.0, 2.0, 0.8))  # hangs elsewhere
