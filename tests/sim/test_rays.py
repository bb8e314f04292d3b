"""Ranges in 3D against formulas: ground, faces, boxes, cylinders, ellipsoids; nothing left out."""

import numpy as np
import pytest

from stillmap.sim import ray_casting
from stillmap.sim.geometry import (
    BOX,
    CYLINDER,
    ELLIPSOID,
    Faces,
    Ground,
    Solids,
    StaticSurfaces,
    make_pose,
)
from stillmap.sim.lidar import Pattern, transform_rays
from stillmap.sim.options import LidarOptions

NO_FACES = Faces(np.empty((0, 4)), np.empty((0, 2)), np.empty(0, bool))
NO_PAVEMENT = np.empty((0, 4))
FLAT = Ground(np.zeros(2), NO_PAVEMENT, 0.0)


def lidar(x=0.0, y=0.0, z=1.8, roll=0.0, pitch=0.0):
    pattern = Pattern.of(LidarOptions(channels=40, columns=360, low=-0.6, high=0.3))
    T = make_pose(np.array([[x, y, z]]), *np.array([[roll], [pitch], [0.4]]))
    return pattern, transform_rays(pattern, T)


def solid(form, pose, half, z):
    mover = np.array([7], np.int32)
    form_of = np.array([form], np.int8)
    return Solids(np.reshape(pose, (1, 1, 4)), form_of, np.array([half]), np.array([z]), mover)


NO_SOLIDS = solid(BOX, [0, 0, 0, 0], (1, 1), (0, 1)).select(np.zeros(1, bool))


def cast(beams, faces=NO_FACES, moving=NO_SOLIDS, ground=FLAT, ceiling=None):
    return ray_casting.cast_rays(beams, StaticSurfaces(faces, NO_SOLIDS, ground, ceiling), moving)


def ends(beams, seen, which):
    range = np.where(which, seen.range, 0.0)
    return np.asarray((beams.origin + range * beams.direction)[:, which])


def test_flat_ground_lies_as_far_as_the_elevation_says():
    pattern, beams = lidar()
    seen = cast(beams)
    down = pattern.elevation < 0
    expected = 1.8 / np.sin(-pattern.elevation[down])
    np.testing.assert_allclose(seen.range[:, down], np.tile(expected, (360, 1)))
    assert np.isinf(seen.range[:, ~down]).all()


def test_sloping_ground_and_its_ceiling():
    ground = Ground(np.array([0.03, -0.02]), NO_PAVEMENT, 0.0)
    _, beams = lidar(3.0, -2.0, z=float(ground.level(np.array(3.0), np.array(-2.0))) + 1.8)
    seen = cast(beams, ground=ground, ceiling=4.0)
    x, y, z = ends(beams, seen, np.isfinite(seen.range))
    above = z - (0.03 * x - 0.02 * y)
    near = np.minimum(np.abs(above), np.abs(above - 4.0))
    assert near.max() < 1e-9 * 1e3
    assert (np.abs(above) < 1e-6).sum() > 5000 < (np.abs(above - 4.0) < 1e-6).sum() + 4000


def test_an_upright_face_has_a_lower_and_an_upper_edge():
    face = Faces(np.array([[5.0, -9.0, 5.0, 9.0]]), np.array([[1.0, 2.5]]), np.array([True]))
    _, beams = lidar()
    seen = cast(beams, face)
    x, y, z = ends(beams, seen, seen.on_glass)
    np.testing.assert_allclose(x, 5.0)
    assert 1.0 <= z.min() < 1.1
    assert 2.4 < z.max() <= 2.5
    assert np.abs(y).max() <= 9.0
    hidden = cast(beams, face, solid(BOX, [3, 0, 0, 0], (0.5, 20), (0, 9)))
    assert not hidden.on_glass[seen.on_glass].any()
    # below it one looks through to the ground behind
    x, _, z = ends(beams, seen, ~seen.on_glass & np.isfinite(seen.range))
    assert ((x > 5.5) & (np.abs(z) < 1e-9)).sum() > 30


@pytest.mark.parametrize("form", [BOX, CYLINDER, ELLIPSOID])
def test_level_beams_along_an_axis_meet_what_is_in_their_way(form):
    pattern = Pattern.of(LidarOptions(channels=1, columns=4, low=0.0, high=0.0))
    beams = transform_rays(pattern, make_pose(np.array([[0.0, 0.0, 1.0]]), *np.zeros((3, 1))))
    seen = cast(beams, moving=solid(form, [5, 0, 0, 0], (1, 2), (0, 2)))
    np.testing.assert_allclose(seen.range[:, 0], [np.inf, np.inf, 4.0, np.inf])
    above = solid(form, [5, 0, 0, 1.5], (1, 2), (0, 2))
    assert np.isinf(cast(beams, moving=above).range).all()


def test_pavements_are_a_kerb_higher():
    pavements = np.array([[-50.0, 3.0, 50.0, 9.0]])
    edge = Faces(np.array([[-50.0, 3.0, 50.0, 3.0]]), np.array([[-0.5, 0.1]]), np.zeros(1, bool))
    _, beams = lidar()
    seen = cast(beams, edge, ground=Ground(np.zeros(2), pavements, 0.1))
    x, y, z = ends(beams, seen, np.isfinite(seen.range))
    on = (y > 3 + 1e-6) & (y < 9) & (np.abs(x) < 50)
    np.testing.assert_allclose(z[on], 0.1)
    np.testing.assert_allclose(z[(y < 3 - 1e-6) | (y > 10)], 0.0, atol=1e-9)
    kerb = np.abs(y - 3) < 1e-6
    assert kerb.sum() > 20
    assert ((z[kerb] > -1e-9) & (z[kerb] < 0.1 + 1e-9)).all()


def clutter(rng, n, moving):
    a, b = rng.uniform(-20, 20, (n, 2)), rng.uniform(-6, 6, (n, 2))
    faces = Faces(np.hstack([a, a + b]), np.sort(rng.uniform(-1, 6, (n, 2))), rng.random(n) < 0.5)
    xy = rng.uniform(-20, 20, (n, 2))
    pose = np.column_stack([xy, rng.uniform(0, 6, n), rng.uniform(0, 1, n)])
    poses = pose[None] + np.linspace(0, 1, 360)[:, None, None] * [1.0, -2.0, 0.1, 0] * moving
    half, form = rng.uniform(0.1, 2, (n, 2)), rng.integers(0, 3, n).astype(np.int8)
    z = np.sort(rng.uniform(0, 3, (n, 2)))
    return faces, Solids(poses, form, half, z, np.arange(n, dtype=np.int32))


def everything(beams, count):
    """Everywhere and not far away, as if nothing were known of any surface."""
    window = (slice(0, 360), slice(0, len(beams.elevation)))
    return ((0.0, k, window) for k in range(count))


@pytest.mark.parametrize("roll", [0.0, 0.05, -0.2])
@pytest.mark.parametrize("moving", [False, True])
def test_nothing_is_missed(monkeypatch, roll, moving):
    """Looking only where things may be gives what looking everywhere gives."""
    rng = np.random.default_rng(5)
    faces, solids = clutter(rng, 60, moving)
    pattern = Pattern.of(LidarOptions(channels=24, columns=360, low=-0.7, high=0.4))
    t = np.linspace(0, 1, 360)
    xyz = np.stack([0.8 * t, -0.4 * t, 1.8 + 0.1 * t], axis=-1)
    T = make_pose(xyz, roll * np.ones(360), 0.5 * roll * t, 3.0 + 0.2 * t)
    beams = transform_rays(pattern, T)
    ground = Ground(np.array([0.02, 0.003]), NO_PAVEMENT, 0.0)
    fast = cast(beams, faces, solids, ground)
    monkeypatch.setattr(ray_casting, "_find_faces", lambda b, f, _: everything(b, len(f.ends)))
    monkeypatch.setattr(ray_casting, "_find_solids", lambda b, s: everything(b, len(s.form)))
    slow = cast(beams, faces, solids, ground)
    np.testing.assert_array_equal(fast.range, slow.range)
    np.testing.assert_array_equal(fast.mover, slow.mover)
    assert len(np.unique(fast.mover)) > 12
