"""Equations (10) to (15): the map that maximises the expected log likelihood."""

from math import log

import numpy as np
import pytest
from reference import occupancy


def test_sums_of_equation_10(lane):
    # e = 1/4 and 1/2 in cell 3; e = 1 in cell 1; maximum range through 0 to 3, ending in 4
    #   cell 0: passed 4 times;  cell 1: alpha 1, passed 3 times;  cell 2: passed 3 times
    #   cell 3: alpha 1/4 + 1/2, beta 3/4 + 1/2 + 1 passage;  cell 4: nothing
    grid = lane.grid()
    lane.add(grid, [3.5, 3.5, 1.5, 4.5], [1, 1, 1, 0], [0.25, 0.5, 1, 0.7])
    expected = [[0, 4], [1, 3], [0, 3], [0.75, 2.25], [0, 0]]
    assert lane.alpha_beta(grid, range(5)) == pytest.approx(np.array(expected), abs=1e-7)


def test_sums_do_not_count_the_chord_inside_the_end_cell(lane):
    for end in (2.125, 2.875):
        grid = lane.grid()
        lane.add(grid, [end], [True], [1])
        expected = [[0, 1], [0, 1], [1, 0], [0, 0]]
        assert lane.alpha_beta(grid, range(4)) == pytest.approx(np.array(expected), abs=1e-7)


def test_passed_length_does_not_depend_on_e(lane):
    # "independent from whether or not the corresponding beam is reflected by a dynamic object"
    for e in (0, 0.5, 1):
        grid = lane.grid()
        lane.add(grid, [2.5], [True], [e])
        assert lane.alpha_beta(grid, [0, 1])[:, 1] == pytest.approx([1, 1])


def test_unusable_beams_leave_no_trace(lane):
    grid = lane.grid()
    lane.add(grid, [np.nan, np.inf, -np.inf], [1, 0, 0], [1, 1, np.nan])
    assert grid.dense()[1].size == 0


def test_sums_accumulate_over_calls_and_scans(lane):
    points, hit, offset, T = lane.beams([1.5, 2.5, 2.5, 1.5], [1] * 4, scans=2)
    grid = lane.grid()
    for _ in range(3):
        lane.impl.add_beams(grid, points, hit, np.ones(4, np.float32), offset, T)
    assert lane.alpha_beta(grid, [0, 1, 2]) == pytest.approx(np.array([[0, 12], [6, 6], [6, 0]]))


def test_equation_11_is_equation_10_sorted_by_cell(lane):
    # (10) evaluated beam by beam is sum_j alpha_j ln m_j + beta_j ln(1 - m_j); with m = 0, 1/5, 0,
    # 3/4 and the counts of the known map: 1 ln 1/5 + 4 ln 4/5 + 3 ln 3/4 + 1 ln 1/4 = -4.751353
    ranges, hit, e = [3.5, 3.5, 3.5, 1.5, 4.5], [1, 1, 1, 1, 0], [1, 1, 1, 1, 0.5]
    points, struck, offset, T = lane.beams(ranges, hit)
    e = np.array(e, np.float32)
    t = lane.impl.log_likelihood(lane.known_map(), points, struck, e, offset, T, 0.9)
    by_cell = log(0.2) + 4 * log(0.8) + 3 * log(0.75) + log(0.25)
    assert t[0, 0] + t[0, 1] == pytest.approx(by_cell, rel=1e-6)
    assert by_cell == pytest.approx(-4.751353, abs=1e-6)


def test_equations_12_to_14_derivative_vanishes(lane):
    # cell 3 of the known map: alpha / m - beta / (1 - m) = 3 / (3/4) - 1 / (1/4) = 4 - 4, and
    # (14), whose sign is a slip in the print: alpha (1 - m) - beta m = 3/4 - 3/4
    sums = lane.alpha_beta(lane.known_map(), range(4))
    for j, m in ((1, 1 / 5), (3, 3 / 4)):
        alpha, beta = sums[j]
        assert alpha / m - beta / (1 - m) == pytest.approx(0, abs=1e-5)
        assert alpha * (1 - m) - beta * m == pytest.approx(0, abs=1e-6)


@pytest.mark.parametrize(("cell", "e"), [(1, 0), (1, 1), (3, 0), (3, 1)])
def test_equation_15_maximises_equation_10(lane, cell, e):
    # the beams of the known map, scored by it and by a map whose m is moved in one cell: one more
    # count seen from inside the cell makes 1/5 to 1/6 or 1/3, and 3/4 to 3/5 or 4/5
    beams = lane.beams([3.5, 3.5, 3.5, 1.5, 4.5], [1, 1, 1, 1, 0])
    weights = np.array([1, 1, 1, 1, 0.5], np.float32)

    def score(grid):
        points, hit, offset, T = beams
        return lane.impl.log_likelihood(grid, points, hit, weights, offset, T, 0.9)[0, :2].sum()

    moved = lane.known_map()
    lane.add(moved, [0.25], [True], [e], start=cell + 0.5)
    assert (
        lane.alpha_beta(moved, range(5)).sum()
        == lane.alpha_beta(lane.known_map(), range(5)).sum() + 1
    )
    assert score(moved) < score(lane.known_map()) - 1e-3


def test_equation_15_occupancy(lane):
    sums = lane.alpha_beta(lane.known_map(), range(5))
    m = occupancy(sums[:, 0], sums[:, 1])
    assert m == pytest.approx([0, 1 / 5, 0, 3 / 4, np.nan], nan_ok=True)
    # and as the kernel itself takes it: with p = 1/2, (8) gives m
    e = lane.impl.e_step(lane.known_map(), *lane.beams([0.5, 1.5, 2.5, 3.5], [1] * 4), 0.5)
    assert e == pytest.approx([0, 1 / 5, 0, 3 / 4], abs=1e-7)


def test_static_world_is_naive_counting(lane):
    # e = 1 everywhere: m = times ended in j / (times ended in + times passed j)
    grid = lane.grid()
    lane.add(grid, [1.5, 2.5, 2.5, 3.5, 3.5, 3.5], [1] * 6, [1] * 6)
    sums = lane.alpha_beta(grid, range(4))
    assert occupancy(sums[:, 0], sums[:, 1]) == pytest.approx([0, 1 / 6, 2 / 5, 1])
