"""Last paragraph of Sect. 3: a beam counts in a cell by the length l_j on which it covers it."""

from math import log, sqrt

import numpy as np
import pytest


def walk(impl, start, end, resolution=1.0):
    cells, lengths = impl.traverse(np.array(start, float), np.array(end, float), resolution)
    assert cells.dtype == np.int64
    assert lengths.dtype == np.float64
    return cells.tolist(), lengths


@pytest.mark.parametrize("resolution", [1.0, 0.5, 4.0])
def test_three_four_five_triangle(impl, resolution):
    # (1/2, 1/4) to (5/2, 7/4) cells, length 5/2: x = 1 after 1/4 of it, y = 1 after 1/2, x = 2
    # after 3/4, so each of the four cells holds 5/8
    start, end = np.array([0.5, 0.25]) * resolution, np.array([2.5, 1.75]) * resolution
    cells, lengths = walk(impl, start, end, resolution)
    assert cells == [[0, 0], [1, 0], [1, 1], [2, 1]]
    assert lengths == pytest.approx([0.625] * 4)
    cells, lengths = walk(impl, end, start, resolution)  # and back
    assert cells == [[2, 1], [1, 1], [1, 0], [0, 0]]
    assert lengths == pytest.approx([0.625] * 4)


def test_negative_coordinates(impl):
    # (-1/2, -1/4) to (-5/2, -7/4), the mirror image
    cells, lengths = walk(impl, [-0.5, -0.25], [-2.5, -1.75])
    assert cells == [[-1, -1], [-2, -1], [-2, -2], [-3, -2]]
    assert lengths == pytest.approx([0.625] * 4)


def test_two_two_one_three_in_space(impl):
    # length 3 along (2, 1, 2): z = 1 after 1/8, x = 1 after 1/4, y = 1 after 1/2, z = 2 after 5/8,
    # x = 2 after 3/4
    cells, lengths = walk(impl, [0.5, 0.5, 0.75], [2.5, 1.5, 2.75])
    assert cells == [[0, 0, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [1, 1, 2], [2, 1, 2]]
    assert lengths == pytest.approx([0.375, 0.375, 0.75, 0.375, 0.375, 0.75])


@pytest.mark.parametrize("dimension", [2, 3])
@pytest.mark.parametrize("sign", [1, -1])
def test_axis_parallel_beam_has_length_one_per_cell(impl, dimension, sign):
    for axis in range(dimension):
        start = np.full(dimension, 0.5)
        end = start.copy()
        start[axis], end[axis] = sign * -2.0, sign * 2.5
        cells, lengths = walk(impl, start, end)
        expected = [-2, -1, 0, 1, 2] if sign > 0 else [2, 1, 0, -1, -2, -3]
        assert [cell[axis] for cell in cells] == expected
        # going down, the border at which the beam starts belongs to the cell above: length 0
        assert lengths[-5:] == pytest.approx([1, 1, 1, 1, 0.5])
        assert lengths[:-5] == pytest.approx([0] * (len(lengths) - 5))


def test_start_and_end_in_one_cell(impl):
    cells, lengths = walk(impl, [0.25, 0.5], [0.75, 0.5])
    assert cells == [[0, 0]]
    assert lengths == pytest.approx([0.5])


def test_zero_length(impl):
    cells, lengths = walk(impl, [1.5, -0.5, 0.0], [1.5, -0.5, 0.0])
    assert cells == [[1, -1, 0]]
    assert lengths.tolist() == [0]


def test_through_a_corner(impl):
    # two borders at once: in either order, and nothing of the beam lies in the cell between
    cells, lengths = walk(impl, [0.5, 0.5], [1.5, 1.5])
    assert cells[0] == [0, 0]
    assert cells[1] in ([0, 1], [1, 0])
    assert cells[2] == [1, 1]
    assert lengths == pytest.approx([sqrt(0.5), 0, sqrt(0.5)])


def test_slanted_beam_counts_by_length(impl):
    # the beam of the triangle: 5/8 of beta in each cell before the end cell, which gets e
    grid = impl.OccupancyGrid2D(1.0)
    points, hit = np.array([[2, 1.5]], np.float32), np.array([True])
    T = np.array([[[1, 0, 0.5], [0, 1, 0.25], [0, 0, 1]]])
    offset = np.array([0, 1])
    impl.add_beams(grid, points, hit, np.array([0.75], np.float32), offset, T)
    sums = grid.alpha_beta(np.array([[0, 0], [1, 0], [1, 1], [2, 1]]))
    assert sums == pytest.approx(np.array([[0, 0.625]] * 3 + [[0.75, 0.25]]), abs=1e-7)


def test_likelihood_weighs_cells_by_length(impl):
    # product of (1 - m_j)^{l_j}: m = 1/2 in cell (1, 1) (a hit against one whole passage), which
    # the beam of the triangle covers on 5/8, and nothing elsewhere
    grid = impl.OccupancyGrid2D(1.0)
    T = np.array([[[1, 0, 0], [0, 1, 1.5], [0, 0, 1]]], float)
    points = np.array([[1.5, 0], [2.5, 0]], np.float32)
    hit, offset = np.array([True, False]), np.array([0, 2])
    impl.add_beams(grid, points, hit, np.ones(2, np.float32), offset, T)
    points, hit = np.array([[2, 1.5]], np.float32), np.array([False])
    T = np.array([[[1, 0, 0.5], [0, 1, 0.25], [0, 0, 1]]])
    e, offset = np.array([0.5], np.float32), np.array([0, 1])
    t = impl.log_likelihood(grid, points, hit, e, offset, T, 0.5)
    assert t[0, 1] == pytest.approx(0.625 * log(0.5), rel=1e-6)


@pytest.mark.parametrize("direction", [(1, 0), (1, 1), (3, 1), (5, -2), (1, 0, 0), (1, -2, 3)])
def test_transversal_beams_do_not_accumulate_more(impl, direction):
    # the l_j add up to the beam's length, however many cells it covers
    d = np.array(direction, float)
    start = np.full(len(d), 0.3)
    end = start + 20 * d / np.linalg.norm(d)
    cells, lengths = impl.traverse(start, end, 0.5)
    assert len(cells) == 1 + np.abs(cells[-1] - cells[0]).sum()
    assert lengths.sum() == pytest.approx(40)
