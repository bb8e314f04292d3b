"""The ray caster against one that tries every beam against everything, one at a time."""

import math

import numpy as np
import pytest

from stillmap.sim.laser import (
    Movers,
    Outlines,
    Returns,
    cast_beams,
    compute_beam_angles,
    simulate_measurement,
)
from stillmap.sim.options import LaserOptions


def nearest_wall(origin, direction, walls):
    best, which = math.inf, -1
    for w, (x0, y0, x1, y1) in enumerate(walls):
        # origin + r direction = start + s (end - start)
        A = np.array([[direction[0], x0 - x1], [direction[1], y0 - y1]])
        if abs(np.linalg.det(A)) < 1e-12:
            continue
        r, s = np.linalg.solve(A, np.array([x0, y0]) - origin)
        if r > 0 and -1e-12 <= s <= 1 + 1e-12 and r < best:
            best, which = r, w
    return best, which


def nearest_mover(origin, direction, movers, t):
    """By the quadratic form of each ellipse, (p - c)' Q (p - c) = 1."""
    best, which = math.inf, -1
    for q, axes in enumerate(movers.semi_axes):
        c, s = math.cos(movers.heading[t, q]), math.sin(movers.heading[t, q])
        R = np.array([[c, -s], [s, c]])
        Q = R @ np.diag(axes**-2.0) @ R.T
        o = origin - movers.xy[t, q]
        roots = np.roots([direction @ Q @ direction, 2 * o @ Q @ direction, o @ Q @ o - 1])
        real = roots[np.abs(roots.imag) < 1e-12].real
        if len(real) and 0 < real.min() < best:
            best, which = real.min(), int(movers.mover[q])
    return best, which


def by_brute_force(poses, angles, walls, movers):
    shape = (len(poses), len(angles))
    out = Returns(np.empty(shape), np.full(shape, -1, np.int32), np.full(shape, -1, np.int32))
    for t, (x, y, theta) in enumerate(poses):
        for n, angle in enumerate(theta + angles):
            ray = np.array([x, y]), np.array([math.cos(angle), math.sin(angle)])
            wall, mover = nearest_wall(*ray, walls), nearest_mover(*ray, movers, t)
            out.range[t, n] = min(wall[0], mover[0])
            if mover[0] < wall[0]:
                out.mover[t, n] = mover[1]
            else:
                out.wall[t, n] = wall[1]
    return out


def random_world(rng):
    scans, parts = 6, 9
    walls = rng.uniform(-6, 6, (12, 4))
    poses = np.column_stack([rng.uniform(-4, 4, (scans, 2)), rng.uniform(-9, 9, scans)])
    # nothing stands where the sensor is
    away = rng.uniform(0, 2 * np.pi, (scans, parts))
    distance = rng.uniform(0.5, 5, (scans, parts))
    offset = distance[..., None] * np.stack([np.cos(away), np.sin(away)], axis=-1)
    movers = Movers(
        poses[:, None, :2] + offset,
        rng.uniform(-4, 4, (scans, parts)),
        rng.uniform(0.05, 0.4, (parts, 2)),
        np.arange(parts, dtype=np.int32) // 2,
    )
    return walls, poses, movers


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("beams", "fov"), [(45, np.pi), (60, 2 * np.pi), (31, 1.2), (50, 4.7)])
def test_agrees_with_brute_force(seed, beams, fov):
    walls, poses, movers = random_world(np.random.default_rng(seed))
    angles = compute_beam_angles(beams, fov)
    fast, slow = (cast(poses, angles, walls, movers) for cast in (cast_beams, by_brute_force))
    np.testing.assert_allclose(fast.range, slow.range, rtol=1e-9, atol=1e-9)
    np.testing.assert_array_equal(fast.mover, slow.mover)
    np.testing.assert_array_equal(fast.wall, slow.wall)


@pytest.mark.parametrize("seed", range(3))
def test_moving_faces_agree_with_brute_force(seed):
    """A face that moves is a wall that stands elsewhere in each scan."""
    rng = np.random.default_rng(seed)
    walls, poses, movers = random_world(rng)
    faces, angles = rng.uniform(-6, 6, (len(poses), 7, 4)), compute_beam_angles(60, 2 * np.pi)
    outlines = Outlines(faces, np.arange(7, dtype=np.int32) // 2 + 20)
    fast = cast_beams(poses, angles, walls, movers, outlines)
    for t in range(len(poses)):
        where = movers.xy[t : t + 1], movers.heading[t : t + 1]
        now = Movers(*where, movers.semi_axes, movers.mover)
        both = np.concatenate([walls, faces[t]])
        slow = by_brute_force(poses[t : t + 1], angles, both, now)
        face = slow.wall[0] - len(walls)
        np.testing.assert_allclose(fast.range[t], slow.range[0], rtol=1e-9, atol=1e-9)
        np.testing.assert_array_equal(fast.wall[t], np.where(face < 0, slow.wall[0], -1))
        mover = np.where(face >= 0, outlines.mover[np.maximum(face, 0)], slow.mover[0])
        np.testing.assert_array_equal(fast.mover[t], mover)
    assert (fast.mover >= 20).mean() > 0.1


def test_no_ray_slips_through_the_corners_of_a_closed_polygon():
    rng = np.random.default_rng(2)
    turn = np.sort(rng.uniform(0, 2 * np.pi, 40))
    corners = 5 * np.stack([np.cos(turn), np.sin(turn)], axis=-1)
    walls = np.concatenate([corners, np.roll(corners, -1, axis=0)], axis=1)
    angles = compute_beam_angles(720, 2 * np.pi)
    # beams that aim at the corners exactly
    poses = np.column_stack([np.zeros((40, 2)), turn - angles[0]])
    poses = np.concatenate([poses, np.column_stack([rng.uniform(-1, 1, (200, 2)), np.arange(200)])])
    nobody = Movers(
        np.empty((240, 0, 2)), np.empty((240, 0)), np.empty((0, 2)), np.empty(0, np.int32)
    )
    assert np.isfinite(cast_beams(poses, angles, walls, nobody).range).all()


@pytest.mark.parametrize(
    ("beams", "fov", "first", "last"),
    [
        (180, 180, -90, 89),
        (181, 180, -90, 90),
        (361, 180, -90, 90),
        (361, 360, -180, 180 - 360 / 361),
    ],
)
def test_beams_point_where_sick_scanners_point_them(beams, fov, first, last):
    angles = np.degrees(compute_beam_angles(beams, math.radians(fov)))
    assert angles[0] == pytest.approx(first)
    assert angles[-1] == pytest.approx(last)
    np.testing.assert_allclose(np.diff(angles), angles[1] - angles[0])


@pytest.mark.parametrize(("is_glass", "share"), [(False, 0.01), (True, 0.31)])
def test_beams_have_their_noise_and_get_lost_at_their_rates(is_glass, share):
    options = LaserOptions(
        max_range=20.0, range_noise=0.03, no_return_share=0.01, glass_no_return_share=0.3
    )
    true = np.full((400, 500), 4.0)
    glass = np.full(true.shape, is_glass)
    ranges, hit = simulate_measurement(true, glass, options, np.random.default_rng(4))
    assert 1 - hit.mean() == pytest.approx(share, rel=0.1)
    np.testing.assert_array_equal(ranges[~hit], 20.0)
    off = (ranges - true)[hit]
    assert off.std() == pytest.approx(0.03, rel=0.01)
    assert off.mean() == pytest.approx(0.0, abs=5 * 0.03 / math.sqrt(off.size))
