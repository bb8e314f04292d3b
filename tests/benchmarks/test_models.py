"""Scores of textured models, with models of known errors."""

import numpy as np
import pytest
import trimesh
from model_objects import Model, MoverHits, Track, match_mover, score_object_models
from model_surface import (
    GREY,
    NOTHING,
    TextureRecord,
    TrueImages,
    distance_to_mesh,
    look_up_texture_source,
    sample_surface,
    score_surface,
)

from stillmap.core.camera import Camera
from stillmap.sim.camera import SKY
from stillmap.sim.geometry import BOX, Faces, Ground, MovingSurfaces, Solids, StaticSurfaces

PAIRS = np.empty((0, 2))
NO_SOLIDS = Solids(np.empty((1, 0, 4)), np.empty(0, np.int8), PAIRS, PAIRS, np.empty(0, np.int32))
NO_FACES = Faces(np.empty((0, 4)), PAIRS, np.empty(0, bool))
FLOOR = StaticSurfaces(NO_FACES, NO_SOLIDS, Ground(np.zeros(2), np.empty((0, 4)), 0.0), None)
# 3 m above the floor, looking straight down; 4 x 3 m fill the picture
K = np.array([[30.0, 0, 19.5], [0, 30.0, 14.5], [0, 0, 1]])
DOWN = np.array([[1.0, 0, 0, 0], [0, -1, 0, 0], [0, 0, -1, 3], [0, 0, 0, 1]])
CAMERA = Camera("down", 40, 30, K, "", np.empty(0), None)
# the map is turned and moved against the world
T_WORLD_MAP = np.array([[0.0, -1, 0, 2], [1, 0, 0, -1], [0, 0, 1, 0.5], [0, 0, 0, 1]])
T_MAP_WORLD = np.linalg.inv(T_WORLD_MAP)


def _floor(x, y, z=0.0, n=10):
    """A square of the floor in the map frame, upwards."""
    u, v = (m.ravel() for m in np.meshgrid(np.linspace(*x, n + 1), np.linspace(*y, n + 1)))
    world = np.stack([u, v, np.full(len(u), z)], axis=1)
    first = (np.arange(n)[:, None] * (n + 1) + np.arange(n)).reshape(-1, 1)
    faces = np.concatenate([first + np.array(half) for half in ((0, 1, n + 2), (0, n + 2, n + 1))])
    return world @ T_MAP_WORLD[:3, :3].T + T_MAP_WORLD[:3, 3], faces.astype(np.int32)


def _pictures(mask, off=0.0):
    v, u = np.mgrid[:30, :40]
    rays = np.stack([(u - 19.5) / 30, (v - 14.5) / 30, np.ones(u.shape)])
    distance = (3.0 * np.linalg.norm(rays, axis=0) + off).astype(np.float32)
    one = np.zeros(1, np.int32)
    return TrueImages([CAMERA], one, DOWN[None], lambda _: mask, lambda _: distance)


def _record(vertices, faces):
    image = np.zeros(len(faces), np.int32)
    return TextureRecord(vertices, faces, image, (np.linalg.inv(DOWN) @ T_WORLD_MAP)[None])


@pytest.mark.parametrize("up", [0.0, 0.03, -0.03, 0.07])
def test_a_shifted_surface_is_off_by_its_shift(up):
    vertices, faces = _floor((-2, 2), (-2, 2), up)
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-1.9, 1.9, (500, 2)), np.zeros(500)])
    found = score_surface(vertices, faces, FLOOR, places, T_WORLD_MAP)
    assert np.allclose([found.mean, found.p95], abs(up), atol=1e-9)
    assert found.complete == (1.0 if abs(up) <= 0.05 else 0.0)
    assert found.area == pytest.approx(16.0)
    assert found.places == 500


def test_a_surface_with_holes_is_less_complete():
    vertices, faces = _floor((-2, 0), (-2, 2))
    rng = np.random.default_rng(0)
    places = np.column_stack([rng.uniform(-2, 2, (20_000, 2)), np.zeros(20_000)])
    found = score_surface(vertices, faces, FLOOR, places, T_WORLD_MAP)
    assert found.mean < 1e-9
    assert found.complete == pytest.approx((2.0 + 0.05) / 4.0, abs=0.01)


def test_texture_shows_what_the_pictures_do():
    mask = np.zeros((30, 40), np.uint16)
    mask[:, :10], mask[:, 30:35] = 5, SKY  # a quarter and an eighth of what the picture shows
    record = _record(*_floor((-2, 2), (-1.5, 1.5)))
    record.image[: len(record.image) // 2 : 2] = -1
    of_mesh = sample_surface(record.vertices, record.faces, 40_000)
    shows = look_up_texture_source(record, of_mesh, _pictures(mask))
    assert np.mean(shows == GREY) == pytest.approx(0.25, abs=0.01)
    painted = shows[shows != GREY]
    assert np.mean(painted == 4) == pytest.approx(0.25, abs=0.01)
    assert np.mean(painted == NOTHING) == pytest.approx(0.125, abs=0.01)
    assert np.mean(painted == -1) == pytest.approx(0.625, abs=0.01)


# a box of 2 x 1 x 1 m that drives along x at 1 m/s
_POSE = np.zeros((3, 1, 4))
_POSE[:, 0, 0] = [0.0, 1.0, 2.0]
HALF, Z, ONE = np.array([[1.0, 0.5]]), np.array([[0.0, 1.0]]), np.zeros(1, np.int32)
DRIVES = MovingSurfaces(
    np.array([0, 10**9, 2 * 10**9]), Solids(_POSE, np.array([BOX], np.int8), HALF, Z, ONE)
)


def _box(grown):
    """Corners and sides of a box larger than that by so much on every side, about its foot."""
    cube = trimesh.creation.box((2 + 2 * grown, 1 + 2 * grown, 1 + 2 * grown))
    return cube.vertices + np.array([0, 0, 0.5]), cube.faces.astype(np.int32)


def _seen_box():
    """Beams all over its left side, at 0.5 s."""
    rng = np.random.default_rng(1)
    local = np.column_stack([rng.uniform(-1, 1, 500), np.full(500, 0.5), rng.uniform(0, 1, 500)])
    stamps = np.full(500, 5 * 10**8)
    noisy = local + np.array([0.5, 0.01, 0.0])
    return MoverHits(np.zeros(500, np.int32), stamps, noisy)


@pytest.mark.parametrize("grown", [0.0, 0.03, 0.08])
def test_a_model_that_is_too_large_is_off_by_that(grown):
    T = np.eye(4)
    T[0, 3] = 2.0  # where it is at 2 s
    model = Model(*_box(grown), T_MAP_WORLD @ T, 2 * 10**9, (0, 10**9), None)
    none = _pictures(np.zeros((30, 40), np.uint16))
    tracked, models = {7: 0, 8: -1}, {7: (0, model), 8: (-1, model)}
    found = score_object_models(tracked, models, ["car"], DRIVES, _seen_box(), none, T_WORLD_MAP)
    (one,) = found.models
    assert found.nothing == 1
    assert (one.id, one.mover, one.kind) == (7, 0, "car")
    assert one.accuracy == pytest.approx(grown, abs=0.004)  # edges are a little farther
    assert one.completeness == pytest.approx(grown, abs=1e-9)
    assert one.chamfer == pytest.approx((one.accuracy + one.completeness) / 2)
    assert (found.tracked, found.modelled) == (found.seen_well, found.modelled_well) == (1, 1.0)
    assert found.good == (1.0 if grown < 0.05 else 0.0)
    assert np.isnan(found.background)


def test_background_on_a_mover_is_told():
    mask = np.full((30, 40), 1, np.uint16)  # mover 0
    mask[:, :20] = 0
    corners = np.array([(-1.0, -0.5, 1.0), (1, -0.5, 1), (1, 0.5, 1), (-1, 0.5, 1)])
    roof = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    texture = TextureRecord(corners, roof, np.zeros(2, np.int32), np.linalg.inv(DOWN)[None])
    models = {1: (0, Model(corners, roof, T_MAP_WORLD, 0, (0, 0), texture))}
    seen = _seen_box(), _pictures(mask), T_WORLD_MAP
    found = score_object_models({1: 0}, models, ["car"], DRIVES, *seen)
    assert found.background == pytest.approx(0.5, abs=0.01)
    assert found.models[0].textured == 1.0


def test_a_model_is_of_whom_the_track_was_on_then():
    stamps = np.array([0, 10**9, 2 * 10**9, 3 * 10**9])
    movers = np.zeros((4, 2, 3))
    movers[:, 1, 0] = 5.0
    xy = np.array([(0.0, 0.0), (0, 0), (0, 0), (5, 0)])
    track = Track(0, stamps, xy)
    length = np.full(2, np.nan)
    assert match_mover(track, stamps, movers, length) == 0
    assert match_mover(track.within((3 * 10**9, 4 * 10**9)), stamps, movers, length) == 1
    assert track.within((12 * 10**8, 13 * 10**8)).stamp_ns.tolist() == [10**9]
    assert len(track.within((-(2**62), 2**62)).xy) == 4


def test_distances_to_corners_edges_and_inside():
    square = np.array([(0.0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)])
    halves = np.array([(0, 1, 2), (0, 2, 3)], np.int32)
    points = np.array([(1.0, 0.5, 0.3), (-0.3, 0.5, 0.4), (2.3, 1.4, 0.0), (0.5, 0.5, 0.0)])
    distances = distance_to_mesh(points, square, halves, 0.1)
    assert np.allclose(distances, [0.3, 0.5, 0.5, 0.0])
