"""Changes of cells grouped to objects, and labels by what a map shows."""

import numpy as np

from stillmap.places import changes
from stillmap.places.evidence import BeamCells
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
    group = changes._Events(np.array([0]), came, np.array([0]), np.array([5]))
    beside = changes._Events(
        np.array([1, 2, 3, 4]),
        np.ones(4, bool),
        np.array([0, 3, 3, 4]),
        np.array([2, 5, 4, 5]),
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
