"""Evidence of cells, their changes grouped to objects, leaves of doors, labels by the map."""

import numpy as np
import pytest

from stillmap.mapping.change_detection import Events
from stillmap.places import changes
from stillmap.places.changes import Leaf, fit_leaf, is_hinged, turn_about_hinge
from stillmap.places.evidence import BLOCK, BeamCells, Evidence, crop_without_gaps
from stillmap.places.place_map import ShownState, label_session
from stillmap.places.place_states import CellStates, PlaceStates

S = 6


def make_states(cells):
    """A place of cells (K, 2) of which nothing else is known."""
    K = len(cells)
    zeros = np.zeros((K, S), np.float32)
    nothing = np.zeros((K, S), bool)
    states = CellStates(np.zeros(K), np.ones(K), np.zeros((K, S)), nothing, nothing)
    return PlaceStates(np.array(cells, np.int64), zeros, zeros, states, 0.05, np.ones(3) / 3)


def test_events_beside_a_change_share_a_part_of_its_time():
    """One that ended before another began cannot both belong to one thing."""
    place = make_states([(0, 0), (1, 0), (0, 1), (1, 1), (-1, 0)])
    came = np.ones(1, bool)
    group = Events(np.array([0]), came, np.array([0]), np.array([5]))
    beside = Events(
        np.array([1, 2, 3, 4]), np.ones(4, bool), np.array([0, 3, 3, 4]), np.array([2, 5, 4, 5])
    )
    found = changes._attach(group, beside, place)
    assert found.before.max() < found.after.min()
    np.testing.assert_array_equal(np.sort(found.cell), [0, 2, 3])


def test_labels_are_probabilities():
    """Single precision must not lift the label of a certain beam above 1."""
    K = 4000
    cells = np.stack([np.arange(K), np.zeros(K, int)], axis=1)
    place = make_states(cells)
    support = np.linspace(0.0, 2.0, K, dtype=np.float32)[:, None].repeat(S, axis=1)
    shown = ShownState(place, np.ones(K), support, np.zeros(0, np.intp))
    p_static = np.ones(K, np.float16)
    beams = BeamCells(
        cells.astype(np.int32), np.zeros(K, np.int32), np.arange(K, dtype=np.int32), p_static, 0.05
    )
    labels = label_session(shown, beams, (cells + 0.5) * 0.05, 0)
    assert labels.max() <= 1.0
    assert labels.min() > 0.999


def evidence(passed, D=3):
    """One block in which cells were passed by four units each."""
    passes = np.zeros((1, *(BLOCK[D],) * D), np.uint8)
    for cell in passed:
        passes[0][cell] = 4
    return Evidence(np.zeros((1, D), np.int32), np.zeros_like(passes), passes, 0.15)


def passes_of(one, D=3):
    return crop_without_gaps(one, np.zeros(D, np.int64), (BLOCK[D],) * D)[1]


def test_a_cell_between_passed_ones_is_passed_one_below_them_is_not():
    column = passes_of(evidence([(2, 2, 1), (2, 2, 4)]))[2, 2]
    np.testing.assert_array_equal(column > 0, [0, 1, 1, 1, 1, 0, 0, 0])


def test_a_wide_gap_stays():
    column = passes_of(evidence([(2, 2, 0), (2, 2, 7)]))[2, 2]
    np.testing.assert_array_equal(column > 0, [1, 0, 0, 0, 0, 0, 0, 1])


def test_cells_beside_each_other_do_not_fill_a_gap():
    filled = passes_of(evidence([(1, 2, 2), (3, 2, 2)]))
    assert filled[2, 2, 2] == 0.0


def test_the_plane_has_no_gaps():
    one = evidence([(2, 1), (2, 4)], D=2)
    np.testing.assert_array_equal(passes_of(one, 2), one.crop(np.zeros(2, np.int64), (32, 32))[1])


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
