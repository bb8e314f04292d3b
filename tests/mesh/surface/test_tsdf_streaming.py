"""Surfaces that grow as the sensor goes on: the same as of all at once, in less memory."""

import numpy as np
import pytest

from stillmap import _core
from stillmap.mesh import tsdf
from stillmap.mesh.range_image import Patch, find_scan_layout
from stillmap.mesh.resolution import PatchExtents, patch_extents
from stillmap.mesh.tsdf import StreamingSurface, TsdfParameters, integrate_patches

RAW = TsdfParameters(error=0.0, min_component_area=0.0)
VOXEL, SIZE = 0.1, 1.6  # m, with tiles of 16 voxels


@pytest.fixture(autouse=True)
def small(monkeypatch):
    monkeypatch.setattr("stillmap.mesh.tsdf.TILE", 16)
    monkeypatch.setattr(tsdf, "_EXTRACT_BYTES", 0.0)


def along_a_wall(n=12, noise=0.01):
    """Patches of a wall, each seen two metres farther on, and how far they go."""
    rng = np.random.default_rng(0)
    patches = []
    number = np.arange(60 * 30, dtype=np.int32).reshape(30, 60)
    a, b, c = number[:-1, :-1].ravel(), number[:-1, 1:].ravel(), number[1:, :-1].ravel()
    d = number[1:, 1:].ravel()
    faces = np.concatenate([np.stack([a, b, c], 1), np.stack([b, d, c], 1)])
    for k in range(n):
        x, z = np.meshgrid(2.0 * k + np.linspace(-2.5, 2.5, 60), np.linspace(0.0, 2.0, 30))
        y = 3.0 + rng.normal(0.0, noise, x.shape)
        points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        origin = np.tile([2.0 * k, 0.0, 1.0], (len(points), 1))
        patch = Patch(points, faces, np.arange(len(points)), origin, points[:, 1] * 1.0)
        patches.append((patch, np.ones(len(faces), np.float32)))
    return patches, PatchExtents(np.array([[2.0 * k, 0.0, 1.0] for k in range(n)]), np.full(n, 4.2))


def as_set(mesh):
    corners = np.round(mesh.corners, 4)
    return {tuple(sorted(map(tuple, face.tolist()))) for face in corners}


def test_the_surface_is_that_of_all_at_once():
    patches, extents = along_a_wall()
    whole, grown = (
        integrate_patches(patches, VOXEL, RAW),
        integrate_patches(patches, VOXEL, RAW, extents=extents),
    )
    assert len(whole) == len(grown) > 5_000
    assert as_set(whole) == as_set(grown)


def test_voxels_behind_are_gone():
    patches, extents = along_a_wall(24)
    held = {"all": [], "near": []}
    for name, most in held.items():
        one = StreamingSurface(
            _core.TsdfVolume(VOXEL, truncation_front=0.3, truncation_back=0.2), RAW
        )
        for done, (patch, weight) in enumerate(patches, start=1):
            one.volume.integrate(
                patch.points, patch.origin, patch.standoff, patch.faces, weight, threads=1
            )
            if name == "near":
                one.extract_complete(extents, done)
            most.append(one.volume.memory_bytes)
    assert max(held["near"]) < 0.45 * max(held["all"])
    # once under way it holds as much as before
    assert max(held["near"][16:]) <= 1.1 * max(held["near"][8:16])


def test_thinned_out_it_has_no_crack(monkeypatch):
    monkeypatch.setattr(tsdf, "_MERGE_FACES", 500)
    patches, extents = along_a_wall()
    mesh = integrate_patches(
        patches, VOXEL, TsdfParameters(error=0.02, min_component_area=0.0), extents=extents
    )
    assert 20 < len(mesh) < 0.3 * len(integrate_patches(patches, VOXEL, RAW))
    edges = np.sort(mesh.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    found, count = np.unique(edges, axis=0, return_counts=True)
    ends = mesh.vertices[found[count == 1]].mean(axis=1)
    inside = (ends[:, 0] > -1.5) & (ends[:, 0] < 22.5) & (np.abs(ends[:, 2] - 1.0) < 0.7)
    assert inside.sum() == 0
    assert np.abs(mesh.vertices[:, 1] - 3.0).max() < 0.06


def test_the_budget_is_kept_on_the_way(monkeypatch):
    monkeypatch.setattr(tsdf, "_MERGE_FACES", 500)
    most = []
    merge = StreamingSurface._merge

    def watched(self):
        merge(self)
        most.append(len(self._mesh))

    monkeypatch.setattr(StreamingSurface, "_merge", watched)
    patches, extents = along_a_wall(40, noise=0.02)
    mesh = integrate_patches(patches, VOXEL, TsdfParameters(max_faces=600), extents=extents)
    assert 100 < len(mesh) <= 600
    # but for borders, which may go on
    assert max(most) < 0.15 * len(integrate_patches(patches, VOXEL, RAW))
    assert np.abs(mesh.vertices[:, 1] - 3.0).mean() < 0.02


def test_reach_is_as_far_as_hits_are(room):
    poses = room.standing(1, [0, 0, 0], [0.6, 0.3, 0.0])
    recording = room.scans(room.lidar(90, 10), poses)
    order = find_scan_layout(recording, np.arange(2))
    extents = patch_extents(recording, poses, order)
    ends = [recording.end_points(np.arange(900) + 900 * t, poses) for t in range(2)]
    for t in range(2):
        away = np.linalg.norm(ends[t] - extents.position[t], axis=1)
        assert extents.range[t] == pytest.approx(away.max(), rel=1e-5)
    recording.hit[:900] = False
    assert patch_extents(recording, poses, order).range[0] == 0.0


def test_settled_are_tiles_that_later_patches_do_not_come_to():
    extents = PatchExtents(np.array([[0.0, 0, 0], [10.0, 0, 0]]), np.array([5.0, 2.0]))
    tiles = np.array([[0, 0, 0], [5, 0, 0], [9, 0, 0], [30, 0, 0]])
    assert extents.is_complete(tiles, 1.0, 0).tolist() == [False, False, False, True]
    assert extents.is_complete(tiles, 1.0, 1).tolist() == [True, False, False, True]
    assert extents.is_complete(tiles, 1.0, 2).all()
