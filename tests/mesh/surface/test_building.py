"""Surfaces of simple rooms: where they are, and where there are none."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from stillmap.mesh import triangle_mesh, triangulation
from stillmap.mesh.options import MeshOptions
from stillmap.mesh.tsdf import build_surface

OPTIONS = MeshOptions(voxel_size=0.1)


@pytest.fixture(autouse=True)
def coarse(monkeypatch):
    """The beams of these tests lie far apart."""
    monkeypatch.setattr(triangulation, "_MAX_EDGE_SHARE", 1.0)


def static(recording):
    return np.ones(recording.n_beams, np.float32)


def samples(mesh, n=20_000, seed=0):
    rng, area = np.random.default_rng(seed), mesh.areas()
    face = rng.choice(len(mesh), n, p=area / area.sum())
    u = rng.random((n, 2))
    u[u.sum(axis=1) > 1] = 1 - u[u.sum(axis=1) > 1]
    a, b, c = np.moveaxis(mesh.corners[face], 1, 0)
    return a + u[:, :1] * (b - a) + u[:, 1:] * (c - a), face


def borders(mesh):
    """(N, 2) edges that only one face has."""
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    found, count = np.unique(edges, axis=0, return_counts=True)
    return found[count == 1]


@pytest.fixture(scope="module")
def walked(room):
    """A lidar that goes through the room."""
    poses = room.standing(1, [0, 0, 0], [0.6, 0.3, 0], [1.2, 0.2, 0.1], [1.8, -0.4, 0.0])
    return room.scans(room.lidar(360, 40), poses, noise=0.01), poses


def test_the_room_is_where_it_is_with_any_number_of_threads(room, walked):
    mesh = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS)
    threaded = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS, threads=3)
    assert mesh.vertices.tobytes() == threaded.vertices.tobytes()
    assert mesh.faces.tobytes() == threaded.faces.tobytes()
    at, face = samples(mesh)
    off = room.off_walls(at)
    assert off.mean() < 0.006
    assert np.percentile(off, 99) < 0.05
    inward = mesh.normals()[face]
    middle = room.corners.mean(axis=0)
    assert np.mean(np.einsum("ni,ni->n", inward, middle - at) > 0) > 0.999
    # voxels behind a surface end without another one
    assert room.off_walls(mesh.vertices).max() < 0.15
    outside = np.maximum(room.corners[0] - mesh.vertices, mesh.vertices - room.corners[1])
    assert outside.max() < 0.05
    # beams at 0.5 rad up and down see all of the walls but not all of the floor
    assert mesh.areas().sum() > 70.0


def test_what_moves_is_no_surface(room):
    """A box stands before a wall for two of four scans, and P(static) knows."""
    box = np.array([[2.0, -0.4, -0.6], [2.6, 0.4, 0.7]])
    poses = room.standing(4)
    with_it = room.scans(room.lidar(360, 40), poses, box=box)
    without = room.scans(room.lidar(360, 40), poses)
    half = with_it.n_beams // 2
    with_it.points[half:] = without.points[half:]
    p = static(with_it)
    p[room.off_walls(with_it.points.astype(float)) > 0.05] = 0.2
    cleaned = build_surface(with_it, poses, p, OPTIONS)
    raw = build_surface(with_it, poses, static(with_it), OPTIONS)

    def on_box(mesh):
        at, _ = samples(mesh)
        return np.sum((at > box[0] - 0.1).all(axis=1) & (at < box[1] + 0.1).all(axis=1))

    assert on_box(cleaned) == 0
    assert on_box(raw) > 100


def test_tiles_join_without_a_crack(walked, monkeypatch):
    with monkeypatch.context() as raw:
        raw.setattr(triangle_mesh, "simplification_error", lambda _: 0.0)
        raw.setattr(triangle_mesh, "remove_small_components", lambda mesh, _: mesh)
        whole = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS)
        monkeypatch.setattr("stillmap.mesh.tsdf.TILE", 16)
        tiled = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS)
    assert len(whole) == len(tiled)
    assert len(borders(whole)) == len(borders(tiled))
    assert len(whole.vertices) == len(tiled.vertices)
    # vertices are single precision within a tile
    assert cKDTree(whole.vertices).query(tiled.vertices)[0].max() < 1e-5
    thinned = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS)
    # no border but that of the surface: far from it everything is closed
    ends = thinned.vertices[borders(thinned)].mean(axis=1)
    inside = (np.abs(ends[:, 0] - 1.0) < 1.0) & (np.abs(ends[:, 2]) < 0.5)
    assert inside.sum() == 0
    assert len(thinned) < 0.5 * len(tiled)


def test_the_budget_is_kept(walked, room):
    few = MeshOptions(voxel_size=0.1, max_faces=400)
    mesh = build_surface(walked[0], walked[1], static(walked[0]), few)
    assert 50 < len(mesh) <= 400
    assert room.off_walls(samples(mesh)[0]).mean() < 0.05
