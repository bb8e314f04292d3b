"""End-point interpolation: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference

from stillmap import _core

OPTIONS = {"max_gap": 1.5, "tolerance": 0.1, "max_gap_ratio": 3.0}
LOOSE = {"max_gap": 0.6, "tolerance": 0.15, "max_gap_ratio": 1.6}  # for random points


def filled(kernels, beams, options=OPTIONS):
    """A grid of the interpolated end points only."""
    grid = beams.empty_grid(kernels)
    kernels.interpolate_end_points(grid, *beams.weighted, **options)
    return grid


def assert_agree(core, plain, n):
    """Same sums and registration costs; each of n end points is rounded once."""
    first, alpha, beta = core.dense()
    first_plain, alpha_plain, beta_plain = plain.dense()
    np.testing.assert_array_equal(first, first_plain)
    np.testing.assert_allclose(alpha, alpha_plain, rtol=0, atol=n * 2.0**-24)
    assert not beta.any()  # no crossings
    assert not beta_plain.any()
    cells = np.array(list(plain.alpha), np.int64)
    # off the cell centres, where the moments matter
    probes = ((cells + 0.2) * plain.resolution).astype(np.float32)
    weights, T = np.ones(len(probes), np.float32), np.eye(3)
    options = 0.6 * plain.resolution, 2, 0.02, 0.3
    costs = [
        kernels.registration_cost(grid, probes, weights, T, *options)
        for kernels, grid in ((_core, core), (reference, plain))
    ]
    assert costs[0] == pytest.approx(costs[1], rel=1e-5, abs=1e-4)


@pytest.fixture(params=[1, 2])
def wandering(request, some_beams):
    """Ragged scans whose end points follow a random walk, in part straight."""
    rng = np.random.default_rng(7)
    beams = some_beams(request.param, 2)
    points, v = np.zeros_like(beams.points), np.zeros(2)
    for n in range(1, len(points)):
        v = 0.85 * v - 0.05 * points[n - 1] + rng.normal(scale=0.15, size=len(v))
        points[n] = points[n - 1] + rng.lognormal(sigma=0.6) * v
    there = points + 0 * beams.points  # keeps NaN
    return beams.with_(points=there, resolution=0.05)


def test_random_scans(wandering):
    core, plain = filled(_core, wandering, LOOSE), filled(reference, wandering, LOOSE)
    assert len(plain.alpha) > 40
    assert_agree(core, plain, 2000)


@pytest.mark.parametrize("name", ["max_gap", "tolerance", "max_gap_ratio"])
def test_every_option_limits_the_interpolation(wandering, name):
    sizes = []
    for factor in (0.0, 0.5, 1.0, 2.0):
        options = {**LOOSE, name: factor * LOOSE[name]}
        core, plain = (filled(kernels, wandering, options) for kernels in (_core, reference))
        if plain.alpha:
            assert_agree(core, plain, 2000)
        assert core.dense()[1].any() == bool(plain.alpha)
        sizes.append(len(plain.alpha))
    assert sizes[0] == 0
    assert 0 < sizes[1] < sizes[2] < sizes[3]


def ranges_to(walls, angles):
    """Ranges of rays from the origin to the nearest of half planes (normal, distance)."""
    rays = np.column_stack([np.cos(angles), np.sin(angles)])
    with np.errstate(divide="ignore"):
        found = np.array([d / (rays @ np.asarray(n)) for n, d in walls])
    return rays, np.where(found > 0, found, np.inf).min(axis=0)


SLANTED = [((0.1, 1.0), 2.3)]  # from near to far away
SURFACES = {
    "wall": SLANTED,
    "corner": [((1.0, 0.0), 4.1), ((0.0, 1.0), 3.3)],
    "jump": [*SLANTED, ((0.1, 1.0), 1.61)],
    "missing": SLANTED,
}


def scene(kind):
    """End points (N, 2) of one scan, and which of them are hits."""
    angles = np.radians(np.arange(12.0, 168.0, 3.0))
    rays, ranges = ranges_to(SURFACES["corner" if kind == "corner" else "wall"], angles)
    if kind == "jump":  # a case before the wall
        ranges = np.where((angles > 1.2) & (angles < 1.9), 0.7 * ranges, ranges)
    hit = ranges < 7.0
    if kind == "missing":
        hit &= np.random.default_rng(0).random(len(hit)) < 0.7
    return rays * np.minimum(ranges, 7.0)[:, None], hit


@pytest.fixture
def laid(a_room):
    """Makes beams of flat scenes; several scans from different poses."""
    room = a_room(5, 2, 0.05, 3, 4).beams

    def lay(*kinds):
        scenes = [scene(kind) for kind in kinds]
        points = np.concatenate([points for points, _ in scenes]).astype(np.float32)
        return room.with_(
            points=points,
            hit=np.concatenate([hit for _, hit in scenes]),
            offset=np.cumsum([0, *(len(hit) for _, hit in scenes)]),
            T_map_sensor=room.T_map_sensor[: len(kinds)],
            e=np.random.default_rng(1).uniform(0.1, 1, len(points)).astype(np.float32),
        )

    return lay


@pytest.mark.parametrize("kind", list(SURFACES))
def test_scenes(laid, kind):
    beams = laid(kind)
    core, plain = filled(_core, beams), filled(reference, beams)
    assert len(plain.alpha) > 40
    assert_agree(core, plain, 2000)


@pytest.mark.parametrize("kind", list(SURFACES))
def test_removal_is_exact(laid, kind):
    beams = laid(kind, "wall")
    grid, never = beams.grid(_core), beams.grid(_core)
    before = [a.tobytes() for a in grid.dense()]
    _core.interpolate_end_points(grid, *beams.weighted, **OPTIONS)
    assert [a.tobytes() for a in grid.dense()] != before
    _core.interpolate_end_points(grid, *beams.weighted, **OPTIONS, remove=True)
    assert [a.tobytes() for a in grid.dense()] == before
    weights = np.ones(len(beams.points), np.float32)
    probes = beams.points, weights, beams.T_map_sensor[0], 0.04, 2, 0.05, 0.05
    # moments as well
    assert _core.registration_cost(grid, *probes) == _core.registration_cost(never, *probes)


# by hand: which gaps are filled, on cells of 0.1 m


ROW, BEND = ((0.06, 0), (0.44, 0), (0.71, 0)), ((0.06, 0), (0.44, 0), (0.71, 0.11))
UNEVEN = ((0.06, 0), (0.16, 0), (0.51, 0))
# from 0.06 on over 0.38 m in four steps: 0.155, 0.25, 0.345; then 0.27 m in three: 0.53, 0.62
ALL = dict.fromkeys([1, 2, 3, 5, 6], 1.0)


@pytest.mark.parametrize("kernels", [reference, _core])
@pytest.mark.parametrize(
    ("points", "changes", "cells"),
    [
        (ROW, {}, ALL),
        (ROW[::-1], {}, ALL),
        (ROW, {"e": [0.5, 0.75, 0.25]}, {1: 0.5, 2: 0.5, 3: 0.5, 5: 0.25, 6: 0.25}),
        (ROW, {"e": [0, 1, 1]}, {5: 1, 6: 1}),
        # two end points are not a surface
        (ROW[:2], {}, {}),
        ((), {}, {}),
        (ROW, {"hit": [1, 1, 0]}, {}),
        ((*ROW[:2], (np.nan, 0)), {}, {}),
        ((*ROW[:2], ROW[1]), {}, {}),
        # 0.1 m, then 0.35 m: more than three times as wide, and the other way round less
        (UNEVEN, {}, {}),
        (UNEVEN, {"max_gap_ratio": 3.6}, {2: 1, 3: 1, 4: 1}),
        (UNEVEN, {"max_gap_ratio": 3.6, "max_gap": 0.34}, {}),
        # the last one is 0.11 m off the line of the others, the first one 0.14 m
        ((*ROW[:2], (0.11, 0)), {}, {}),
        (BEND, {"tolerance": 0.1}, {}),
        (BEND, {"tolerance": 0.13}, {1: 1, 2: 1, 3: 1}),
        (BEND, {"tolerance": 0.16}, ALL),
    ],
)
def test_cells_by_hand(kernels, points, changes, cells):
    points = np.array(points, np.float32).reshape(-1, 2) + np.float32([0, 0.05])
    n = len(points)
    options = {"hit": np.ones(n), "e": np.ones(n), **OPTIONS, **changes}
    hit, e = np.array(options.pop("hit"), bool), np.array(options.pop("e"), np.float32)
    grid = kernels.OccupancyGrid2D(0.1)
    kernels.interpolate_end_points(
        grid, points, hit, e, np.array([0, n]), np.eye(3)[None], **options
    )
    first, alpha, _ = grid.dense()
    columns = alpha.sum(axis=0)
    found = {int(first[0] + x): columns[x] for x in np.flatnonzero(columns)}
    assert found == pytest.approx(cells)
