"""Z-buffer: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference
from surfel_maps import assert_same_bits

from stillmap import _core

K = np.array([[60.0, 0.7, 31.3], [0.0, 55.0, 22.8], [0.0, 0.0, 1.0]])


def soup(seed, n=400, size=0.35):
    """Faces around, behind and through the camera."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-4.0, 4.0, (n, 1, 3))
    corners = middle + rng.normal(0.0, size, (n, 3, 3))
    return corners.reshape(-1, 3), np.arange(3 * n, dtype=np.int32).reshape(-1, 3)


def sheet(n=12, seed=0):
    """A closed, crumpled sheet across the view."""
    rng = np.random.default_rng(seed)
    x, y = np.meshgrid(np.linspace(-4, 4, n), np.linspace(-4, 4, n))
    vertices = np.stack([x, y, 3.0 + rng.uniform(0, 0.5, x.shape)], axis=-1).reshape(-1, 3)
    i = (np.arange(n - 1)[:, None] * n + np.arange(n - 1)).ravel()
    faces = np.concatenate(
        [np.stack([i, i + 1, i + n], axis=1), np.stack([i + 1, i + n + 1, i + n], axis=1)]
    )
    return vertices, faces.astype(np.int32)


def pose(seed):
    rng = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = np.linalg.qr(rng.normal(size=(3, 3)))[0]
    T[:3, :3] *= np.sign(np.linalg.det(T[:3, :3]))
    T[:3, 3] = rng.normal(size=3)
    return T


@pytest.mark.parametrize("seed", range(6))
def test_agreement(seed):
    asked = *soup(seed), K, pose(seed), 64, 48
    depth, face = _core.render_z_buffer(*asked, near=0.1)
    depth_, face_ = reference.render_z_buffer(*asked, near=0.1)
    assert depth.dtype == np.float32
    assert face.dtype == np.int32
    assert len(np.unique(face_)) > 5
    np.testing.assert_array_equal(face, face_)
    np.testing.assert_allclose(depth, depth_, rtol=1e-6)
    assert (depth[face >= 0] >= 0.1).all()
    assert np.isinf(depth[face < 0]).all()


def test_faces_that_share_an_edge_leave_no_gap():
    for seed in range(20):
        vertices, faces = sheet(seed=seed)
        _, face = _core.render_z_buffer(vertices, faces, K, np.eye(4), 64, 48, near=0.1)
        assert (face >= 0).all()
    # edges along rows of pixel centres, and corners on them
    vertices, faces = sheet(17)
    vertices[:, 2] = 4.0
    straight = np.array([[64.0, 0, 32], [0, 64.0, 24], [0, 0, 1]])
    _, face = _core.render_z_buffer(vertices, faces, straight, np.eye(4), 64, 48, near=0.1)
    assert (face >= 0).all()


def test_a_face_through_the_near_plane_by_hand():
    # the floor 1 m below the camera, from 2 m behind it to 50 m ahead: v = fy / z + cy
    floor = np.array([[-90.0, 1, -2], [90, 1, -2], [90, 1, 50], [-90, 1, 50]])
    faces = np.array([[0, 2, 1], [0, 3, 2]], np.int32)
    at = np.array([[100.0, 0, 50], [0, 100, 20], [0, 0, 1]])
    depth, face = _core.render_z_buffer(floor, faces, at, np.eye(4), 101, 121, near=1.25)
    seen = np.arange(121) - 20
    expected = np.full(121, np.inf)
    expected[seen >= 2] = 100.0 / seen[seen >= 2]
    expected[expected < 1.25] = np.inf  # v = 100 is 1.25 m ahead
    np.testing.assert_allclose(depth, np.tile(expected[:, None], 101), rtol=1e-6)
    assert (depth[100] == 1.25).all()
    assert np.isinf(depth[101:]).all()
    assert set(np.unique(face)) == {-1, 0, 1}


def test_threads_change_nothing():
    vertices, faces = soup(9, 6000, 0.1)
    larger = np.diag([5.0, 5.0, 1.0]) @ K
    asked = vertices, faces, larger, np.eye(4), 301, 203
    assert len(np.unique(_core.render_z_buffer(*asked, near=0.1)[1])) > 100
    assert_same_bits(lambda n: _core.render_z_buffer(*asked, near=0.1, threads=n), 2, 3, 500)
