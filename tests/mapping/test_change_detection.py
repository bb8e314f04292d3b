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


def test_a_box_that_left():
    (one,) = found(course(BOX, False, (40, 43)))
    assert one.kind == "left"
    assert not one.appeared


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


def test_boxes_side_by_side_that_came_at_different_times_are_two():
    both = course(BOX, True, (20, 22)), course(beside(4), True, (40, 43))
    first, second = found(*both[::-1])
    assert (seconds(first)[:2], seconds(second)[:2]) == ((20, 22), (40, 43))
    assert len(first.cells) == len(second.cells) == len(BOX)
    assert first.x < second.x


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


def test_cells_that_fit_two_times_go_with_the_larger_part():
    # the middle ones may have come with either: they are of the larger place
    small = course(block(0, 0, 4, 2), True, (20, 22))
    either = course(block(4, 0, 2, 2), True, (10, 60))
    large = course(block(6, 0, 5, 2), True, (50, 52))
    first, second = found(small, either, large)
    assert (len(first.cells), seconds(first)[:2]) == (8, (20, 22))
    assert (len(second.cells), seconds(second)[:2]) == (14, (50, 52))


def test_cells_of_a_place_may_change_a_little_apart():
    early, late = course(BOX[:8], True, (40, 41)), course(BOX[8:], True, (42, 43))
    (one,) = found(early, late, together=2.0)
    assert len(one.cells) == 12
    assert seconds(one)[:2] == (40, 41)  # when most of them did
    # a second and more apart: two places, the smaller of which is part of the larger
    (one,) = found(early, late, together=1.0)
    assert seconds(one)[:2] == (40, 41)
    assert [len(one.cells) for one in found(BOX_TOP, BOX_BOTTOM, together=2.0)] == [12]
    assert [len(one.cells) for one in found(BOX_TOP, BOX_BOTTOM, together=1.0)] == [6, 6]


# halves are no small parts
BOX_TOP, BOX_BOTTOM = course(BOX[:6], True, (40, 41)), course(BOX[6:], True, (42, 43))


@pytest.mark.parametrize(("least", "places"), [(1, 1), (12, 1), (13, 0)])
@pytest.mark.parametrize("count", [1, 4])
def test_few_cells_are_not_listed(least, places, count):
    assert len(found(course(BOX, True, (40, 43), count=count), least=least)) == places


def test_few_cells_at_one_time_hide_nobody_at_another():
    # most cells at one instant are three, too few; four others changed within the slack
    three = [
        course(block(0, 0, 2, 1), True, (10, 12)),
        course(block(2, 0, 1, 1), True, (10, 15)),
    ]
    four = [
        course(block(3, 0, 2, 1), True, (14, 15)),
        course(block(5, 0, 2, 1), True, (16, 17)),
    ]
    (one,) = found(*three, *four, together=1.5)
    assert len(one.cells) == 4
    assert seconds(one)[:2] == (14, 15)


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


def test_what_left_and_came_back_is_both():
    left, came = found(course(BOX, True, (20, 22), (60, 64)))
    assert (left.kind, came.kind) == ("left", "came")
    assert seconds(left)[1] == 22
    assert seconds(came)[1] == 64


def test_cells_seen_for_half_of_the_story_join_the_others():
    # the front was there when it came, the back is seen to leave only
    front, back = course(BOX[:8], False, (20, 22), (60, 64)), course(BOX[8:], False, (61, 70))
    came, left = found(front, back)
    assert (len(came.cells), len(left.cells)) == (8, 12)
    assert seconds(left)[:2] == (61, 64)


def test_a_small_part_beside_a_larger_one_belongs_to_it():
    # somebody stood there for a while: that part was free much later
    large, small = course(BOX, False, (40, 43)), course(block(14, 20, 2, 3), False, (60, 63))
    (one,) = found(large, small)
    assert len(one.cells) == 18
    assert seconds(one) == (40, 43, 43)
    assert one.x == pytest.approx(np.concatenate([BOX, small.cells]).mean(axis=0)[0] / 10 + 0.05)
    assert one.size == pytest.approx((0.6, 0.3))
    # more than half of it is a thing of its own, and so is what is far, or of another kind
    assert len(found(large, course(block(14, 20, 3, 3), False, (60, 63)))) == 2
    assert len(found(large, course(block(24, 20, 2, 3), False, (60, 63)))) == 2
    assert len(found(large, course(block(14, 20, 2, 3), True, (60, 63)))) == 2


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


def test_three_changes_are_often_and_two_are_not():
    kinds = [[one.kind for one in found(course(BOX, True, (9, 10), (50, 51), count=n))]
             for n in (2, 3)]  # fmt: skip
    assert kinds == [["left", "came"], ["comes and goes"]]


def test_a_door_beside_a_box_is_another_place():
    door = course(beside(4), True, (10, 12), (80, 82), count=5)
    assert [one.kind for one in found(door, course(BOX, True, (40, 43)))] == [
        "comes and goes",
        "came",
    ]


def test_the_order_is_that_of_time_and_then_of_place():
    times = {30: (50, 52), 0: (10, 11), 60: (50, 52), 90: (30, 31)}
    parts = [course(beside(x), True, between) for x, between in times.items()]
    assert [round(one.x, 1) for one in found(*parts)] == [1.2, 10.2, 4.2, 7.2]
    turned = [round(one.x, 1) for one in found(*parts[::-1])]
    assert turned == [1.2, 10.2, 4.2, 7.2]


def test_looks_are_told_by_their_scans():
    # four scans a second; a look of a second ends with its last scan and begins with its first
    seen = recording(np.arange(0, 100, 0.25))
    (one,) = found(course(BOX, True, (40, 43)), seen=seen)
    assert seconds(one) == (40.75, 43, 43)
    (one,) = found(course(BOX, True, (40, 43)), seen=seen, look=0.5)
    assert seconds(one) == (20.25, 21.5, 21.5)


def test_looks_count_on_through_a_night():
    # ten scans, eight hours of nothing, ten scans: the numbers of looks leap
    night = 8 * 3600
    seen = recording([*range(10), *range(night, night + 10)])
    (one,) = found(course(BOX, True, (9, night)), seen=seen)
    assert seconds(one) == (9, night, night)
    (one,) = found(course(BOX, True, (night + 2, night + 4)), seen=seen)
    assert seconds(one)[:2] == (night + 2, night + 4)


def test_scans_without_beams_change_no_time():
    # nobody looks in them: no look that changed anything is theirs
    seen = recording([0, 1, 2, 3, 4, 5.5, 9])
    (one,) = found(course(BOX, True, (2, 5)), seen=seen)
    assert seconds(one)[:2] == (2, 5.5)


def test_nothing_changed():
    assert found(course(np.empty((0, 2)), True)) == []
    assert found(course(BOX, True, count=0)) == []
    one = recording([0.0])
    nothing = course(np.empty((0, 2)), True)
    assert detect_changes(nothing, one, RESOLUTION, 0.5) == []


def test_one_change_of_a_cell_alone():
    (one,) = found(course([[3, -4]], True, (40, 43)), least=1)
    assert (one.x, one.y) == pytest.approx((0.35, -0.35))
    assert one.size == pytest.approx((0.1, 0.1))


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


def test_two_cells_are_as_the_crow_flies():
    # of 12 cells 3 are two or less from a static one at their corner, those aslant are farther
    box, one = course(BOX, True, (40, 43)), wall(20, 9, 1)
    assert [len(found(box, one, least=least)) for least in (9, 10)] == [1, 0]


def test_only_what_is_static_makes_noise():
    likely = [course(block(0, 22, 40, 1), True, count=0, p=0.02, static=p) for p in (0.5, 0.51)]
    assert len(found(course(BOX, True, (40, 43)), likely[0])) == 1
    assert found(course(BOX, True, (40, 43)), likely[1]) == []


def test_a_place_that_reaches_to_a_wall_keeps_all_its_cells():
    (one,) = found(course(BOX, True, (40, 43)), wall(23))
    assert len(one.cells) == len(BOX)
    # a part that is noise alone belongs to the larger place beside it
    large, part = course(BOX, False, (40, 43)), course(block(14, 23, 6, 1), False, (60, 63))
    assert len(found(large, part, wall(24, 14, 6))) == 1
    assert len(found(large, part, wall(24, 14, 6))[0].cells) == len(BOX) + 6
    assert found(part, wall(24, 14, 6)) == []


def test_the_order_of_cells_changes_nothing():
    parts = course(BOX, True, (20, 22)), course(beside(4), True, (40, 43))
    here, there = found(*parts), found(*parts[::-1])
    for one, other in zip(here, there, strict=True):
        assert (one.x, one.y, one.before_ns, one.stamp_ns) == (
            other.x,
            other.y,
            other.before_ns,
            other.stamp_ns,
        )
