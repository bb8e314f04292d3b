"""The observation term of (9) in stillmap's form: a field of smoothed end points."""

from math import exp, log, pi, sqrt

import numpy as np
import pytest
from reference.likelihood_field import retract

FLOOR, SIGMA = 0.01, 0.5


def cost_of(impl, grid, points, weights=None, sigma=SIGMA, radius=2, unknown=0.0):
    points = np.array(points, np.float32)
    weights = np.ones(len(points)) if weights is None else weights
    weights = np.array(weights, np.float32)
    return impl.registration_cost(grid, points, weights, np.eye(3), sigma, radius, FLOOR, unknown)


def grid_of(impl, points, e, start):
    points = np.array(points, np.float32)
    T = np.eye(3)[None].copy()
    T[0, :2, 2] = start
    grid = impl.OccupancyGrid2D(1.0)
    hit, offset = np.ones(len(points), bool), np.array([0, len(points)])
    impl.add_beams(grid, points - np.float32(start), hit, np.array(e, np.float32), offset, T)
    return grid


def test_one_cell(impl):
    # two end points in cell (0, 0), seen from inside it: e = 1 at (1/4, 1/2), e = 1/2 at
    # (3/4, 1/2): m = 1.5 / 2, mu = (1/4 + 3/8) / 1.5 = 5/12. At (11/12, 1/2), one sigma away:
    # F = 3/4 exp(-1/2) / (sqrt(2 pi) / 2)
    grid = grid_of(impl, [[0.25, 0.5], [0.75, 0.5]], [1, 0.5], 0.5)
    F = 0.75 * exp(-0.5) / (sqrt(2 * pi) / 2)
    assert cost_of(impl, grid, [[11 / 12, 0.5]]) == pytest.approx(-log(FLOOR + F), rel=1e-5)


def test_merged_grids_average_their_end_points(impl):
    # the two end points of test_one_cell, each in a grid of its own
    grid = grid_of(impl, [[0.25, 0.5]], [1], 0.5)
    grid.merge(grid_of(impl, [[0.75, 0.5]], [0.5], 0.5))
    F = 0.75 * exp(-0.5) / (sqrt(2 * pi) / 2)
    assert cost_of(impl, grid, [[11 / 12, 0.5]]) == pytest.approx(-log(FLOOR + F), rel=1e-5)


def test_radius_is_the_largest_difference_of_cells(impl):
    grid = grid_of(impl, [[0.5, 0.5]], [1], 0.5)
    near = -log(FLOOR + exp(-4) / sqrt(2 * pi))  # (2, 2) cells away, |y - mu|^2 = 8, sigma = 1
    assert cost_of(impl, grid, [[2.5, 2.5]], sigma=1.0) == pytest.approx(near, rel=1e-6)
    assert cost_of(impl, grid, [[2.5, 3.25]], sigma=1.0) == pytest.approx(-log(FLOOR))


def test_weights_and_unusable_points(impl):
    grid = grid_of(impl, [[0.5, 0.5]], [1], 0.5)
    one = cost_of(impl, grid, [[0.5, 0.5]])
    points = [[0.5, 0.5], [0.5, 0.5], [np.nan, 0.5], [9.0, 9.0]]
    total = cost_of(impl, grid, points, [0.25, 0.5, 1, 0.5])
    assert total == pytest.approx(0.75 * one - 0.5 * log(FLOOR), rel=1e-6)


def test_unknown_is_not_free(impl):
    # cell (0, 0) was looked at, the others not: there the floor is raised by 1/4
    grid = grid_of(impl, [[0.5, 0.5]], [0], 0.5)  # m = 0: F = 0
    assert cost_of(impl, grid, [[0.1, 0.9]], unknown=0.25) == pytest.approx(-log(FLOOR))
    assert cost_of(impl, grid, [[1.1, 0.9]], unknown=0.25) == pytest.approx(-log(FLOOR + 0.25))


def test_straight_wall_gives_about_one(impl):
    # every cell along y = 1/2 occupied: the Gaussians along the wall add up to sqrt(2 pi) sigma
    points = [[x + 0.5, 0.5] for x in range(-10, 10)]
    grid = impl.OccupancyGrid2D(1.0)
    for point in points:
        T = np.array([[[1, 0, point[0]], [0, 1, 0.5], [0, 0, 1]]])
        one = np.ones(1, np.float32)
        impl.add_beams(
            grid, np.zeros((1, 2), np.float32), np.array([True]), one, np.array([0, 1]), T
        )
    cost = cost_of(impl, grid, [[0.3, 0.5]], sigma=1.0, radius=6)
    assert cost == pytest.approx(-log(FLOOR + 1), abs=1e-6)


def test_gradient_by_hand(impl):
    # F = exp(-|y|^2 / (2 sigma^2)) / (sqrt(2 pi) sigma) around the origin of the end points, at
    # y = (.5, 0) from mu, seen by a sensor at (.5, -1) from mu with the arm (0, 1):
    # d cost / d y = F / (floor + F) * (y - mu) / sigma^2 = F / (floor + F) * (2, 0), and turning
    # the arm moves y by (-1, 0)
    grid = grid_of(impl, [[0.25, 0.5]], [1], 0.5)
    T = np.array([[1, 0, 0.75], [0, 1, -0.5], [0, 0, 1]])
    points, weights = np.array([[0, 1]], np.float32), np.ones(1, np.float32)
    gradient = impl.registration_gradient(grid, points, weights, T, SIGMA, 2, FLOOR, 0.0)
    F = exp(-0.5) / (sqrt(2 * pi) * SIGMA)
    assert gradient == pytest.approx(np.array([2, 0, -2]) * F / (FLOOR + F), abs=1e-6)


def test_small_motions_turn_about_the_sensor():
    # the sensor at (3, 4) goes to (4, 6); its arm (1, 0) to (0, 1)
    T = np.array([[1.0, 0, 3], [0, 1, 4], [0, 0, 1]])
    assert (retract(T, np.array([1, 2, pi / 2])) @ [1, 0, 1])[:2] == pytest.approx((4, 7))
