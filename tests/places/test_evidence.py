"""Evidence of sessions: gaps between the channels of a lidar."""

import numpy as np

from stillmap.places.evidence import BLOCK, Evidence, crop_without_gaps


def evidence(passed, D=3):
    """One block in which cells were passed by four units each."""
    passes = np.zeros((1, *(BLOCK[D],) * D), np.uint8)
    for cell in passed:
        passes[0][cell] = 4
    return Evidence(np.zeros((1, D), np.int32), np.zeros_like(passes), passes, 0.15)


def passes_of(one, D=3):
    return crop_without_gaps(one, np.zeros(D, np.int64), (BLOCK[D],) * D)[1]


def test_a_cell_between_passed_ones_is_passed_one_below_them_is_not():
    column = passes_of(evidence([(2, 2, 1), (2, 2, 4)]))[2, 2]
    np.testing.assert_array_equal(column > 0, [0, 1, 1, 1, 1, 0, 0, 0])


def test_a_wide_gap_stays():
    column = passes_of(evidence([(2, 2, 0), (2, 2, 7)]))[2, 2]
    np.testing.assert_array_equal(column > 0, [1, 0, 0, 0, 0, 0, 0, 1])


def test_cells_beside_each_other_do_not_fill_a_gap():
    filled = passes_of(evidence([(1, 2, 2), (3, 2, 2)]))
    assert filled[2, 2, 2] == 0.0


def test_the_plane_has_no_gaps():
    one = evidence([(2, 1), (2, 4)], D=2)
    np.testing.assert_array_equal(passes_of(one, 2), one.crop(np.zeros(2, np.int64), (32, 32))[1])
