"""Cells of one object take one state."""

import numpy as np
import pytest
from synthetic_histories import RESOLUTION, block, course

from stillmap.mapping import Change
from stillmap.mapping.changed_objects import group_objects, is_same_place, pool_states


def change(kind, cells, times=1):
    x, y = (cells.mean(axis=0) + 0.5) * RESOLUTION
    size = tuple(np.ptp(cells, axis=0) * RESOLUTION + RESOLUTION)
    return Change(kind, x, y, size, cells, RESOLUTION, 1, 2, 2, times)


def histories(cells, share, last=None, weight=None, count=1):
    from dataclasses import replace

    one = course(cells, True, (10, 12))
    n = len(one.cells)
    return replace(
        one,
        occupied_share=np.asarray(share, np.float32),
        p_object=np.asarray(share if last is None else last, np.float32),
        p_changing=np.ones(n, np.float32) if weight is None else np.asarray(weight, np.float32),
        n_changes=np.full(n, count, np.int32),
    )


CRATE = block(0, 0, 2, 3)
OTHER = block(20, 0, 2, 3)
MIXED = [0.9, 0.2, 0.7, 0.7, 0.4, 0.9]


@pytest.mark.parametrize("state", ["last", "majority"])
def test_an_object_takes_the_mean_of_its_cells(state):
    found = histories(np.concatenate([CRATE, OTHER]), [*MIXED, 0.1, 0.0, 0.8, 0.1, 0.2, 0.0])
    pooled = pool_states(found, [change("came", CRATE), change("left", OTHER)], state)
    np.testing.assert_allclose(pooled[:6], np.mean(MIXED), rtol=1e-6)
    np.testing.assert_allclose(pooled[6:], 0.2, rtol=1e-6)
    shown = found.p_in_map("majority", pooled)
    assert (shown[:6] > 0.5).all()
    assert (shown[6:] < 0.5).all()


def test_cells_that_surely_changed_count_most():
    found = histories(CRATE, MIXED, weight=[1, 0, 0, 0, 0, 1])
    pooled = pool_states(found, [change("left", CRATE)], "majority")
    np.testing.assert_allclose(pooled, 0.9, atol=0.01)


def test_unlisted_cells_decide_alone():
    found = histories(np.concatenate([CRATE, OTHER]), MIXED * 2)
    pooled = pool_states(found, [change("left", CRATE)], "majority")
    np.testing.assert_allclose(pooled[6:], MIXED, rtol=1e-6)


def test_arrival_and_departure_are_of_one_object():
    came, left = change("came", CRATE), change("left", CRATE[:4])
    elsewhere = change("left", OTHER)
    assert is_same_place(came, left)
    assert not is_same_place(came, elsewhere)
    assert [one.tolist() for one in group_objects([elsewhere, left, came])] == [[0], [1, 2]]
    pooled = pool_states(histories(CRATE, MIXED), [came, left], "majority")
    assert len(np.unique(pooled)) == 1


def test_of_two_objects_the_likelier_one_counts_where_both_stood():
    cells = block(0, 0, 9, 1)
    share = [0.2] * 4 + [0.6] * 5
    one, other = change("left", cells[:5]), change("came", cells[3:])
    pooled = pool_states(histories(cells, share), [one, other], "majority")
    np.testing.assert_allclose(pooled[:3], np.mean(share[:5]), rtol=1e-6)
    np.testing.assert_allclose(pooled[3:], np.mean(share[3:]), rtol=1e-6)


def test_both_positions_of_a_door_keep_their_states():
    leaf, other = block(0, 0, 8, 1), block(0, 8, 1, 8)
    cells = np.concatenate([leaf, other])
    share = np.array([0.9, 0.4, 0.9, 0.9, 0.8, 0.4, 0.9, 0.9] + [0.1, 0.2, 0.6, 0.1] * 2)
    found = histories(cells, share, count=4)
    pooled = pool_states(found, [change("comes and goes", cells, 4)], "majority")
    assert (pooled[:8] > 0.5).all()
    assert (pooled[8:] < 0.5).all()


def test_nothing_listed():
    found = histories(CRATE, MIXED)
    assert pool_states(found, [], "last").tolist() == found.share_there("last").tolist()
