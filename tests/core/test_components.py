"""Which cells belong together, worked out by hand."""

import numpy as np
import pytest

from stillmap.core import square_box as components
from stillmap.core.square_box import adjacent_pairs, connected_components, neighbor_pairs


def held(pairs):
    return {tuple(sorted(pair)) for pair in pairs.tolist()}


def test_pairs_within_a_distance():
    cells = np.array([[0, 0], [3, 0], [3, 4], [-2, 0]])
    assert held(neighbor_pairs(cells, 3.0)) == {(0, 1), (0, 3)}
    assert held(neighbor_pairs(cells, 2.9)) == {(0, 3)}
    assert held(neighbor_pairs(cells, 5.0)) == {(0, 1), (0, 2), (0, 3), (1, 2), (1, 3)}


def test_pairs_in_space():
    cells = np.array([[0, 0, 0], [0, 0, 2], [9, 9, 9]])
    assert held(neighbor_pairs(cells, 2.0)) == {(0, 1)}


@pytest.mark.parametrize("n", [0, 1])
def test_no_cells_no_pairs(n):
    pairs = neighbor_pairs(np.empty((n, 2), np.int64), 3.0)
    assert pairs.shape == (0, 2)
    assert [one.tolist() for one in connected_components(pairs, n)] == [[0]] * n


def test_many_cells_are_paired_as_few_are(monkeypatch):
    rng = np.random.default_rng(0)
    for dimension, radius in ((2, 2.0), (3, 3.0)):
        cells = rng.integers(0, 30, (250, dimension))
        few = neighbor_pairs(cells, radius)
        few_labels = components.component_labels(few, 250)
        with monkeypatch.context() as patch:
            patch.setattr(components, "_FEW_CELLS", 0)
            patch.setattr(components, "_FEW_NODES", 0)
            many = neighbor_pairs(cells, radius)
            assert held(few) == held(many)
            assert len(few) == len(many) > 50
            many_labels = components.component_labels(many, 250)
        np.testing.assert_array_equal(few_labels, many_labels)
        assert 5 < few_labels.max() < 245


def test_components():
    pairs = np.array([[4, 1], [1, 6], [5, 2]])
    assert sorted(one.tolist() for one in connected_components(pairs, 7)) == [
        [0],
        [1, 4, 6],
        [2, 5],
        [3],
    ]


def test_components_partition_the_nodes():
    rng = np.random.default_rng(0)
    pairs = rng.integers(0, 100, (60, 2))
    sets = connected_components(pairs, 100)
    assert sorted(np.concatenate(sets).tolist()) == list(range(100))
    number = np.empty(100, int)
    for k, one in enumerate(sets):
        number[one] = k
        assert (np.diff(one) > 0).all()
    assert (number[pairs[:, 0]] == number[pairs[:, 1]]).all()
    assert len(sets) >= 40  # a pair connects two at most


@pytest.mark.parametrize("share", [0.05, 0.4, 0.8])
def test_adjacent_pairs_are_those_within_one_row_and_column(share):
    cells = np.argwhere(np.random.default_rng(3).random((14, 17)) < share) - 5
    assert held(adjacent_pairs(cells)) == held(neighbor_pairs(cells, 1.5))


def test_no_cells_have_no_adjacent_pairs():
    assert adjacent_pairs(np.empty((0, 2), np.int64)).shape == (0, 2)
