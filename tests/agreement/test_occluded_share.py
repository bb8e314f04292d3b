"""Share of beams through occupied cells, by hand."""

import numpy as np

from stillmap import _core
from stillmap.core import se2

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


def share(grid, points, weights=None, T=None, T_sensor=None, **options):
    points = np.array(points, np.float32)
    weights = np.ones(len(points)) if weights is None else weights
    return _core.occluded_share(
        grid,
        points,
        np.array(weights, np.float32),
        np.eye(3) if T is None else T,
        np.eye(3) if T_sensor is None else T_sensor,
        **{**MARGIN, **options},
    )


AHEAD = [[9.0, 0.5], [3.0, 0.5], [-9.0, 0.5], [9.0, 9.0]]


def test_one_of_four_beams_is_occluded():
    # ahead through the wall; before it; away from it; past its end
    assert share(wall(), AHEAD) == 0.25
    assert share(wall(), AHEAD, [1, 0.5, 0.5, 0]) == 0.5
    assert share(wall(), AHEAD, [0, 1, 1, 1]) == 0.0


def test_beams_that_end_at_the_wall():
    # crossed from x = 6.5 on: 0.5 m of margin before the end
    assert share(wall(), [[5.4, 0.5]]) == 0.0
    assert share(wall(), [[6.4, 0.5]]) == 0.0
    assert share(wall(), [[6.6, 0.5]]) == 1.0
    assert share(wall(), [[6.6, 0.5]], margin=0.7) == 0.0
    assert share(wall(), [[6.4, 0.5]], margin=0.3) == 1.0
    assert share(wall(), [[0.3, 0.5]]) == 0.0  # shorter than the margin


def test_min_occupancy():
    # one beam of four ended there: m = 1/4
    often_crossed = wall(alpha=1, beta=3)
    assert share(often_crossed, AHEAD, min_occupancy=0.3) == 0.0
    assert share(often_crossed, AHEAD, min_occupancy=0.2) == 0.25
    assert share(_core.OccupancyGrid2D(1.0), AHEAD, min_occupancy=0.0) == 0.0  # unobserved


def test_beams_begin_at_the_sensor_and_move_with_the_pose():
    # from behind the wall only backward beams cross it
    behind = se2.matrix(7.0, 0.0, 0.0)
    assert share(wall(), [[9.0, 0.5], [2.0, 0.5]], T_sensor=behind) == 0.5
    # robot turned around behind the wall: ahead crosses it
    about = se2.matrix(8.0, 0.0, np.pi)
    assert share(wall(), [[5.0, 0.5], [-5.0, 0.5]], T=about) == 0.5


def test_3d():
    grid = _core.OccupancyGrid3D(1.0)
    beam = np.array([[0.75, 0.0, 0.0]], np.float32)
    T = np.eye(4)
    T[:3, 3] = [4.75, 0.5, 0.5]
    one = np.ones(1, np.float32)
    _core.add_beams(grid, beam, np.ones(1, bool), one, np.array([0, 1]), T[None])
    points = np.array([[9.0, 0.5, 0.5], [9.0, 0.5, 3.5]], np.float32)
    start = np.eye(4)
    start[:3, 3] = 0.5
    share = _core.occluded_share(grid, points, np.ones(2, np.float32), np.eye(4), start, **MARGIN)
    assert share == 0.5
