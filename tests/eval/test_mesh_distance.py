"""Triangles as points, and distances to them, against slower ways."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.eval import mesh_distance

Float = NDArray[np.float64]

SQUARE = (
    np.array([(0.0, 0, 0), (2, 0, 0), (2, 1, 0), (0, 1, 0)]),
    np.array([(0, 1, 2), (0, 2, 3)], np.int32),
)


def _random(n: int) -> tuple[Float, NDArray[np.int32]]:
    rng = np.random.default_rng(5)
    middle = rng.uniform(-1, 1, (n, 1, 3))
    vertices = (middle + rng.normal(scale=0.1, size=(n, 3, 3))).reshape(-1, 3)
    return vertices, np.arange(3 * n, dtype=np.int32).reshape(n, 3)


def test_distances_are_those_of_dense_points() -> None:
    vertices, faces = _random(40)
    points = np.random.default_rng(6).uniform(-1, 1, (2000, 3))
    dense = mesh_distance.sample_lattice(vertices, faces, 0.004).points
    slow, _ = cKDTree(dense).query(points)
    found = mesh_distance.distance_to_mesh(points, vertices, faces, 0.05)
    assert np.all(found > slow - 0.004)
    assert np.all(found < slow + 0.05)
    near = slow < 0.05
    assert near.sum() > 20
    assert np.all(found[near] <= slow[near] + 1e-9)


def test_distances_to_corners_edges_and_inside() -> None:
    points = np.array([(1.0, 0.5, 0.3), (-0.3, 0.5, 0.4), (2.3, 1.4, 0.0), (0.5, 0.5, 0.0)])
    found = mesh_distance.distance_to_mesh(points, *SQUARE, 0.1)
    assert np.allclose(found, [0.3, 0.5, 0.5, 0.0])


def test_nothing_is_infinitely_far() -> None:
    none = np.empty((0, 3)), np.empty((0, 3), np.int32)
    assert np.isinf(mesh_distance.distance_to_mesh(np.zeros((2, 3)), *none, 0.05)).all()
    assert len(mesh_distance.sample_surface(*none, 10).points) == 0
    assert len(mesh_distance.distance_to_mesh(np.empty((0, 3)), *SQUARE, 0.05)) == 0


def test_samples_are_as_dense_everywhere() -> None:
    vertices, faces = SQUARE
    vertices = np.vstack([vertices, vertices + np.array([5.0, 0, 0])])
    faces = np.vstack([faces, [(4, 5, 6)]]).astype(np.int32)  # half as large as the square
    found = mesh_distance.sample_surface(vertices, faces, 3000)
    assert np.bincount(found.face).tolist() == [1000, 1000, 1000]
    assert np.allclose(
        found.points, np.einsum("nk,nkd->nd", found.weight, vertices[faces[found.face]])
    )
    of_square = found.points[found.face < 2]
    assert np.allclose(of_square.mean(axis=0), (1.0, 0.5, 0.0), atol=0.03)
    assert np.allclose(of_square.std(axis=0), (2 / 12**0.5, 1 / 12**0.5, 0.0), atol=0.02)
    assert np.array_equal(found.points, mesh_distance.sample_surface(vertices, faces, 3000).points)


def test_a_lattice_covers_each_triangle() -> None:
    found = mesh_distance.sample_lattice(*SQUARE, 0.1)
    assert np.all((found.weight > 0) & (found.weight < 1))
    assert np.allclose(found.weight.sum(axis=1), 1.0)
    grid = np.stack(np.meshgrid(np.linspace(0, 2, 41), np.linspace(0, 1, 21)), -1).reshape(-1, 2)
    gaps = np.linalg.norm(grid[:, None] - found.points[:, :2], axis=2).min(axis=1)
    assert gaps.max() < 0.1
    with pytest.raises(ValueError, match="too fine"):
        mesh_distance.sample_lattice(*SQUARE, 1e-5)


def test_normals_and_areas() -> None:
    assert mesh_distance.triangle_areas(*SQUARE).tolist() == [1.0, 1.0]
    assert mesh_distance.triangle_normals(*SQUARE).tolist() == [[0, 0, 1], [0, 0, 1]]


def test_one_point_in_each_cube_is_left() -> None:
    points = np.array([(0.01, 0.01, 0.01), (0.02, 0.02, 0.02), (0.07, 0.0, 0.0), (0.03, 0, 0)])
    assert mesh_distance.first_per_voxel(points, 0.05).tolist() == [0, 2]


def test_a_large_mesh_is_looked_at_in_parts():
    rng = np.random.default_rng(5)
    n = 30
    y, x = np.mgrid[:n, :n]
    vertices = np.stack([2.0 * x.ravel(), 2.0 * y.ravel(), rng.uniform(0, 0.3, n * n)], axis=1)
    k = (y[:-1, :-1] * n + x[:-1, :-1]).ravel()
    faces = np.concatenate(
        [np.stack([k, k + 1, k + n], axis=1), np.stack([k + 1, k + n + 1, k + n], axis=1)]
    ).astype(np.int32)
    points = rng.uniform([1, 1, -0.3], [57, 57, 0.6], (400, 3))
    whole = mesh_distance._distance_to_tile(points, vertices, faces, 0.3)
    np.testing.assert_allclose(mesh_distance.distance_to_mesh(points, vertices, faces, 0.3), whole)
    far = np.array([[500.0, 0.0, 0.0]])
    assert np.isinf(mesh_distance.distance_to_mesh(far, vertices, faces, 0.3)).all()
