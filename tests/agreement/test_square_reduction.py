"""Map layers reduced to pictures: kernel against NumPy, and by hand; the normal distribution."""

import numpy as np
import pytest
from scipy.special import ndtr

from stillmap import _core


def squares(cells, factor, fill):
    """(h, w, factor^2) cells of each square; `fill` beyond the border."""
    height, width = (-(-n // factor) * factor for n in cells.shape)
    padded = np.full((height, width), fill, cells.dtype)
    padded[: cells.shape[0], : cells.shape[1]] = cells
    shaped = padded.reshape(height // factor, factor, width // factor, factor)
    return shaped.swapaxes(1, 2).reshape(height // factor, width // factor, -1)


@pytest.mark.parametrize("factor", [1, 2, 3, 7])
def test_occupancy(factor):
    rng = np.random.default_rng(factor)
    p = rng.beta(0.3, 0.8, (23, 31)).astype(np.float32)
    p[rng.random(p.shape) < 0.6] = np.nan
    of = squares(p, factor, np.nan).astype(np.float64)
    known = (~np.isnan(of)).sum(axis=2)
    most = np.where(np.isnan(of), 0, of).max(axis=2)
    mean = np.where(np.isnan(of), 0, of).sum(axis=2) / np.maximum(known, 1)
    expected = np.where(known, np.rint(100 * np.where(most > 0.65, most, mean)), 101)
    found = _core.reduce_occupancy(p, factor, 0.65, 101)
    assert found.dtype == np.uint8
    np.testing.assert_array_equal(found, expected)


@pytest.mark.parametrize("factor", [1, 2, 5])
def test_counts(factor):
    mask = np.random.default_rng(factor).random((17, 24)) < 0.4
    found = _core.count_in_squares(mask, factor)
    np.testing.assert_array_equal(found, squares(mask, factor, False).sum(axis=2))


def test_a_thin_wall_stays_visible():
    p = np.zeros((4, 4), np.float32)
    p[:, 1] = 0.9
    assert _core.reduce_occupancy(p, 4, 0.65, 101).tolist() == [[90]]
    p[:, 1] = 0.6
    assert _core.reduce_occupancy(p, 4, 0.65, 101).tolist() == [[15]]


def test_empty_layers():
    assert _core.reduce_occupancy(np.zeros((0, 5), np.float32), 2, 0.65, 101).shape == (0, 3)
    assert _core.count_in_squares(np.zeros((3, 0), bool), 2).shape == (2, 0)


def test_normal_distribution_function():
    x = np.concatenate([np.linspace(-9.0, 9.0, 5001), [-np.inf, np.inf, np.nan, 0.0]])
    np.testing.assert_allclose(_core.normal_cdf(x), ndtr(x), rtol=1e-12)
