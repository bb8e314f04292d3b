"""A straight row that changed may be a leaf seen in one position: its label says so."""

import numpy as np
import pytest
from synthetic_histories import block, course, together

from stillmap.mapping import Change
from stillmap.mapping.changed_objects import find_shown_cells
from stillmap.mapping.doors import Door, DoorState, is_row

CELL = 0.05
ROW, OTHER_ROW, BOX = block(0, 0, 17, 2), block(40, 0, 2, 15), block(80, 0, 12, 9)
SHUT, OPEN, BETWEEN = block(0, 50, 18, 1), block(0, 51, 1, 17), block(9, 60, 2, 2)


@pytest.mark.parametrize(
    ("cells", "expected"),
    [
        (ROW, True),
        (OTHER_ROW, True),
        (block(0, 0, 17, 5), True),
        (np.column_stack([np.arange(14), np.arange(14)]), True),  # diagonal
        (BOX, False),
        (block(0, 0, 5, 4), False),  # too short
        (block(0, 0, 50, 2), False),  # too long
        (block(0, 0, 12, 6), False),  # too wide
    ],
)
def test_a_row_is_straight_and_as_long_as_a_leaf(cells, expected):
    assert is_row(cells, CELL) == expected


def change(cells, door=None):
    kind = "came" if door is None else "door"
    return Change(kind, 0.0, 0.0, (0.1, 0.1), cells, CELL, 1, 2, 2, 1, door=door)


def door():
    states = (DoorState("shut", 0, 1), DoorState("open", 2, 3))
    swept = np.concatenate([SHUT, OPEN, BETWEEN])
    leaf = Door((0.0, 2.5), 0.9, 0.0, 1.57, SHUT, OPEN, swept, states)
    return change(np.concatenate([SHUT, OPEN, BETWEEN]), leaf)


def leaves(*changes):
    """P(leaf) in the cells of both rows, the box, and the door's positions."""
    parts = [ROW, OTHER_ROW, BOX, SHUT, OPEN, BETWEEN]
    histories = together(*(course(cells, True, (10, 12)) for cells in parts))
    found = find_shown_cells(histories, [*changes], "last").p_leaf
    ends = np.cumsum([len(cells) for cells in parts])[:-1]
    alike = [np.unique(part) for part in np.split(found, ends)]
    assert all(len(one) == 1 for one in alike)
    return [float(one[0]) for one in alike]


def test_among_rows_none_of_which_swung_few_are_leaves():
    row, other, box, *_ = leaves(change(ROW), change(OTHER_ROW), change(BOX))
    assert row == other == pytest.approx(1 / 4)
    assert box == 0.0


def test_where_doors_swing_a_row_is_probably_a_leaf():
    row, *_ = leaves(change(ROW), door(), door(), door())
    assert row == pytest.approx(2 / 3)


def test_all_that_changed_of_a_door_is_leaf():
    *_, box, shut, opened, between = leaves(change(BOX), door())
    assert shut == opened == between == 1.0
    assert box == 0.0


def test_the_map_is_the_same_with_and_without_rows():
    """A leaf that was seen last where the row is stands there, whatever swings."""
    histories = course(ROW, True, (10, 12))
    one = find_shown_cells(histories, [change(ROW)], "last")
    other = find_shown_cells(histories, [change(ROW), change(OTHER_ROW)], "last")
    np.testing.assert_array_equal(one.p_in_map, other.p_in_map)
