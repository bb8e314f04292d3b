"""Removal of scans is exact; lengths on the approach do not change (10)."""

import numpy as np
import pytest

from stillmap import _core


def beams(D, rng, n=200):
    points = rng.uniform(-4, 4, (n, D)).astype(np.float32)
    points[::17] = np.nan
    hit = rng.random(n) < 0.8
    hit &= np.isfinite(points).all(axis=1)
    e = rng.random(n).astype(np.float32)
    T = np.eye(D + 1)[None].copy()
    T[0, :D, D] = rng.uniform(-1, 1, D)
    return points, hit, e, np.array([0, n]), T


@pytest.mark.parametrize("D", [2, 3])
@pytest.mark.parametrize("approach", [0.0, 0.5])
def test_removal_is_exact(D, approach):
    rng = np.random.default_rng(D)
    one, other = beams(D, rng), beams(D, rng)
    grids = [getattr(_core, f"OccupancyGrid{D}D")(0.1, approach) for _ in range(2)]
    _core.add_beams(grids[0], *one)
    _core.add_beams(grids[1], *other)
    _core.add_beams(grids[1], *one, threads=2)
    _core.add_beams(grids[1], *other, remove=True)
    for a, b in zip(grids[0].dense(), grids[1].dense(), strict=True):
        np.testing.assert_array_equal(a, b)
    if D == 2:
        points = one[0][one[1]]
        probes = points, np.ones(len(points), np.float32), one[4][0]
        options = {"sigma": 0.1, "radius": 2, "floor": 0.05, "unknown": 0.05}
        costs = [_core.registration_cost(grid, *probes, **options) for grid in grids]
        assert costs[0] == costs[1]


@pytest.mark.parametrize("D", [2, 3])
def test_the_approach_changes_only_registration(D):
    rng = np.random.default_rng(D)
    taken = beams(D, rng)
    Grid = getattr(_core, f"OccupancyGrid{D}D")
    plain, kind = Grid(0.1), Grid(0.1, 0.5)
    for grid in (plain, kind):
        _core.add_beams(grid, *taken)
    for a, b in zip(plain.dense(), kind.dense(), strict=True):
        np.testing.assert_array_equal(a, b)
    with pytest.raises(ValueError, match="approach"):
        plain.merge(kind)
    with pytest.raises(ValueError, match="approach"):
        Grid(0.1, -1.0)


def test_a_grazed_wall_keeps_its_weight():
    # along a wall, 0.3 m of it in the cells of the wall
    n = 40
    wall = np.column_stack([np.linspace(1.0, 3.0, n), np.full(n, 0.02)]).astype(np.float32)
    T = np.eye(3)[None].copy()
    T[0, 1, 2] = 0.2
    points = wall - T[0, :2, 2].astype(np.float32)
    ones, hit, offset = np.ones(n, np.float32), np.ones(n, bool), np.array([0, n])
    costs = []
    for approach in (0.0, 1.0):
        grid = _core.OccupancyGrid2D(0.05, approach)
        _core.add_beams(grid, points, hit, ones, offset, T)
        costs.append(_core.registration_cost(grid, points, ones, T[0], 0.05, 2, 0.05, 0.0))
    assert costs[1] < costs[0] - 1.0
