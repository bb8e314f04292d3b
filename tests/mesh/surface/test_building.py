"""Surfaces of simple rooms: where they are, and where there are none."""

import numpy as np
import pytest
from scipy.spatial import cKDTree

from stillmap.mesh import resolution, triangulation, tsdf
from stillmap.mesh.options import MeshOptions
from stillmap.mesh.range_image import Patch, find_scan_layout, triangulate_scans
from stillmap.mesh.resolution import choose_resolution, patch_extents, select_scans
from stillmap.mesh.triangle_mesh import Mesh, remove_small_components
from stillmap.mesh.tsdf import (
    TsdfParameters,
    build_surface,
    integrate_patches,
    static_weights,
)

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


@pytest.mark.parametrize(("p", "has_surface"), [(0.9, False), (0.95, True)], ids=["prior", "sure"])
def test_what_only_the_prior_takes_for_static_is_no_surface(walked, p, has_surface):
    mesh = build_surface(walked[0], walked[1], p * static(walked[0]), OPTIONS)
    assert (len(mesh) > 0) == has_surface


def test_the_room_is_where_it_is(room, walked):
    mesh = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS)
    at, face = samples(mesh)
    off = room.off_walls(at)
    assert off.mean() < 0.006
    assert np.percentile(off, 99) < 0.05
    inward = mesh.normals()[face]
    middle = room.corners.mean(axis=0)
    assert np.mean(np.einsum("ni,ni->n", inward, middle - at) > 0) > 0.999
    # beams at 0.5 rad up and down see all of the walls but not all of the floor
    assert mesh.areas().sum() > 70.0


def test_a_nodding_laser_builds_the_room(room):
    poses = room.standing(120)
    poses[:, 0, 3] = 0.005 * np.arange(120)
    recording = room.scans(room.nodding(120, 121), poses, noise=0.01)
    mesh = build_surface(recording, poses, static(recording), OPTIONS)
    off = room.off_walls(samples(mesh)[0])
    assert off.mean() < 0.01
    assert mesh.areas().sum() > 35.0


def test_threads_do_not_change_a_bit(walked):
    one = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS)
    two = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS, threads=3)
    assert one.vertices.tobytes() == two.vertices.tobytes()
    assert one.faces.tobytes() == two.faces.tobytes()


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


def test_no_wall_behind_the_wall(room, walked):
    """Voxels behind a surface end without another one."""
    mesh = build_surface(walked[0], walked[1], static(walked[0]), OPTIONS)
    assert room.off_walls(mesh.vertices).max() < 0.15
    outside = np.maximum(room.corners[0] - mesh.vertices, mesh.vertices - room.corners[1])
    assert outside.max() < 0.05


def test_tiles_join_without_a_crack(walked, monkeypatch):
    with monkeypatch.context() as raw:
        raw.setattr(tsdf, "simplification_error", lambda _: 0.0)
        raw.setattr(tsdf, "remove_small_components", lambda mesh, _: mesh)
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


def test_progress_is_told(walked):
    heard = []
    build_surface(walked[0], walked[1], static(walked[0]), OPTIONS, 1, lambda *at: heard.append(at))
    done, total = np.array(heard).T
    assert (np.diff(done) >= 0).all()
    assert done[-1] == total[-1]
    assert len(heard) > 4


def test_nothing_seen_is_an_empty_mesh(walked):
    for recording, poses in (walked, (walked[0], walked[1])):
        mesh = build_surface(recording, poses, np.zeros(recording.n_beams, np.float32), OPTIONS)
        assert len(mesh) == 0
    p = np.full(walked[0].n_beams, np.nan, np.float32)
    assert len(build_surface(*walked, p, OPTIONS)) == 0


def test_an_object_is_built_in_its_own_frame(room):
    """Patches of a box that moves, carried into its frame, each with weights of its own."""
    T, parts = room.standing(3), []
    for k, x in enumerate((0.0, 0.5, 1.0)):
        box = np.array([[1.5, x - 1.0, -0.5], [2.2, x, 0.5]])
        recording = room.scans(room.picture(160, 120, 120.0), T[:1], box=box, noise=0.005, seed=k)
        order = find_scan_layout(recording, np.arange(1))
        (patch,) = (make() for make in triangulate_scans(recording, T[:1], order))
        moved = np.array([1.85, x - 0.5, 0.0])
        own = Patch(
            patch.points - moved, patch.faces, patch.beam, patch.origin - moved, patch.standoff
        )
        on_it = np.zeros(recording.n_beams, np.float32)
        on_it[patch.beam] = (np.abs(own.points) < [0.4, 0.6, 0.6]).all(axis=1)
        parts.append((own, static_weights(own, on_it)))
    mesh = integrate_patches(parts, 0.04, TsdfParameters())
    front = np.abs(mesh.vertices[:, 0] + 0.35) < 0.02
    assert front.mean() > 0.5
    assert mesh.areas().sum() == pytest.approx(1.0, abs=0.35)
    size = np.ptp(mesh.vertices, axis=0)
    assert (np.abs(size[1:] - 1.0) < 0.12).all()


def test_scans_from_known_viewpoints_are_left_out(monkeypatch):
    T = np.tile(np.eye(4), (30, 1, 1))
    T[20:, 0, 3] = np.arange(10)
    sensor = np.zeros(30, np.int32)
    monkeypatch.setattr(resolution, "_MIN_TRAVEL_SHARE", 0.1)
    monkeypatch.setattr(resolution, "_MIN_TURN", 0.2)
    assert select_scans(T, sensor, 5.0).tolist() == [0, 1, *range(21, 30)]
    T[5, :2, :2] = [[0, -1], [1, 0]]
    assert 5 in select_scans(T, sensor, 5.0)
    sensor[6:8] = 1
    assert set(select_scans(T, sensor, 5.0)) >= {6, 7}


def test_islands_are_dropped():
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    mesh = Mesh(
        np.concatenate([triangle, 5 + 0.1 * triangle]), np.arange(6, dtype=np.int32).reshape(2, 3)
    )
    assert len(remove_small_components(mesh, 0.01)) == 1
    assert len(remove_small_components(mesh, 0.001)) == 2


def resolved(recording, poses, order, voxel_size=None):
    extents = patch_extents(recording, poses, order)
    return choose_resolution(recording, poses, order, extents, voxel_size)


@pytest.mark.parametrize(
    ("made", "noise", "low", "high"),
    [((720, 80), 0.002, 0.02, 0.05), ((180, 20), 0.002, 0.07, 0.15), ((720, 80), 0.05, 0.06, 0.15)],
)
def test_voxels_are_as_fine_as_beams_tell(room, made, noise, low, high):
    recording = room.scans(room.lidar(*made), room.standing(2), noise=noise)
    order = find_scan_layout(recording, np.arange(2))
    voxel, _ = resolved(recording, room.standing(2), order)
    assert low < voxel < high


def test_voxels_fit_into_memory(room, monkeypatch):
    recording = room.scans(room.lidar(720, 80), room.standing(2))
    order = find_scan_layout(recording, np.arange(2))
    fine, _ = resolved(recording, room.standing(2), order)
    monkeypatch.setattr("stillmap.mesh.resolution._MAX_BYTES", 1e5)
    assert resolved(recording, room.standing(2), order)[0] > 2 * fine


def test_pictures_finer_than_voxels_are_thinned(room):
    recording = room.scans(room.picture(320, 240, 240.0), room.standing())
    order = find_scan_layout(recording, np.arange(1))
    voxel, stride = resolved(recording, room.standing(), order, 0.1)
    assert voxel == 0.1
    assert 3 <= stride <= 4
    thin = order._replace(stride=stride)
    (patch,) = (make() for make in triangulate_scans(recording, room.standing(), thin))
    assert 0.8 < len(patch.points) / (320 * 240 / stride**2) < 1.05
    mesh = build_surface(recording, room.standing(), static(recording), OPTIONS)
    assert room.off_walls(samples(mesh)[0]).mean() < 0.005
