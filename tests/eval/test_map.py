import json
import math

import numpy as np
import pytest

from stillmap.core import se2
from stillmap.results.eval.map import (
    distance_to_walls,
    extract_wall_cells,
    extract_wall_cells_from_hits,
    score_map,
)
from stillmap.results.reader import Grid

R = 0.1
WALLS = np.array([[0.05, 0.05, 3.95, 0.05], [0.05, 0.05, 0.05, 3.95]])  # along cell centres
HERE = np.eye(3)


def room(origin=(0.0, 0.0, 0.0)) -> Grid:
    """40 x 40 cells: all free but the south and west edges, which are wall."""
    p = np.full((40, 40), 0.1, np.float32)
    p[0], p[:, 0] = 0.9, 0.9
    return Grid(p, origin, R)


def with_cells(grid: Grid, cells, value: float) -> Grid:
    p = grid.p_occupied.copy()
    for row, column in cells:
        p[row, column] = value
    return Grid(p, grid.origin, grid.resolution)


def test_a_perfect_map():
    grid = room()
    reference = extract_wall_cells(grid, WALLS, HERE)
    s = score_map(grid, WALLS, reference, HERE)
    assert (s.ghost_cells, s.walls_kept, s.reference_wall_cells) == (0, 1.0, 79)
    assert s.free_area == pytest.approx(39 * 39 * R**2)
    assert s.T_world_map == (0.0, 0.0, 0.0)


def test_ghosts_are_occupied_cells_more_than_two_cells_from_a_wall():
    # rows are counted from the wall's centre line: row 2 lies two cells off, row 3 three
    grid = with_cells(room(), [(2, 10), (3, 20), (30, 30)], 0.66)
    s = score_map(grid, WALLS, np.zeros((0, 2)), HERE)
    assert s.ghost_cells == 2
    assert s.ghosts_per_100_m2 == pytest.approx(100 * 2 / (s.free_area))
    assert s.occupied_cells == 79 + 3


def test_thresholds_are_those_of_the_map_server():
    grid = with_cells(room(), [(20, 20), (20, 21)], 0.65)
    grid = with_cells(grid, [(25, 25)], 0.196)
    grid = with_cells(grid, [(30, 30)], math.nan)
    s = score_map(grid, WALLS, np.zeros((0, 2)), HERE)
    assert s.ghost_cells == 0
    assert s.free_area == pytest.approx((39 * 39 - 4) * R**2)


def test_a_wall_is_kept_where_a_neighbour_is_occupied():
    reference = extract_wall_cells(room(), WALLS, HERE)
    # a hole of three cells: its ends still have an occupied neighbour
    holed = with_cells(room(), [(0, 20), (0, 21), (0, 22)], 0.1)
    assert score_map(holed, WALLS, reference, HERE).walls_kept == pytest.approx(78 / 79)
    # one row further on is near enough, two are not
    for shift, kept in ((1, 1.0), (2, 0.0)):
        p = np.roll(room().p_occupied, (shift, shift), (0, 1))
        s = score_map(Grid(p, (0, 0, 0), R), WALLS[:1], reference[reference[:, 1] < R], HERE)
        assert s.walls_kept == pytest.approx(kept, abs=0.1)


def test_walls_beyond_the_map_are_lost():
    reference = extract_wall_cells(room(), WALLS, HERE)
    grid = room()
    cropped = Grid(grid.p_occupied[:, :20], grid.origin, R)
    assert score_map(cropped, WALLS, reference, HERE).walls_kept == pytest.approx(60 / 79)


def test_the_frame_of_the_map_does_not_matter():
    # the same cells, described in a map frame that is turned and shifted against the world
    T_world_map = se2.matrix(5.0, -3.0, 2.2)
    origin = tuple(se2.parameters(se2.inverse(T_world_map)))
    there = with_cells(room(origin), [(30, 30)], 0.9)
    here = with_cells(room(), [(30, 30)], 0.9)
    reference = extract_wall_cells(here, WALLS, HERE)
    np.testing.assert_allclose(extract_wall_cells(there, WALLS, T_world_map), reference, atol=1e-12)
    a = score_map(here, WALLS, reference, HERE)
    b = score_map(there, WALLS, reference, T_world_map)
    assert (b.ghost_cells, b.walls_kept) == (a.ghost_cells, a.walls_kept) == (1, 1.0)
    assert b.T_world_map == pytest.approx((5.0, -3.0, 2.2))


def test_reference_from_hits_needs_several_and_a_wall():
    T_world_map = se2.matrix(5.0, -3.0, 0.0)
    hits = np.array([[1.05, 0.05]] * 3 + [[2.05, 0.05]] * 2 + [[2.05, 2.05]] * 9)
    centres = extract_wall_cells_from_hits(hits, WALLS, room((-5.0, 3.0, 0.0)), T_world_map)
    np.testing.assert_allclose(centres, [[1.05, 0.05]], atol=1e-12)


def test_reference_on_another_lattice():
    rng = np.random.default_rng(0)
    along = rng.uniform(0.05, 3.95, 20_000)
    hits = np.concatenate([np.column_stack([along, np.full_like(along, 0.05)]),
                           np.column_stack([np.full_like(along, 0.05), along])])  # fmt: skip
    T_world_map = se2.matrix(0.4, 0.2, 0.7)
    lattice = Grid(np.zeros((90, 90), np.float32), (-2.03, -4.04, 0.0), R)
    reference = extract_wall_cells_from_hits(hits, WALLS, lattice, T_world_map)
    assert score_map(lattice, WALLS, reference, T_world_map).walls_kept == 0.0
    assert score_map(room(), WALLS, reference, HERE).walls_kept == 1.0


def test_distance_to_walls():
    walls = np.array([[0.0, 0, 4, 0], [1.0, 1, 1, 1]])  # the second has no length
    points = np.array([[2.0, -3.0], [-3.0, 4.0], [1.0, 1.5], [7.0, 0.0]])
    wanted = [3.0, 5.0, 0.5, 3.0]
    np.testing.assert_allclose(distance_to_walls(points, walls), wanted)
    np.testing.assert_allclose(distance_to_walls(points, walls, chunk=1), wanted)
    assert distance_to_walls(points[:0], walls).shape == (0,)


def test_a_map_of_nothing_leaves_shares_undefined():
    grid = Grid(np.full((3, 3), np.nan, np.float32), (0.0, 0.0, 0.0), R)
    plain = score_map(grid, WALLS, np.zeros((0, 2)), HERE).to_dict()
    assert plain["ghosts_per_100_m2"] is None
    assert plain["walls_kept"] is None
    json.dumps(plain, allow_nan=False)
