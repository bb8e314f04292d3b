"""The ground map fitted to level surface."""

import numpy as np
import pytest

from stillmap.em.ground import fit_ground


def slope(x, y):
    return 0.05 * x - 0.02 * y


def floor_with_tables(rng, height=0.0):
    """Points of a sloping floor of 30 x 20 m and of tables 0.8 m above it."""
    xy = rng.uniform([-5, -10], [25, 10], (6000, 2))
    table = (np.abs(xy[:, 1] - 6) < 1) & (xy[:, 0] > 10)
    z = slope(*xy.T) + 0.8 * table + height + rng.normal(0, 0.01, len(xy))
    return np.column_stack([xy, z]), table


def way_over(height, sensor=1.5):
    x = np.linspace(0, 20, 40)
    return np.column_stack([x, np.zeros(40), slope(x, 0.0) + height + sensor])


@pytest.mark.parametrize("height", [0.0, -30.0])
def test_slopes_are_followed_and_tables_left_out(height):
    means, table = floor_with_tables(np.random.default_rng(0), height)
    ground = fit_ground(means, way_over(height))
    assert ground.observed
    assert ground.sensor_height == pytest.approx(1.5, abs=0.03)
    error = ground.height_at(means[~table, :2]) - (slope(*means[~table, :2].T) + height)
    assert np.abs(error).max() < 0.06  # over half of a square
    below = means[table, 2] - ground.height_at(means[table, :2])
    assert np.abs(below - 0.8).max() < 0.1


def test_without_level_surface_there_is_no_ground():
    ground = fit_ground(np.zeros((0, 3)), way_over(0.0))
    assert not ground.observed
    assert ground.sensor_height == 0.0
    assert np.isfinite(ground.height).all()


def test_height_outside_is_that_of_the_edge():
    ground = fit_ground(floor_with_tables(np.random.default_rng(2))[0], way_over(0.0))
    far = ground.height_at(np.array([[1e4, 0.0], [-1e4, 0.0]]))
    assert far[0] > 1.0 > -0.2 > far[1]


def test_one_far_position_leaves_the_ground_as_it_is():
    means, way = floor_with_tables(np.random.default_rng(3))[0], way_over(0.0)
    expected = fit_ground(means, way)
    far = np.insert(way, 20, [1e5, -1e5, 3.0], axis=0)
    ground = fit_ground(means, far)
    np.testing.assert_array_equal(ground.height, expected.height)
    np.testing.assert_array_equal(ground.corner, expected.corner)
    assert ground.sensor_height == expected.sensor_height
