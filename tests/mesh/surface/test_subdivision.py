"""Triangles that are divided until no edge is long."""

import numpy as np

from stillmap.mesh.triangle_mesh import Mesh, subdivide


def _some(rng: np.random.Generator) -> Mesh:
    """A bumpy sheet."""
    n = 7
    y, x = np.mgrid[:n, :n]
    vertices = np.stack([x.ravel(), y.ravel(), rng.uniform(0, 0.5, n * n)], axis=1).astype(float)
    a = (y[:-1, :-1] * n + x[:-1, :-1]).ravel()
    faces = np.concatenate(
        [np.stack([a, a + 1, a + n + 1], axis=1), np.stack([a, a + n + 1, a + n], axis=1)]
    )
    return Mesh(vertices, faces.astype(np.int32))


def _has_no_gaps(fine: Mesh) -> bool:
    edges = np.sort(fine.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2), axis=1)
    once = np.unique(edges, axis=0, return_counts=True)
    border = once[0][once[1] == 1]
    assert set(once[1].tolist()) == {1, 2}
    # what belongs to one face alone lies on the border of the sheet
    middle = fine.vertices[border].mean(axis=1)
    return bool((np.isclose(middle[:, :2], 0.0) | np.isclose(middle[:, :2], 6.0)).any(axis=1).all())


def test_edges_become_short_the_surface_stays_and_there_are_no_gaps() -> None:
    mesh = _some(np.random.default_rng(5))
    fine, of = subdivide(mesh, lambda points: 0.2 + 0.2 * points[:, 0])
    a, b = fine.vertices[fine.faces], fine.vertices[np.roll(fine.faces, -1, axis=1)]
    limit = 0.2 + 0.2 * np.minimum(a[..., 0], b[..., 0])
    assert (np.linalg.norm(a - b, axis=2) <= limit + 1e-9).all()
    here = fine.centers[:, 0]
    assert (here < 1.0).sum() > 2 * ((here > 5.0) & (here < 6.0)).sum()
    np.testing.assert_allclose(np.bincount(of, fine.areas()), mesh.areas(), rtol=1e-9)
    np.testing.assert_allclose(fine.normals(), mesh.normals()[of], atol=1e-6)
    np.testing.assert_array_equal(fine.vertices[: len(mesh.vertices)], mesh.vertices)
    assert _has_no_gaps(fine)
