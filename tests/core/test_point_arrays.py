"""Helpers for arrays of points."""

import numpy as np
import pytest

from stillmap.core.arrays import finite_rows


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_point_is_finite_with_all_its_coordinates(dimension):
    points = np.zeros((6, dimension), np.float32)
    points[1, 0], points[2, -1], points[4] = np.nan, np.inf, -np.inf
    points[5] = np.finfo(np.float32).max  # their sum would not be
    assert finite_rows(points).tolist() == [True, False, False, True, False, True]
