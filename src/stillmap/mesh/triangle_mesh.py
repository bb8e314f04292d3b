"""Triangle meshes, their simplification by quadric error metrics, and subdivision of long edges."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import import_extra
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import component_labels

Bool = NDArray[np.bool_]
Float = NDArray[np.float64]
Float32 = NDArray[np.float32]
Image = NDArray[np.uint8]  # also single colors
Index = NDArray[np.intp]
Int32 = NDArray[np.int32]
Int64 = NDArray[np.int64]
Tell = Callable[[int, int], None]  # called with the work done and the total


def no_tell(done: int, total: int) -> None:
    """Discards progress."""


@dataclass(frozen=True, eq=False)
class Mesh(ShortRepr):
    """F triangles over V vertices.

    Attributes:
        vertices: (V, 3) float64, metres, z up.
        faces: (F, 3) int32, counter-clockwise as seen from the sensor.
    """

    vertices: Float
    faces: Int32

    @classmethod
    def empty(cls) -> "Mesh":
        """No faces and no vertices."""
        return cls(np.zeros((0, 3)), np.zeros((0, 3), np.int32))

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def corners(self) -> Float:
        """(F, 3, 3) metres: the three vertices of each face."""
        return self.vertices[self.faces]

    @property
    def centers(self) -> Float:
        """(F, 3) metres: the mean of each face's vertices."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.asarray((a + b + c) / 3.0)

    def areas(self) -> Float:
        """(F,) square metres."""
        return 0.5 * row_lengths(self._cross_products())

    def normals(self) -> Float:
        """(F, 3) unit vectors towards the sensor, zero for faces without area."""
        cross = self._cross_products()
        length = row_lengths(cross)
        return cross / np.where(length > 0.0, length, 1.0)[:, None]

    def _cross_products(self) -> Float:
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        return np.ascontiguousarray(cross_columns((b - a).T, (c - a).T).T)

    def adjacent_faces(self) -> Int32:
        """(N, 2) pairs of faces that share an edge, the lower number first, unique and sorted.

        Of an edge with more than two faces, each is paired with the next.
        """
        F = len(self.faces)
        corner, next = self.faces.astype(np.int64), np.roll(self.faces, -1, axis=1)
        key = (np.minimum(corner, next) * len(self.vertices) + np.maximum(corner, next)).ravel()
        face = np.repeat(np.arange(F), 3)
        order = np.argsort(key, kind="stable")
        same = np.flatnonzero(np.diff(key[order]) == 0)
        one, other = face[order[same]], face[order[same + 1]]
        low, high = np.minimum(one, other), np.maximum(one, other)
        both = np.unique((low * F + high)[low < high])
        return np.column_stack([both // F, both % F]).astype(np.int32)

    def select(self, kept: Bool) -> "Mesh":
        """The faces marked in `kept` (F,) with their vertices, in order."""
        return self.subset(np.flatnonzero(kept))

    def subset(self, numbers: Index) -> "Mesh":
        """The faces with numbers (n,) with their vertices, in order."""
        faces = self.faces[numbers]
        used = np.zeros(len(self.vertices), np.bool_)
        used[faces] = True
        number = np.cumsum(used, dtype=np.int64) - 1
        return Mesh(self.vertices[used], number[faces].astype(np.int32))


def concatenate_meshes(meshes: list[Mesh]) -> Mesh:
    """All faces of several meshes; vertices are not merged."""
    first = np.cumsum([0, *(len(one.vertices) for one in meshes)])
    return Mesh(
        np.concatenate([np.zeros((0, 3)), *(one.vertices for one in meshes)]),
        np.concatenate(
            [
                np.zeros((0, 3), np.int32),
                *(one.faces + np.int32(k) for one, k in zip(meshes, first[:-1], strict=True)),
            ]
        ),
    )


def weld(mesh: Mesh) -> Mesh:
    """Merges vertices at exactly the same position and drops faces that collapse."""
    # + 0.0: zero has one sign
    rows = np.ascontiguousarray(mesh.vertices + 0.0).view(np.dtype((np.void, 24))).ravel()
    _, first, number = np.unique(rows, return_index=True, return_inverse=True)
    order = np.sort(first)
    place = np.searchsorted(order, first)
    faces = place[number][mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return Mesh(mesh.vertices[order], faces.astype(np.int32))


def remove_small_components(mesh: Mesh, min_area: float) -> Mesh:
    """Drops connected components with less than `min_area` square metres."""
    if not len(mesh):
        return mesh
    pairs = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2).astype(np.intp)
    component = component_labels(pairs, len(mesh.vertices))
    of_face = component[mesh.faces[:, 0]]
    return mesh.select(np.bincount(of_face, mesh.areas())[of_face] >= min_area)


def cross_columns(a: Float, b: Float) -> Float:
    """(3, n) cross products of vectors (3, n): operations on long rows are fast."""
    return np.stack(
        [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
    )


def dot_columns(a: Float, b: Float) -> Float:
    """(n,) dot products of vectors (3, n)."""
    return np.asarray(a[0] * b[0] + a[1] * b[1] + a[2] * b[2])


def normalize_columns(vectors: Float) -> Float:
    """(3, n) unit vectors; zero vectors stay."""
    length = np.sqrt(dot_columns(vectors, vectors))
    return np.asarray(vectors / np.where(length > 0.0, length, 1.0))


def planar_areas(corners: Float) -> Float:
    """(n,) areas of triangles (n, 3, 2) in a plane."""
    a, b = corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]
    return 0.5 * np.abs(a[:, 0] * b[:, 1] - a[:, 1] * b[:, 0])


def row_lengths(vectors: Float) -> Float:
    """(n,) lengths of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)))


_MIN_ERROR, _ERROR_SHARE = 0.01, 0.25  # m, and of a voxel's edge: how far a surface may move

# pyfqmr lets an error pass of alpha * (iteration + K) ** aggressiveness
_SIMPLIFICATION_ROUNDS = 20
_AGGRESSIVENESS = 3.0
_K = 3.0

_ERROR_GROWTH = 2.0  # factor by which the error grows while there are too many triangles
_MAX_GROWTHS = 24

_SUBDIVISION_ROUNDS = 12  # each halves the longest edges


def simplification_error(voxel: float) -> float:
    """Error bound in metres for a surface of voxels with this edge in metres."""
    return max(_MIN_ERROR, _ERROR_SHARE * voxel)


def simplify(mesh: Mesh, error: float, *, whole_border: bool = True, most: int = 0) -> Mesh:
    """Simplifies a mesh; no triangle is flipped.

    Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997.

    Args:
        mesh: welded.
        error: metres, root of the sum of a vertex's squared distances from the planes around it.
        whole_border: keep each vertex on the border.
        most: number of triangles that is enough; 0: as few as the error allows.
    """
    if len(mesh) <= most or not len(mesh) or error <= 0.0:
        return mesh
    pyfqmr: Any = import_extra("pyfqmr", "mesh.glb", "made", group="mesh")
    work = pyfqmr.Simplify()
    work.setMesh(mesh.vertices, mesh.faces)
    work.simplify_mesh(
        target_count=most,
        max_iterations=_SIMPLIFICATION_ROUNDS,
        aggressiveness=_AGGRESSIVENESS,
        K=_K,
        alpha=error * error / (_SIMPLIFICATION_ROUNDS + _K) ** _AGGRESSIVENESS,
        preserve_border=whole_border,
        verbose=False,
    )
    vertices, faces, _ = work.getMesh()
    return Mesh(np.array(vertices, np.float64), np.array(faces, np.int32).reshape(-1, 3))


def simplify_to_budget(mesh: Mesh, error: float, most: int) -> Mesh:
    """Simplifies a mesh to at most `most` triangles with a growing error; borders go last."""
    for _ in range(_MAX_GROWTHS):
        if len(mesh) <= most:
            break
        error *= _ERROR_GROWTH
        mesh = simplify(mesh, error, most=most)
        # else the surface inside would have to make up for ragged borders
        mesh = simplify(mesh, error, whole_border=False, most=most)
    return mesh


def subdivide(mesh: Mesh, max_edge: float | Callable[[Float], Float]) -> tuple[Mesh, Index]:
    """Subdivides faces until no edge is too long; adjacent faces stay adjacent.

    Long edges are halved; triangles with one, two or three of them become two, three or four.

    Args:
        mesh: F faces.
        max_edge: metres; or the maximum length (n,) of edges that end at points (n, 3).

    Returns:
        The mesh, its first vertices those of the old one, and the old face (F',) of each face.
    """
    vertices, faces = mesh.vertices, mesh.faces
    of = np.arange(len(faces))
    limit = _edge_limits(max_edge, vertices)
    for _ in range(_SUBDIVISION_ROUNDS):
        long = np.column_stack(
            [_is_long(vertices, limit, faces[:, k], faces[:, (k + 1) % 3]) for k in range(3)]
        )
        if not long.any():
            break
        ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)  # (F, 3, 2): edges ab, bc, ca
        middle, vertices = _add_midpoints(ends, long, vertices)
        limit = np.concatenate([limit, _edge_limits(max_edge, vertices[len(limit) :])])
        faces, of = _split_faces(faces, middle, of)
    return Mesh(vertices, faces), of


def _edge_limits(max_edge: float | Callable[[Float], Float], points: Float) -> Float:
    return max_edge(points) if callable(max_edge) else np.full(len(points), float(max_edge))


def _is_long(vertices: Float, limit: Float, a: Int32, b: Int32) -> Bool:
    """(F,) whether edges from a to b are too long."""
    x, y, z = (vertices[a] - vertices[b]).T
    return np.asarray(x * x + y * y + z * z > np.minimum(limit[a], limit[b]) ** 2)


def _add_midpoints(ends: Int32, long: Bool, vertices: Float) -> tuple[Int32, Float]:
    """(F, 3) midpoint vertices of long edges, -1 for others; all vertices, with these."""
    one, other = ends[long].astype(np.int64).T
    key = np.minimum(one, other) * len(vertices) + np.maximum(one, other)
    key, number = np.unique(key, return_inverse=True)
    middle = np.full(long.shape, -1, np.int32)
    middle[long] = len(vertices) + number
    a, b = key // len(vertices), key % len(vertices)
    return middle, np.concatenate([vertices, 0.5 * (vertices[a] + vertices[b])])


def _split_faces(faces: Int32, middle: Int32, of: Index) -> tuple[Int32, Index]:
    """Splits faces by the midpoints of their edges."""
    count = (middle >= 0).sum(axis=1)
    parts, origin = [faces[count == 0]], [of[count == 0]]
    for n in (1, 2, 3):
        rows = np.flatnonzero(count == n)
        # rotated so that the first edge has a midpoint, or with two the last one has none
        turn = np.argmax(middle[rows] >= 0, axis=1) if n == 1 else np.zeros(len(rows), np.intp)
        if n == 2:
            turn = (np.argmax(middle[rows] < 0, axis=1) + 1) % 3
        at = (np.arange(3) + turn[:, None]) % 3
        a, b, c = np.take_along_axis(faces[rows], at, axis=1).T
        ab, bc, ca = np.take_along_axis(middle[rows], at, axis=1).T
        corners = {
            1: [(a, ab, c), (ab, b, c)],
            2: [(ab, b, bc), (a, ab, bc), (a, bc, c)],
            3: [(a, ab, ca), (ab, b, bc), (ca, bc, c), (ab, bc, ca)],
        }[n]
        for three in corners:
            parts.append(np.stack(three, axis=1))
            origin.append(of[rows])
    # parts of a face side by side, in the order of the faces
    owner = np.concatenate(origin)
    order = np.argsort(owner, kind="stable")
    return np.concatenate(parts)[order], owner[order]
