"""Helpers for arrays of points."""

import numpy as np
import pytest

from stillmap.core.arrays import finite_rows, squared_lengths


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_point_is_finite_with_all_its_coordinates(dimension):
    points = np.zeros((6, dimension), np.float32)
    points[1, 0], points[2, -1], points[4] = np.nan, np.inf, -np.inf
    points[5] = np.finfo(np.float32).max  # their sum would not be
    assert finite_rows(points).tolist() == [True, False, False, True, False, True]


@pytest.mark.parametrize("dimension", [2, 3])
def test_squared_lengths_are_sums_of_squares(dimension):
    points = np.random.default_rng(dimension).normal(size=(50, dimension)).astype(np.float32)
    points[3, 1] = np.nan
    np.testing.assert_array_equal(
        squared_lengths(points), np.square(points, dtype=np.float64).sum(axis=1)
    )
    assert squared_lengths(points[:0]).shape == (0,)
