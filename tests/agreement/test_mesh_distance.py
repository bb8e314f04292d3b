"""Closest faces: kernel against twin, and by hand."""

import numpy as np
import pytest
import reference
from reference.mesh_distance import closest_point

from stillmap import _core

TRIANGLE = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
UP = np.array([0.0, 0.0, 1.0])
ONE = np.array([[0, 1, 2]], np.int32)


def soup(seed, n, away=0.0):
    """Crossing triangles, large and small, slivers and some without area; points about them."""
    rng = np.random.default_rng(seed)
    middle = rng.uniform(-2.0, 2.0, (n, 1, 3))
    size = rng.choice([0.02, 0.2, 2.0], (n, 1, 1), p=[0.5, 0.45, 0.05])
    corners = middle + size * rng.normal(size=(n, 3, 3))
    corners[:20, 2] = corners[:20, 0] + 0.3 * (corners[:20, 1] - corners[:20, 0])
    corners[20:25] = corners[20:25, :1]
    corners[25:30] = corners[30:35]  # twice
    weight = rng.dirichlet(np.ones(3), 800)
    points = np.einsum("nk,nkd->nd", weight, corners[rng.integers(0, n, 800)])
    points += rng.choice([0.01, 0.1], (800, 1)) * rng.normal(size=(800, 3))
    origins = rng.uniform(-9.0, 9.0, (800, 3))
    faces = np.arange(3 * n, dtype=np.int32).reshape(-1, 3)
    return corners.reshape(-1, 3) + away, faces, points + away, origins + away


@pytest.mark.parametrize("away", [0.0, 3e5])
@pytest.mark.parametrize(("seed", "reach"), [(0, 0.02), (1, 0.1), (2, 0.1), (3, 1.0), (4, 30.0)])
def test_agreement(seed, reach, away):
    vertices, faces, points, origins = soup(seed, 300, away)
    found = _core.MeshDistance(vertices, faces, max_distance=reach).closest_faces(points, origins)
    expected = reference.MeshDistance(vertices, faces, max_distance=reach).closest_faces(
        points, origins
    )
    assert [a.dtype for a in found] == [a.dtype for a in expected]
    np.testing.assert_array_equal(found[0], expected[0])
    np.testing.assert_allclose(found[1], expected[1], atol=1e-9 if not away else 1e-3)
    assert (found[0] >= 0).mean() > 0.05
    assert len(np.unique(found[0])) > 20
    if reach < 0.05:
        assert (found[0] < 0).any()


def test_shared_edges():
    """Closest points on an edge belong to one of its faces."""
    rng = np.random.default_rng(5)
    n = 30
    u, v = (a.ravel() for a in np.mgrid[:n, :n])
    vertices = np.column_stack([0.07 * u, 0.07 * v, 0.03 * rng.normal(size=n * n)])
    at = (u * n + v).reshape(n, n)[:-1, :-1].ravel()
    faces = np.concatenate(
        [np.stack([at, at + n, at + n + 1], 1), np.stack([at, at + n + 1, at + 1], 1)]
    ).astype(np.int32)
    points = np.column_stack([rng.uniform(-0.1, 2.1, (600, 2)), 0.1 * rng.normal(size=600)])
    given = points, np.full((600, 3), 9.0)
    found = _core.MeshDistance(vertices, faces, max_distance=0.1).closest_faces(*given)
    expected = reference.MeshDistance(vertices, faces, max_distance=0.1).closest_faces(*given)
    np.testing.assert_array_equal(found[0] >= 0, expected[0] >= 0)
    has = found[0] >= 0
    assert 0.5 < has.mean() < 1.0

    def places(of):
        return np.einsum("nk,nkd->nd", of[1][has], vertices[faces[of[0][has]]])

    np.testing.assert_allclose(places(found), places(expected), atol=1e-9)


def test_closest_point_against_dense_samples():
    rng = np.random.default_rng(1)
    corners, points = rng.normal(size=(300, 3, 3)), 2.0 * rng.normal(size=(300, 3))
    corners[:20, 2] = corners[:20, 0] + 0.3 * (corners[:20, 1] - corners[:20, 0])  # slivers
    corners[20:25] = corners[20:25, :1]  # points
    weight, square = closest_point(points, corners)
    assert (weight >= 0.0).all()
    np.testing.assert_allclose(weight.sum(axis=1), 1.0, atol=1e-9)
    places = np.einsum("nk,nkd->nd", weight, corners)
    off = np.sqrt(square)
    np.testing.assert_allclose(off, np.linalg.norm(points - places, axis=1), atol=1e-9)
    i, j = (one.ravel() for one in np.mgrid[:81, :81])
    lattice = np.stack([i, j, 80 - i - j], axis=1)[i + j <= 80] / 80.0
    tried = np.einsum("mk,nkd->nmd", lattice, corners) - points[:, None]
    least = np.linalg.norm(tried, axis=2).min(axis=1)
    assert (off <= least + 1e-9).all()
    np.testing.assert_allclose(off, least, atol=0.05)


def test_by_hand():
    points = np.array(
        [[0.25, 0.5, 0.09], [0.25, 0.5, 0.11], [0.5, -0.05, 0], [-0.06, -0.06, 0], [1.2, 0, 0]]
    )
    near = _core.MeshDistance(TRIANGLE, ONE, max_distance=0.1)
    assert (len(near), near.max_distance) == (1, 0.1)
    face, weight = near.closest_faces(points, points + 9.0 * UP)
    assert face.tolist() == [0, -1, 0, 0, -1]
    expected = [[0.25, 0.25, 0.5], [0, 0, 0], [0.5, 0.5, 0], [1, 0, 0], [0, 0, 0]]
    np.testing.assert_allclose(weight, expected, atol=1e-12)
    assert (near.closest_faces(points, points - 9.0 * UP)[0] == -1).all()  # their backs
    assert (near.closest_faces(points, points + 9.0 * np.roll(UP, 1))[0] == -1).all()  # their edges


def test_ties_go_to_the_lowest_index():
    faces = np.array([[0, 1, 2]] * 3 + [[0, 2, 1]], np.int32)[[3, 0, 1, 2]]
    points = np.array([[0.2, 0.2, 0.01], [0.7, 0.1, 0.0], [0.2, -0.05, 0.0]])
    near = _core.MeshDistance(TRIANGLE, faces, max_distance=0.1)
    assert near.closest_faces(points, points + UP)[0].tolist() == [1, 1, 1]
    assert near.closest_faces(points, points - UP)[0].tolist() == [0, 0, 0]


def test_degenerate_faces_are_skipped():
    vertices = np.array([[0.0, 0, 0], [1, 0, 0], [2, 0, 0]])
    faces = np.array([[0, 1, 2], [1, 1, 1], [0, 1, 0]], np.int32)
    points = np.array([[0.5, 0, 0], [1.0, 0.01, 0]])
    for kernels in (_core, reference):
        near = kernels.MeshDistance(vertices, faces, max_distance=0.5)
        face, weight = near.closest_faces(points, points + 1.0)
        assert (face == -1).all()
        assert (weight == 0.0).all()


def test_an_empty_mesh_and_no_points():
    none, no_faces = np.zeros((0, 3)), np.zeros((0, 3), np.int32)
    points = np.ones((4, 3))
    for vertices in (none, TRIANGLE):
        face, weight = _core.MeshDistance(vertices, no_faces, max_distance=0.1).closest_faces(
            points, points
        )
        assert face.tolist() == [-1] * 4
        assert weight.shape == (4, 3)
    face, weight = _core.MeshDistance(TRIANGLE, ONE, max_distance=0.1).closest_faces(none, none)
    assert (face.shape, weight.shape) == ((0,), (0, 3))


@pytest.mark.usefixtures("bounded_memory")
def test_memory_with_large_faces():
    """Nor with a mesh that spans more cells than can be indexed."""
    rng = np.random.default_rng(6)
    for size, reach in ((1.0, 0.1), (1e3, 0.1), (1e8, 0.1), (1e8, 1e-6)):
        vertices = size * rng.uniform(-1.0, 1.0, (3000, 3))
        faces = np.arange(3000, dtype=np.int32).reshape(-1, 3)
        near = _core.MeshDistance(vertices, faces, max_distance=reach)
        assert near.memory_bytes < 20_000_000
        middle = vertices[faces].mean(axis=1)
        face, _ = near.closest_faces(middle, middle + size)
        back, _ = near.closest_faces(middle, middle - size)
        assert (np.maximum(face, back) >= 0).mean() > 0.9 or reach < 1e-3


def test_small_face_next_to_a_huge_one():
    vertices = np.concatenate([2000.0 * (TRIANGLE - 0.3), 0.05 * TRIANGLE + [0.0, 0, 600.02]])
    vertices[:3, 2] = 600.0
    faces = np.array([[0, 1, 2], [3, 4, 5]], np.int32)
    points = np.array([[0.01, 0.01, 600.015], [0.01, 0.01, 600.005], [200.0, 500, 600.05]])
    near = _core.MeshDistance(vertices, faces, max_distance=0.1)
    assert near.closest_faces(points, points + UP)[0].tolist() == [1, 0, 0]


def test_distant_points():
    points = np.array([[1e300, 0, 0], [-1e15, 1e15, 0], [0.2, 0.2, 5.0]])
    face, _ = _core.MeshDistance(TRIANGLE, ONE, max_distance=0.1).closest_faces(
        points, points * 1.0
    )
    assert (face == -1).all()


def test_threads_change_nothing():
    vertices, faces, points, origins = soup(7, 400)
    points, origins = np.tile(points, (20, 1)), np.tile(origins, (20, 1))
    near = _core.MeshDistance(vertices, faces, max_distance=0.1)
    once = near.closest_faces(points, origins)
    for threads in (2, 3, 500):
        again = near.closest_faces(points, origins, threads=threads)
        assert all(a.tobytes() == b.tobytes() for a, b in zip(once, again, strict=True))
    assert (once[0].reshape(20, -1) == once[0][:800]).all()


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"vertices": np.full((3, 3), np.nan)}, "vertices: not finite"),
        ({"vertices": np.full((3, 3), -1e10)}, "vertices: not finite, or beyond"),
        ({"faces": np.array([[0, 1, 3]], np.int32)}, "faces: vertex index out of range"),
        ({"faces": np.array([[0, 1, -1]], np.int32)}, "faces: vertex index out of range"),
        ({"max_distance": 0.0}, "max_distance: expected"),
        ({"max_distance": np.nan}, "max_distance: expected"),
        ({"max_distance": np.inf}, "max_distance: expected"),
    ],
)
def test_invalid_meshes(changes, said):
    given = {"vertices": TRIANGLE, "faces": ONE, "max_distance": 0.1}
    with pytest.raises(ValueError, match=said):
        _core.MeshDistance(**{**given, **changes})


def test_invalid_points():
    near = _core.MeshDistance(TRIANGLE, ONE, max_distance=0.1)
    points = np.zeros((4, 3))
    spoilt = points.copy()
    for bad in (np.nan, np.inf):
        spoilt[2, 1] = bad
        with pytest.raises(ValueError, match="points: not finite"):
            near.closest_faces(spoilt, points)
        with pytest.raises(ValueError, match="origins: not finite"):
            near.closest_faces(points, spoilt)
    with pytest.raises(ValueError, match="origins: expected a row per point"):
        near.closest_faces(points, points[:3])


def test_wrong_types_are_refused():
    with pytest.raises(TypeError):
        _core.MeshDistance(TRIANGLE, ONE.astype(np.int64), max_distance=0.1)
    with pytest.raises(TypeError):
        _core.MeshDistance(TRIANGLE[:, :2].copy(), ONE, max_distance=0.1)
    near = _core.MeshDistance(TRIANGLE, ONE, max_distance=0.1)
    with pytest.raises(TypeError):
        near.closest_faces(np.zeros((4, 3), np.float32), np.zeros((4, 3)))
