"""Rooms and simulated scans."""

from collections.abc import Callable

import numpy as np
import pytest

from stillmap import _core
from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.sim.laser import Movers, cast_beams, compute_beam_angles
from stillmap.sim.walls import box, pillar, polyline

ROOMS = {
    "hall with a case": (*box(0, 0, 9, 7), *box(1.5, 1.6, 0.9, 0.6), *box(-2.6, 1.9, 1.0, 0.4)),
    "L": polyline([(-3, -3), (5, -3), (5, 1), (1, 1), (1, 4), (-3, 4)], closed=True),
    "columns": (*box(1, 0, 14, 10), *pillar(-3, 2, 0.3), *pillar(2, 3, 0.3), *pillar(4, -3, 0.4)),
}


@pytest.fixture(params=list(ROOMS))
def room(request: pytest.FixtureRequest) -> Float:
    """Walls (W, 4) of a room without symmetry, free within a metre of its origin."""
    return np.array(ROOMS[request.param])


@pytest.fixture
def hall() -> Float:
    """Walls (W, 4) of one such room."""
    return np.array(ROOMS["hall with a case"])


@pytest.fixture
def scan() -> Callable[..., Float32]:
    """Takes one scan: (N, 2) end points in the sensor frame, all round."""

    def take(walls: Float, pose: Float, seed: int = 0, noise: float = 0.01) -> Float32:
        angles = compute_beam_angles(240, 2 * np.pi)
        nobody = Movers(
            np.zeros((1, 0, 2)), np.zeros((1, 0)), np.zeros((0, 2)), np.zeros(0, np.int32)
        )
        ranges = cast_beams(np.array([pose], float), angles, walls, nobody).range[0]
        ranges = ranges + noise * np.random.default_rng(seed).standard_normal(len(ranges))
        back = ranges < 30.0
        directions = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        return (ranges[back, None] * directions[back]).astype(np.float32)

    return take


@pytest.fixture
def mapped(scan: Callable[..., Float32]) -> Callable[..., _core.OccupancyGrid2D]:
    """A map of a room, from scans taken around its origin."""

    def build(walls: Float, seed: int = 100, resolution: float = 0.05) -> _core.OccupancyGrid2D:
        grid = _core.OccupancyGrid2D(resolution)
        stands = [(0, 0, 0), (0.6, 0.3, 0.4), (-0.5, 0.5, -1), (0.2, -0.7, 2), (0.9, -0.4, 3)]
        for k, stand in enumerate(stands):
            add(grid, scan(walls, stand, seed + k), stand)
        return grid

    return build


@pytest.fixture
def put() -> Callable[..., None]:
    """Adds one scan of hits at a pose to a map, gaps on surfaces filled."""
    return add


def add(grid: _core.OccupancyGrid2D, points: Float32, pose: Float, e: float = 1.0) -> None:
    n = len(points)
    weights = np.full(n, e, np.float32)
    beams = points, np.ones(n, bool), weights, np.array([0, n]), se2.matrix(*pose)[None]
    _core.add_beams(grid, *beams)
    _core.interpolate_end_points(grid, *beams, max_gap=1.5, tolerance=0.1, max_gap_ratio=3.0)
