"""Which cells belong together, worked out by hand."""

import numpy as np
import pytest

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
