"""The map that follows from an E-step: what is occupied, free, unknown."""

import numpy as np
import pytest
from made_up import RESOLUTION, Ball, Wall, at, fan, watch

from stillmap import _core, em
from stillmap.core import se2

FREE = 0.2


def odds_after(length):
    odds = FREE / (1 - FREE) * np.exp(-length)
    return odds / (1 + odds)


@pytest.mark.parametrize("p", [0.0, 0.3, 1.0])
def test_surfaces_are_added_to_passed_cells(p):
    """Four hits end in cell 3 of a lane of five cells; cell 4 and all beside it stay unknown."""
    grid = _core.OccupancyGrid2D(1.0)
    points, e = np.tile(np.array([[3, 0]], np.float32), (4, 1)), np.full(4, 0.5, np.float32)
    T = se2.matrix([0.5], 0.5, 0.0)
    _core.add_beams(grid, points, np.ones(4, bool), e, np.array([0, 4]), T)
    occupied = em.CellProbabilities(np.array([[3, 0]]), np.array([p], np.float32), FREE)
    m = em.make_occupancy_map(grid, occupied)
    row, column = -round(m.origin[1]), -round(m.origin[0])
    lane = m.p_occupied[row, column : column + 5]
    # the first cell was passed over half its length
    assert lane[:3] == pytest.approx([odds_after(2), odds_after(4), odds_after(4)], abs=1e-6)
    free = odds_after(2)  # four hits that are half believed not to be static
    assert lane[3] == pytest.approx(p + (1 - p) * free, abs=1e-6)
    known = np.zeros(m.p_occupied.shape, bool)
    known[row, column : column + 4] = True
    np.testing.assert_array_equal(np.isnan(m.p_occupied), ~known)


Y = np.arange(-2.0, 2.0, RESOLUTION) + RESOLUTION / 2  # of cells along a wall


def mapped(seen):
    """The E-step, and its map."""
    found = seen.e_step()
    return found, em.make_occupancy_map(seen.grid(found.p_static), found.occupied)


def a_room_with(wall):
    """A wall at this x, people walking by and one who stood for a while: what became of it."""
    walls = [Wall((1, 0), wall), Wall((0, 1), 3.04), Wall((0, -1), 3.04)]
    movers = [Ball(2.0, -1.4 + 0.4 * k, 20 + k, 21 + k) for k in range(8)]
    seen = watch([*walls, *movers, Ball(2.5, 1.5, 5, 20)], 60, noise=0.015)
    return seen, seen.what >= len(walls), mapped(seen)[1]


def column(m, x):
    return at(m, np.column_stack([Y * 0 + x, Y]))


@pytest.mark.parametrize(
    ("inside", "filled"),
    [*((x, [0]) for x in (0.35, 0.5, 0.65)), *((x, [-1, 0]) for x in (0.0, 0.05)), (0.95, [0, 1])],
)
def test_walls_are_crisp(inside, filled):
    """On the border of two cells a wall belongs to both; noise filled the cells beside it too."""
    *_, m = a_room_with(4.0 + inside * RESOLUTION)
    for k in filled:
        least = 0.8 if len(filled) == 1 else 0.6
        assert (column(m, 4.05 + k * RESOLUTION) > least).mean() > 0.95
    for k in (filled[0] - 1, filled[-1] + 1):
        assert not (column(m, 4.05 + k * RESOLUTION) > 0.35).any()  # NaN counts as neither


def around(m, x, y, cells=2):
    """p_occupied of the cells around that of a place, which is in the middle."""
    steps = np.arange(-cells, cells + 1) * RESOLUTION
    return at(m, np.column_stack([g.ravel() for g in np.meshgrid(x + steps, y + steps)]))


@pytest.mark.parametrize("y", [0.05, -1.25])
def test_range_noise_fills_no_cells(y):
    post = Ball(2.08, y, 0, 60, radius=0.03)
    seen = watch([Wall((1, 0), 4.05), post], 60, fan(721, 90), noise=0.025)
    found, m = mapped(seen)
    near = around(m, 2.05, y)
    hits = around(em.make_occupancy_map(seen.grid()), 2.05, y) > 0
    assert hits.sum() >= 3
    middle = np.arange(hits.size) == hits.size // 2
    assert near[middle] > 0.8
    assert not (near[~middle] > 0.5).any()
    # and beams that ended there hit it nevertheless
    assert seen.of(found.p_static, 1).min() > 0.9


@pytest.mark.parametrize("radius", [0.01, 0.03, 0.08])
@pytest.mark.parametrize(("x", "y"), [(2.05, 0.05), (2.0, 0.0), (3.03, 1.0), (1.5, -1.27)])
def test_thin_posts_stay(x, y, radius):
    # in the middle of a cell or on its border, before a wall that gets many more beams
    post = Ball(x + radius, y, 0, 60, radius)
    passing = [Ball(1.0, k, k, k + 1) for k in (-1, 1)]
    seen = watch([Wall((1, 0), x + 0.4), post, *passing], 60, fan(721, 90), noise=0.01)
    _, m = mapped(seen)
    there = np.unique(np.floor(seen.of(seen.recording.points, 1) / RESOLUTION), axis=0)
    assert (at(m, (there + 0.5) * RESOLUTION) > 0.8).any()
    ends = at(m, seen.of(seen.recording.points, 1))
    assert np.median(ends) > 0.8


def test_floor_under_movers_is_free():
    seen, moves, m = a_room_with(4.05)
    ends = seen.recording.points[moves]
    assert (at(m, ends) < 0.3).mean() > 0.97
    raw = em.make_occupancy_map(seen.grid())
    assert np.median(at(m, ends)) < np.median(at(raw, ends))
    floor = np.column_stack([np.full(20, 1.0), np.linspace(-1, 1, 20)])
    assert (at(m, floor) < 0.05).all()
    assert np.isnan(m.p_occupied[m.alpha + m.beta == 0]).all()
    assert np.isfinite(m.p_occupied[m.alpha + m.beta > 0]).all()


@pytest.mark.parametrize("printed", [False, True])
def test_windows_and_tiles_equal_the_whole(printed, monkeypatch):
    grid = watch([Wall([1.0, 0.0], 3.0)], 6.0, fan()).grid()
    occupied = None
    if not printed:
        cells = np.array([[29, 0], [30, 1], [5, 0]])  # the last one outside the part
        occupied = em.CellProbabilities(cells, np.array([0.5, 0.9, 0.4], np.float32), FREE)
    whole = em.make_occupancy_map(grid, occupied)
    first = np.round(np.array(whole.origin[:2]) / RESOLUTION).astype(int)
    monkeypatch.setattr("stillmap.core.tiles.TILE", 7)
    again = em.make_occupancy_map(grid, occupied)
    box = em.GridWindow(first + np.array([20, -2]), (12, 15))
    part = em.make_occupancy_map(grid, occupied, window=box)
    assert part.origin == pytest.approx((*(box.first_cell * RESOLUTION), 0.0))
    for name, nothing in (("p_occupied", np.nan), ("alpha", 0.0), ("beta", 0.0)):
        all_of_it = getattr(whole, name)
        np.testing.assert_array_equal(getattr(again, name), all_of_it)
        padded = np.pad(all_of_it, 40, constant_values=nothing)
        np.testing.assert_array_equal(getattr(part, name), padded[38:50, 60:75])


def rooms(*corners):
    """The grid of a robot in rooms of 4 m at corners (2,), and its positions."""
    grid = _core.OccupancyGrid2D(0.05)
    angle = np.linspace(0.0, 2.0 * np.pi, 200, endpoint=False)
    points = (2.0 * np.stack([np.cos(angle), np.sin(angle)], axis=1)).astype(np.float32)
    every = np.ones(len(points), bool), np.ones(len(points), np.float32)
    for x, y in corners:
        T = se2.matrix([float(x)], float(y), 0.0)
        _core.add_beams(grid, points, *every, np.array([0, len(points)]), T)
    return grid, np.array(corners, float)


def test_a_far_room_is_left_out():
    alone = em.make_occupancy_map(rooms((0, 0))[0])
    grid, places = rooms((0, 0), (0, 0), (3e4, -2e4))
    m = em.make_occupancy_map(grid, places=places)
    around = em.make_occupancy_map(grid, places=places[-1:])
    assert np.abs(np.array(around.origin[:2]) - [3e4, -2e4]).max() < 5.0
    assert np.abs(np.subtract(m.origin, alone.origin)).max() < 1.6  # a block
    assert (~np.isnan(m.p_occupied)).sum() == (~np.isnan(alone.p_occupied)).sum()
    beyond = em.find_hits_beyond(grid, m.window)
    assert np.abs(beyond - [3e4, -2e4]).max() < 5.0
    assert not len(em.find_hits_beyond(rooms((0, 0))[0], alone.window))


def test_rooms_of_one_building_stay_together():
    m = em.make_occupancy_map(rooms((0, 0), (300, 200))[0])
    height, width = m.p_occupied.shape
    assert (round(0.05 * width), round(0.05 * height)) == (304, 204)
