"""Properties of beams by which errors are counted."""

import numpy as np
import pytest
import space_errors
from space_cases import Known


def test_heights_above_the_lowest_points_of_their_square() -> None:
    xy = np.tile([0.5, 0.5], (40, 1))
    ends = np.concatenate(
        [
            np.column_stack([xy, np.linspace(1.0, 4.9, 40)]),  # 5 % of 40 points lie lower
            [[-7.0, 0.5, -3.0]],
        ]
    )
    heights = space_errors.above_ground(ends)
    assert heights[:3] == pytest.approx([-0.2, -0.1, 0.0])
    assert heights[-1] == 0.0


def test_sweeps_of_a_voxel() -> None:
    x = np.array([0.01, 0.02, 0.29, 0.31, -0.01])
    ends = np.column_stack([x, np.zeros(5), np.zeros(5)])
    assert space_errors.sweeps_there(ends, np.array([0, 0, 3, 3, 1])).tolist() == [2, 2, 2, 1, 1]


def test_standing_times() -> None:
    stands = np.array([[1, 0], [1, 1], [0, 0], [1, 1], [1, 1]], bool)
    times = space_errors.standing_times(stands, 0.5)
    assert times[:, 0].tolist() == [1.0, 1.0, 0.0, 1.0, 1.0]
    assert times[:, 1].tolist() == [0.0, 0.5, 0.0, 1.0, 1.0]


def test_tables_count_the_scored() -> None:
    known = Known(
        static=np.array([True, True, False, False]),
        kind=np.array([1, 1, 0, 0], np.int16),
        scored=np.array([True, True, True, False]),
        kinds=["car", "static"],
        rested=np.zeros(4, bool),
    )
    wrong = np.array([True, False, True, True])
    text = space_errors.table("m", np.array([1.0, 2.0, 1.5, 1.5]), (1, 2, 3), known, wrong)
    rows = [[cell.strip() for cell in line.split("|")[1:-1]] for line in text.splitlines()[2:]]
    assert rows == [
        ["1 to 2", "1", "100.00", "100", "1", "100.00", "100"],
        ["2 to 3", "1", "0.00", "0", "0", "-", "0"],
    ]
    assert "car" in space_errors.by_kind(known, wrong)
