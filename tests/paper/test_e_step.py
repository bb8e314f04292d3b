"""Equations (6) and (8): the expectation of c given the map."""

import numpy as np
import pytest


def expectations(lane, grid, ranges, hit, prior):
    return lane.impl.e_step(grid, *lane.beams(ranges, hit), prior)


@pytest.mark.parametrize(
    ("end", "prior", "e"),
    [
        (3.5, 0.8, 12 / 13),  # m = 3/4: .8 * 3/4 = .6 against .2 * 1/4 = .05
        (1.5, 0.8, 1 / 2),  # m = 1/5: .8 * 1/5 = .16 against .2 * 4/5 = .16
        (3.5, 0.5, 3 / 4),  # with p = 1/2 e is m itself
        (1.5, 0.5, 1 / 5),
        (1.5, 0.9, 9 / 13),  # .9 * 1/5 = .18 against .1 * 4/5 = .08
        (2.5, 0.9, 0.0),  # m = 0: nothing static can be there
    ],
)
def test_equation_8_posterior_of_static(lane, end, prior, e):
    assert expectations(lane, lane.known_map(), [end], [True], prior) == pytest.approx(e, abs=1e-6)


def test_equation_8_as_printed(lane):
    # p epsilon with epsilon = 1 / (p + (1 - p)(1/m - 1)); m = 3/4, p = .8: 1 / (.8 + .2/3) = 15/13
    e = expectations(lane, lane.known_map(), [3.5], [True], 0.8)
    assert e == pytest.approx(0.8 * 15 / 13, abs=1e-6)


def test_equation_8_certain_cell(lane):
    grid = lane.grid()
    lane.add(grid, [2.5], [True], [1])  # m = 1
    assert expectations(lane, grid, [2.5], [True], 0.3) == pytest.approx(1)


def test_equation_6_maximum_range_keeps_the_prior(lane):
    # whatever the occupancy of the cell in which it ends: 3/4, 1/5, 0, unknown
    e = expectations(lane, lane.known_map(), [3.5, 1.5, 2.5, 6.5], [0, 0, 0, 0], 0.7)
    assert e == pytest.approx([0.7] * 4)


def test_unknown_cell_keeps_the_prior_and_unusable_is_nan(lane):
    e = expectations(lane, lane.known_map(), [5.5, np.nan, np.inf], [1, 1, 0], 0.7)
    assert e.dtype == np.float32
    assert e == pytest.approx([0.7, np.nan, np.nan], nan_ok=True)
