"""Doors among changes: both positions, and when the leaf was in which."""

import dataclasses

import numpy as np
import pytest
from synthetic_histories import RESOLUTION, recording

from stillmap.mapping import Change, find_doors, join_doors
from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.mapping.resting_leaf import find_resting_leaf

S = 10**9
HINGE, LEAF = np.array([20, 30]), 9
SHUT = np.column_stack([np.arange(20, 20 + LEAF + 1), np.full(LEAF + 1, 30)])
OPEN = np.column_stack([np.full(LEAF, 20), np.arange(31, 31 + LEAF)])
# the wall goes on beyond the shut leaf and behind the hinge
WALL = np.array([[x, 30] for x in (*range(5, 19), *range(31, 45))])


def change(kind, cells, before, after, times=1):
    x, y = ((cells.mean(axis=0) + 0.5) * RESOLUTION).tolist()
    size = tuple((np.ptp(cells, axis=0) * RESOLUTION + RESOLUTION).tolist())
    return Change(kind, x, y, size, cells, RESOLUTION, before * S, after * S, after * S, times)


BEHIND = np.array([[35, 45], [36, 45], [37, 45]])  # seen through the open door


def looks(positions, passing=True):
    """Scans that end on all cells of the leaf where it is, in the middle of the cells."""
    through = np.concatenate([OPEN, BEHIND]) if passing else OPEN
    ends = [{"shut": SHUT, "open": through, None: WALL}[one] for one in positions]
    counts = [len(one) for one in ends]
    points = (np.concatenate(ends) + 0.5) * RESOLUTION
    seen = recording(range(len(positions)), 1)
    return dataclasses.replace(
        seen,
        offset=np.concatenate([[0], np.cumsum(counts)]),
        points=points.astype(np.float32),
        hit=np.ones(len(points), bool),
    ), np.tile(np.eye(3), (len(positions), 1, 1))


def opened_once():
    return looks(["shut"] * 40 + [None] * 5 + ["open"] * 55)


LEFT, CAME = change("left", SHUT, 39, 45), change("came", OPEN, 39, 45)
CRATE = change("came", np.array([[60, 60], [61, 60], [60, 61], [61, 61]]), 20, 21)


def joined(changes, surface, seen, poses):
    known = LabelledRecording(seen, poses, np.ones(seen.n_beams, np.float32), RESOLUTION)
    return join_doors(changes, find_doors(changes, [], surface, known))


def test_departure_and_arrival_of_a_leaf_are_one_door():
    found = joined([CRATE, LEFT, CAME], WALL, *opened_once())
    assert [one.kind for one in found] == ["came", "door"]
    assert found[0] is CRATE
    door = found[1].door
    np.testing.assert_allclose(door.hinge, (HINGE + 0.5) * RESOLUTION, atol=0.11)
    assert door.length == pytest.approx(LEAF * RESOLUTION, abs=0.11)
    assert door.shut == pytest.approx(0.0, abs=0.15)
    assert door.opened == pytest.approx(np.pi / 2, abs=0.15)
    assert [tuple(one) for one in door.states] == [
        ("shut", 5 * S, 44 * S),
        ("open", 50 * S, 104 * S),
    ]
    assert found[1].times == 1
    assert (found[1].before_ns, found[1].stamp_ns) == (44 * S, 50 * S)


def test_the_wall_says_which_position_is_shut():
    other = np.column_stack([np.full(8, 20), np.arange(41, 49)])
    (found,) = joined([LEFT, CAME], other, *opened_once())
    assert found.door.shut == pytest.approx(np.pi / 2, abs=0.15)
    assert [one.position for one in found.door.states] == ["open", "shut"]


def test_a_leaf_that_rests_open_is_part_of_its_door():
    often = change("comes and goes", SHUT[2:], 39, 45, times=3)
    seen = looks(["open"] * 30 + ["shut"] * 20 + ["open"] * 50)
    surface = np.concatenate([WALL, OPEN])
    (found,) = joined([often], surface, *seen)
    assert found.kind == "door"
    assert found.door.shut == pytest.approx(0.0, abs=0.2)
    assert [one.position for one in found.door.states] == ["open", "shut", "open"]
    assert len(found.cells) == len(often.cells)  # the leaf at rest did not change


def test_a_leaf_at_rest_is_free_at_its_end_and_beside():
    length, fine = 18, 0.5 * RESOLUTION
    row = np.arange(1, length + 1)
    line = np.column_stack([20 + row[2:], np.full(length - 2, 30)])
    wall = np.array([[x, 30] for x in (*range(5, 19), *range(40, 60))])

    def found(x, rows):
        beside = np.array([(i, 30 + j) for i in x for j in rows])
        return find_resting_leaf(line, np.concatenate([wall, beside]), fine)

    assert len(found([20], row)) >= length - 2
    assert len(found([20], np.arange(1, 30))) == 0  # a wall
    assert len(found(range(10, 21), row)) == 0  # the side of a cupboard
    assert len(found([20], row[:8])) == 0
    assert len(find_resting_leaf(line, wall, fine)) == 0


@pytest.mark.parametrize(
    ("positions", "passing"),
    [
        (["shut"] * 40 + [None] * 60, True),  # seen in one position only
        (["shut"] * 40 + ["open"] * 60, False),  # two sides of a box that are seen in turn
        (["shut"] + ["open"] * 99, True),  # who walks by once
    ],
)
def test_what_is_no_leaf_is_no_door(positions, passing):
    found = joined([LEFT, CAME], WALL, *looks(positions, passing=passing))
    assert [one.kind for one in found] == ["came", "left"]


def test_an_arrival_at_another_time_is_no_door():
    later = change("came", OPEN, 70, 75)
    found = joined([LEFT, later], WALL, *opened_once())
    assert [one.kind for one in found] == ["left", "came"]
