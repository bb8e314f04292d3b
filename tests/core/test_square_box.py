"""Which cells belong together; boxes of squares, whole where they are filled."""

import numpy as np
import pytest

from stillmap.core.square_box import (
    SquareBox,
    adjacent_pairs,
    bound_box,
    connected_components,
    find_busiest,
    neighbor_pairs,
)

RNG = np.random.default_rng(3)
PLACE = RNG.integers(0, 30, (500, 2))
FAR = np.array([[200_000, -100_000]])


def limits(box):
    return box.low.tolist(), box.high.tolist()


def test_one_far_square_is_left_out():
    squares = np.concatenate([PLACE[:250], FAR, PLACE[250:]])
    box = bound_box(squares, 10_000, 10**9)
    assert limits(box) == limits(bound_box(PLACE, 10_000, 10**9))
    assert not box.contains(FAR).any()


def test_a_connected_place_stays_whole():
    along, beside = np.arange(3000), np.full(3000, 40)
    loop = [np.stack(one, 1) for one in ((along, 0 * along), (along, beside), (0 * along, along))]
    box = bound_box(np.concatenate([*loop, FAR]), 100, 10**9)
    assert limits(box) == ([0, 0], [2999, 2999])
    parts = [one * 17 for one in loop]  # with larger gaps than within a place
    assert bound_box(np.concatenate(parts), 100, 10**9).area < 10**6


def test_the_part_lies_around_the_places():
    other = PLACE[:100] + np.array([50_000, 0])
    squares = np.concatenate([PLACE, other])
    box = bound_box(squares, 10_000, 10**9, places=np.tile([50_010, 15], (3, 1)))
    assert box.contains(other).all()
    assert not box.contains(PLACE).any()


def test_a_larger_box_around_is_returned_where_it_is_filled():
    around = SquareBox(np.array([-5, -5]), np.array([60, 60]))
    assert bound_box(PLACE, 100, 10**9, around=around) is around
    far = SquareBox(np.array([-5, -5]), np.array([10**6, 10**6]))
    assert limits(bound_box(PLACE, 10_000, 10**9, around=far)) == limits(
        bound_box(PLACE, 10_000, 10**9)
    )


@pytest.mark.parametrize("shift", [0, -7_000_000, 7_000_000])
def test_busiest_place(shift):
    places = np.concatenate([PLACE, PLACE[:40] + 5000]) + shift
    assert np.abs(find_busiest(places, 1000) - shift - 15).max() <= 15


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
