"""Scores of maps and times where things are moved, on a lattice of 10 cm."""

import json
import math
from typing import NamedTuple

import numpy as np
import pytest
from change_scores import Beams, Stay, list_true_changes, score_change_times, score_changes

from stillmap.core import se2
from stillmap.results.reader import Grid
from stillmap.sim.walls import box

R = 0.1
HERE = np.eye(3)
WALLS = np.array([[4.0, 0.0, 4.0, 4.0]])
S = 10**9


class Found(NamedTuple):
    x: float
    y: float
    appeared: bool
    stamp_ns: int


def stay(x, y, since, until, mover=0):
    ends = [None if t is None else round(t * S) for t in (since, until)]
    return Stay(mover, np.array([x, y]), np.array(box(x, y, 0.2, 0.4)), *ends)


def looks(stays, seconds, wall=4.0):
    """Scans from x = 0 along rows of cells, straight to the east: to a thing, or to the wall."""
    stamps = np.round(np.asarray(seconds) * S).astype(np.int64)
    rows = np.arange(0.05, 4.0, R)
    scan, y = np.repeat(np.arange(len(stamps)), len(rows)), np.tile(rows, len(stamps))
    x, who = np.full(len(y), wall), np.full(len(y), -1, np.int32)
    for one in stays:
        met = one.contains(stamps)[scan] & (np.abs(y - one.center[1]) < 0.2)
        x[met], who[met] = one.center[0] - 0.1 + 0.001, one.mover
    start = np.column_stack([np.full(len(y), 0.01), y])
    return Beams(start, np.column_stack([x, y]), who, scan, stamps)


def grid_with(cells, origin=(0.0, 0.0, 0.0)):
    p = np.full((42, 42), 0.1)
    p[tuple(np.array(cells, int).reshape(-1, 2).T)] = 0.9
    return Grid(p, origin, R)


MOVED = [stay(2.0, 1.0, None, 4.5), stay(2.0, 3.0, 4.5, None)]
TEN = looks(MOVED, range(10))
OLD = [(row, 19) for row in (8, 9, 10, 11)]
NEW = [(row, 19) for row in (28, 29, 30, 31)]


def test_a_map_of_the_end_is_perfect_and_one_of_the_beginning_is_not():
    last = score_changes(grid_with(NEW), MOVED, TEN, WALLS, HERE)
    assert (last.new_cells, last.new_kept, last.old_cells, last.old_occupied) == (4, 1.0, 4, 0.0)
    first = score_changes(grid_with(OLD), MOVED, TEN, WALLS, HERE)
    assert (first.new_kept, first.old_occupied) == (0.0, 1.0)


def test_new_cells_may_be_off_by_one_and_old_ones_may_not():
    aside = [(row, column + 1) for row, column in (*NEW, *OLD)]
    s = score_changes(grid_with(aside), MOVED, TEN, WALLS, HERE)
    assert (s.new_kept, s.old_occupied) == (1.0, 0.0)
    s = score_changes(grid_with([*NEW[:1], *OLD[:1]]), MOVED, TEN, WALLS, HERE)
    assert (s.new_kept, s.old_occupied) == (0.5, 0.25)


def test_cells_hit_less_than_three_times_do_not_count():
    s = score_changes(grid_with([]), MOVED, looks(MOVED, [3, 4, 5, 6]), WALLS, HERE)
    assert (s.new_cells, s.old_cells) == (0, 0)
    assert math.isnan(s.new_kept)
    plain = s.to_dict()
    assert plain["old_occupied"] is None
    json.dumps(plain, allow_nan=False)


def test_old_cells_must_have_been_seen_again():
    # twice afterwards only; or three times, but something else stands before them
    hidden = [MOVED[0], stay(1.0, 1.0, 4.5, None, 1)]
    for stays, seconds in ((MOVED, [0, 1, 2, 5, 6]), (hidden, range(10))):
        found = score_changes(grid_with([]), stays, looks(stays, seconds), WALLS, HERE)
        assert found.old_cells == 0


def test_the_frame_of_the_map_does_not_matter():
    T_world_map = se2.matrix(5.0, -3.0, 2.2)
    origin = tuple(se2.parameters(se2.inverse(T_world_map)))
    s = score_changes(grid_with([*NEW, *OLD[:1]], origin), MOVED, TEN, WALLS, T_world_map)
    assert (s.new_cells, s.new_kept, s.old_cells, s.old_occupied) == (4, 1.0, 4, 0.25)


def test_true_changes_and_the_first_look_after_each():
    beams = looks(MOVED, [0, 1, 2, 3, 4, 7.5, 9])
    came, went = sorted(list_true_changes(MOVED, beams), key=lambda c: not c.appeared)
    assert (came.appeared, went.appeared) == (True, False)
    assert came.stamp_ns == went.stamp_ns == 4.5 * S
    assert came.observed_ns == went.observed_ns == 7.5 * S


def test_a_change_that_nobody_saw_both_sides_of_is_known_to_nobody():
    # a wall of fog at 1 m: nothing behind it is ever seen
    fog = looks([], range(10), wall=1.0)
    assert [c.observed_ns for c in list_true_changes(MOVED, fog)] == [None, None]
    late = looks(MOVED, [5, 6, 7])  # it had happened: no changes of this recording
    assert list_true_changes(MOVED, late) == []


def test_errors_are_zero_between_the_change_and_the_first_look():
    true = list_true_changes(MOVED, looks(MOVED, [0, 1, 2, 3, 4, 7.5, 9]))
    for stamp, error in ((4.5, 0.0), (7.5, 0.0), (6.0, 0.0), (3.0, 1.5), (9.0, 1.5)):
        s = score_change_times([Found(1.9, 3.0, True, round(stamp * S))], true, HERE)
        assert (s.seen, s.found, s.missed, s.false) == (2, 1, 1, 0)
        assert s.errors == pytest.approx((error,))


def test_changes_are_matched_by_kind_and_place():
    true = list_true_changes(MOVED, TEN)
    gone = Found(2.0, 1.0, False, 5 * S)
    wrong = [Found(2.0, 1.0, True, 5 * S), Found(3.0, 3.0, True, 5 * S)]  # a kind; 0.9 m off
    s = score_change_times([gone, *wrong], true, HERE)
    assert (s.found, s.missed, s.false) == (1, 1, 2)
    nearest = [Found(2.4, 3.0, True, 9 * S), Found(2.1, 3.0, True, 5 * S)]
    s = score_change_times([gone, *nearest], true, HERE)
    assert (s.found, s.missed, s.false, s.errors) == (2, 0, 0, (0.0, 0.0))
    assert score_change_times([], true, HERE).missed == 2
    assert score_change_times([gone], [], HERE).false == 1
