"""Share of beams through occupied cells, by hand."""

import numpy as np
import pytest

from stillmap import _core
from stillmap.core import se2

HERE = np.eye(3)
MARGIN = {"margin": 0.5, "min_occupancy": 0.4}


def wall(alpha=4, beta=0):
    """Cells of 1 m: a wall x in [5, 6), y in [-3, 3), each cell hit and crossed so many times."""
    y = np.arange(-3, 3) + 0.5
    ends = np.concatenate(
        [np.stack([np.full(6, x), y], axis=-1) for x in [5.5] * alpha + [40.5] * beta]
    ).astype(np.float32)
    # each beam begins half a cell before the wall
    grid, one = _core.OccupancyGrid2D(1.0), np.array([0, 1])
    hit, e = np.ones(1, bool), np.ones(1, np.float32)
    for x, y in ends:
        T = se2.matrix(4.75, y, 0.0)[None]
        _core.add_beams(grid, np.array([[x - 4.75, 0.0]], np.float32), hit, e, one, T)
    return grid


def share(grid, points, weights=None, T=HERE, T_sensor=HERE, **options):
    points = np.array(points, np.float32)
    weights = np.array(np.ones(len(points)) if weights is None else weights, np.float32)
    return _core.occluded_share(grid, points, weights, T, T_sensor, **{**MARGIN, **options})


AHEAD = [[9.0, 0.5], [3.0, 0.5], [-9.0, 0.5], [9.0, 9.0]]
BEHIND, ABOUT = se2.matrix(7.0, 0.0, 0.0), se2.matrix(8.0, 0.0, np.pi)


@pytest.mark.parametrize(
    ("points", "given", "expected"),
    [
        # ahead through the wall; before it; away from it; past its end
        (AHEAD, {}, 0.25),
        (AHEAD, {"weights": [1, 0.5, 0.5, 0]}, 0.5),
        (AHEAD, {"weights": [0, 1, 1, 1]}, 0.0),
        # crossed from x = 6.5 on: 0.5 m of margin before the end
        ([[5.4, 0.5]], {}, 0.0),
        ([[6.4, 0.5]], {}, 0.0),
        ([[6.6, 0.5]], {}, 1.0),
        ([[6.6, 0.5]], {"margin": 0.7}, 0.0),
        ([[6.4, 0.5]], {"margin": 0.3}, 1.0),
        ([[0.3, 0.5]], {}, 0.0),  # shorter than the margin
        # from behind the wall only backward beams cross it
        ([[9.0, 0.5], [2.0, 0.5]], {"T_sensor": BEHIND}, 0.5),
        # robot turned around behind the wall: ahead crosses it
        ([[5.0, 0.5], [-5.0, 0.5]], {"T": ABOUT}, 0.5),
    ],
)
def test_share_of_beams_through_a_wall(points, given, expected):
    assert share(wall(), points, **given) == expected


def test_min_occupancy():
    # one beam of four ended there: m = 1/4
    often_crossed = wall(alpha=1, beta=3)
    assert share(often_crossed, AHEAD, min_occupancy=0.3) == 0.0
    assert share(often_crossed, AHEAD, min_occupancy=0.2) == 0.25
    assert share(_core.OccupancyGrid2D(1.0), AHEAD, min_occupancy=0.0) == 0.0  # unobserved


def test_3d():
    grid = _core.OccupancyGrid3D(1.0)
    beam = np.array([[0.75, 0.0, 0.0]], np.float32)
    T, start = np.eye(4), np.eye(4)
    T[:3, 3], start[:3, 3] = [4.75, 0.5, 0.5], 0.5
    one = np.ones(1, np.float32)
    _core.add_beams(grid, beam, np.ones(1, bool), one, np.array([0, 1]), T[None])
    assert share(grid, [[9.0, 0.5, 0.5], [9.0, 0.5, 3.5]], T=np.eye(4), T_sensor=start) == 0.5
