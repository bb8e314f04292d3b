"""Which cells are one place, and when it changed: worked out by hand."""

import numpy as np
import pytest
from synthetic_histories import RESOLUTION, block, course, found, recording, seconds

from stillmap.mapping import detect_changes

BOX = block(10, 20, 4, 3)


def beside(cells):
    """The same, so many cells farther along x."""
    return block(10 + cells, 20, 4, 3)


def test_a_box_that_came():
    (one,) = found(course(BOX, True, (40, 43)))
    assert one.kind == "came"
    assert one.appeared
    assert (one.x, one.y) == pytest.approx((1.2, 2.15))
    assert one.size == pytest.approx((0.4, 0.3))
    assert sorted(map(tuple, one.cells.tolist())) == sorted(map(tuple, BOX.tolist()))
    assert seconds(one) == (40, 43, 43)
    assert one.times == 1
    np.testing.assert_array_equal(one.swept_cells, one.cells)


def test_a_moved_box_left_one_place_and_came_to_the_other():
    # a cell apart and at the same time, but of two kinds
    old, new = course(BOX, False, (40, 43)), course(beside(5), True, (41, 44))
    left, came = found(new, old)
    assert (left.kind, came.kind) == ("left", "came")
    assert left.x < came.x
    assert seconds(left)[:2] == (40, 43)
    assert seconds(came)[:2] == (41, 44)


def test_what_is_not_near_is_another_place():
    one = course(BOX, True, (40, 43))
    assert len(found(one, course(beside(8), True, (40, 43)))) == 1  # five cells apart
    assert len(found(one, course(beside(9), True, (40, 43)))) == 2
    assert len(found(one, course(beside(9), True, (40, 43)), near=0.7)) == 1


def test_the_time_is_that_between_all_looks_of_the_place():
    # each cell was looked at now and then: 30 to 50, 38 to 60, 20 to 41 leave 38 to 41
    parts = [
        course(BOX[0:4], True, (30, 50)),
        course(BOX[4:8], True, (38, 60)),
        course(BOX[8:12], True, (20, 41)),
    ]
    (one,) = found(*parts)
    assert seconds(one) == (38, 41, 41)
    assert len(one.cells) == 12


@pytest.mark.parametrize(("least", "places"), [(1, 1), (12, 1), (13, 0)])
@pytest.mark.parametrize("count", [1, 4])
def test_few_cells_are_not_listed(least, places, count):
    assert len(found(course(BOX, True, (40, 43), count=count), least=least)) == places


def test_what_is_not_likely_to_have_changed_is_not_listed():
    assert found(course(BOX, True, (40, 43), p=0.5)) == []
    assert len(found(course(BOX, True, (40, 43), p=0.51))) == 1
    assert found(course(BOX, True, count=0)) == []


def test_what_came_and_left_again_is_both():
    came, left = found(course(BOX, False, (20, 22), (60, 64)))
    assert (came.kind, left.kind) == ("came", "left")
    assert seconds(came) == (20, 22, 22)
    assert seconds(left) == (60, 64, 64)
    assert came.times == left.times == 1
    np.testing.assert_array_equal(came.cells, left.cells)


def test_what_comes_and_goes():
    few = course(BOX[:6], True, (10, 12), (80, 82), count=5)
    many = course(BOX[6:], True, (14, 17), (70, 75), count=7)
    (one,) = found(few, many)
    assert one.kind == "comes and goes"
    assert not one.appeared
    assert one.times == 6
    assert len(one.cells) == 12
    before, first, last = seconds(one)
    assert before <= first == 12
    assert last == 82


def test_a_door_beside_a_box_is_another_place():
    door = course(beside(4), True, (10, 12), (80, 82), count=5)
    assert [one.kind for one in found(door, course(BOX, True, (40, 43)))] == [
        "comes and goes",
        "came",
    ]


def test_nothing_changed():
    assert found(course(np.empty((0, 2)), True)) == []
    assert found(course(BOX, True, count=0)) == []
    one = recording([0.0])
    nothing = course(np.empty((0, 2)), True)
    assert detect_changes(nothing, one, RESOLUTION, 0.5) == []


def wall(y, x=0, width=40):
    """What stands still along a row."""
    return course(block(x, y, width, 1), True, count=0, p=0.02, static=0.95)


@pytest.mark.parametrize("count", [1, 4])
@pytest.mark.parametrize(
    ("y", "far"),  # how many of the cells of the box in rows 20 to 22 are farther than two from it
    [(25, 12), (24, 8), (23, 4), (22, 0), (21, 0), (18, 8)],
)
def test_what_moves_to_and_fro_beside_a_wall_is_noise(y, far, count):
    box = course(BOX, True, (40, 43), count=count)
    for least in (4, 5, 8, 9, 12):
        assert len(found(box, wall(y), least=least)) == (far >= least)


def test_a_place_that_reaches_to_a_wall_keeps_all_its_cells():
    (one,) = found(course(BOX, True, (40, 43)), wall(23))
    assert len(one.cells) == len(BOX)
    # a part that is noise alone belongs to the larger place beside it
    large, part = course(BOX, False, (40, 43)), course(block(14, 23, 6, 1), False, (60, 63))
    assert len(found(large, part, wall(24, 14, 6))) == 1
    assert len(found(large, part, wall(24, 14, 6))[0].cells) == len(BOX) + 6
    assert found(part, wall(24, 14, 6)) == []
