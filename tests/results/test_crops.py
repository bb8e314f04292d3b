import dataclasses

import numpy as np
import pytest

from stillmap.core.errors import InputError
from stillmap.pipeline import snapshots
from stillmap.pipeline.snapshots import choose_window, cut, extent, snapshot


@pytest.fixture
def grid(result):
    """60 x 100 cells of 0.5 m from (-10, 5): every cell holds its own number."""
    p = np.arange(6000, dtype=np.float32).reshape(60, 100)
    return dataclasses.replace(result.map, p_occupied=p, origin=(-10.0, 5.0, 0.0), resolution=0.5)


def cloud(rng, centre, n, spread=1.0):
    return rng.normal(centre, spread, (n, 2))


def test_window_lies_where_most_moves(grid):
    rng = np.random.default_rng(0)
    points = np.concatenate(
        [
            cloud(rng, (20, 20), 300),
            cloud(rng, (0, 10), 100),
            cloud(rng, (60, 20), 900),  # outside
            [[np.nan] * 2],
        ]
    )
    x0, y0, x1, y1 = choose_window(extent(grid), grid.resolution, points, 6.0)
    assert (x1 - x0, y1 - y0) == (6.0, 6.0)
    assert abs((x0 + x1) / 2 - 20) < 1.5
    assert abs((y0 + y1) / 2 - 20) < 1.5
    assert (x0 + 10) / 0.5 == round((x0 + 10) / 0.5)


def test_window_stays_on_the_map(grid):
    rng = np.random.default_rng(0)
    points = cloud(rng, (-9.5, 34.5), 200, 0.3)
    assert choose_window(extent(grid), grid.resolution, points, 8.0) == (-10.0, 27.0, -2.0, 35.0)
    # a map smaller than the window is shown whole
    assert choose_window(extent(grid), grid.resolution, points, 500.0) == (
        -10.0,
        5.0,
        40.0,
        35.0,
    )


@pytest.mark.parametrize("n", [0, 5])
def test_without_points_on_the_map_the_middle(grid, n):
    window = choose_window(extent(grid), grid.resolution, np.zeros((n, 2)), 10.0)
    assert window == (10.0, 15.0, 20.0, 25.0)


def test_cut(grid):
    cells, origin = cut(grid, (-9.0, 6.0, -7.0, 7.5))
    np.testing.assert_array_equal(cells, grid.p_occupied[2:5, 2:6])
    assert origin == (-9.0, 6.0, 0.0)


def test_cut_beyond_the_map_is_unknown(grid):
    cells, origin = cut(grid, (-11.0, 34.0, -9.0, 36.0))
    assert origin == (-11.0, 34.0, 0.0)
    expected = np.full((4, 4), np.nan)
    expected[:2, 2:] = grid.p_occupied[58:60, :2]
    np.testing.assert_array_equal(cells, expected)
    assert np.isnan(cut(grid, (100.0, 100.0, 102.0, 103.0))[0]).all()
    with pytest.raises(InputError, match="turned"):
        cut(dataclasses.replace(grid, origin=(0.0, 0.0, 0.1)), (0, 0, 1, 1))


def test_snapshot_keeps_its_part_of_map_and_points(grid, monkeypatch):
    points = np.array([[0.0, 10.0], [5.0, 5.0], [np.nan, 1.0], [3.0, 10.0], [0.0, 12.0]])
    one = snapshot(2, grid, points, (-1.0, 9.0, 3.0, 12.0))
    assert (one.number, one.resolution, one.p_occupied.shape) == (2, 0.5, (6, 8))
    assert one.p_occupied.base is None  # no view that would keep the whole map alive
    assert one.dynamic_points.dtype == np.float32
    np.testing.assert_array_equal(one.dynamic_points, [[0, 10]])
    monkeypatch.setattr(snapshots, "_MOST_POINTS", 7)
    many = np.stack([np.linspace(0, 1, 100, endpoint=False), np.full(100, 10.0)], 1)
    thinned = snapshot(1, grid, many, (0.0, 9.0, 1.0, 12.0)).dynamic_points[:, 0]
    np.testing.assert_allclose(thinned, [i * 100 // 7 / 100 for i in range(7)])


def test_points_far_apart_take_little_memory():
    near = np.random.default_rng(0).uniform(50_000.0, 50_004.0, (20, 2))
    points = np.concatenate([near, [[-90_000.0, 90_000.0]]])
    x0, y0, x1, y1 = choose_window((-1e5, -1e5, 1e5, 1e5), 0.05, points)
    assert x1 - x0 == pytest.approx(12.0)
    assert x0 < near[:, 0].min() < near[:, 0].max() < x1
    assert y0 < near[:, 1].min() < near[:, 1].max() < y1
