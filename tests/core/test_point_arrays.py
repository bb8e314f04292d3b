"""Helpers for arrays of points and of indices."""

import numpy as np
import pytest

from stillmap.core.arrays import finite_rows, first_index_per_group


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_point_is_finite_with_all_its_coordinates(dimension):
    points = np.zeros((6, dimension), np.float32)
    points[1, 0], points[2, -1], points[4] = np.nan, np.inf, -np.inf
    points[5] = np.finfo(np.float32).max  # their sum would not be
    assert finite_rows(points).tolist() == [True, False, False, True, False, True]


@pytest.mark.parametrize("n", [0, 1, 2, 3, 64, 65, 1000])
@pytest.mark.parametrize("groups", [1, 7, 2**40])
def test_first_of_each_is_that_of_unique(n, groups):
    group = np.random.default_rng(n).integers(0, groups, n)
    np.testing.assert_array_equal(
        first_index_per_group(group), np.unique(group, return_index=True)[1]
    )
