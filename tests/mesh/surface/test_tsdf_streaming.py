"""Surfaces that grow as the sensor goes on: the same as of all at once, in less memory."""

import numpy as np
import pytest

from stillmap import _core
from stillmap.mesh import tsdf
from stillmap.mesh.range_image import Patch
from stillmap.mesh.tsdf import (
    PatchExtents,
    StreamingSurface,
    TsdfParameters,
    integrate_patches,
)

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
