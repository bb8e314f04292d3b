"""Triangle meshes, their simplification by quadric error metrics, and subdivision of long edges."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Index, Int32
from stillmap.core.errors import import_extra
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import component_labels

Image = NDArray[np.uint8]  # also single colors
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
        return np.cross(b - a, c - a)

    def adjacent_faces(self) -> Int32:
        """(N, 2) pairs of faces that share an edge, if no third face does."""
        graph: Any = import_extra("trimesh.graph", "mesh.glb", "made", group="mesh")
        return np.asarray(graph.face_adjacency(self.faces), np.int32).reshape(-1, 2)

    def select(self, which: Bool | Index) -> "Mesh":
        """The faces marked in a mask (F,), or with numbers (n,), in order, with their vertices."""
        used, faces = np.unique(self.faces[which], return_inverse=True)
        return Mesh(self.vertices[used], faces.reshape(-1, 3).astype(np.int32))


def concatenate_meshes(meshes: list[Mesh]) -> Mesh:
    """All faces of several meshes; vertices are not merged."""
    first = np.cumsum([0, *(len(one.vertices) for one in meshes)], dtype=np.int32)
    faces = [one.faces + k for one, k in zip(meshes, first[:-1], strict=True)]
    return Mesh(
        np.concatenate([np.zeros((0, 3)), *(one.vertices for one in meshes)]),
        np.concatenate([np.zeros((0, 3), np.int32), *faces]),
    )


def weld(mesh: Mesh) -> Mesh:
    """Merges vertices at exactly the same position and drops faces that collapse."""
    # + 0.0: zero has one sign
    vertices, number = np.unique(mesh.vertices + 0.0, axis=0, return_inverse=True)
    faces = number.reshape(-1)[mesh.faces].astype(np.int32)
    a, b, c = faces.T
    return Mesh(vertices, faces[(a != b) & (b != c) & (c != a)])


def remove_small_components(mesh: Mesh, min_area: float) -> Mesh:
    """Drops connected components with less than `min_area` square metres."""
    if not len(mesh):
        return mesh
    pairs = mesh.faces[:, [0, 1, 1, 2]].reshape(-1, 2).astype(np.intp)
    component = component_labels(pairs, len(mesh.vertices))
    of_face = component[mesh.faces[:, 0]]
    return mesh.select(np.bincount(of_face, mesh.areas())[of_face] >= min_area)


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

_SUBDIVISION_ROUNDS = 100  # a guard: each halves edges


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
    work = import_extra("pyfqmr", "mesh.glb", "made", group="mesh").Simplify()
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

    A face is halved across the longest of its long edges, in the round in which all faces of that
    edge are.

    Args:
        mesh: F faces.
        max_edge: metres; or the maximum length (n,) of edges that end at points (n, 3).

    Returns:
        The mesh, its first vertices those of the old one, and the old face (F',) of each face.
    """
    vertices, faces, of = mesh.vertices, mesh.faces, np.arange(len(mesh.faces))
    limit, done = _edge_limits(max_edge, vertices), [(faces[:0], of[:0])]
    for _ in range(_SUBDIVISION_ROUNDS):
        ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
        key, edge = np.unique(ends @ [len(vertices), 1], return_inverse=True)
        edge, (a, b) = edge.reshape(-1, 3), np.divmod(key, max(len(vertices), 1))
        length = row_lengths(vertices[a] - vertices[b])
        long = length > np.minimum(limit[a], limit[b])
        rest = long[edge].any(axis=1)
        done.append((faces[~rest], of[~rest]))
        faces, of, edge = faces[rest], of[rest], edge[rest]
        if not len(faces):
            break
        rank = np.empty(len(key), np.intp)
        rank[np.lexsort((length, long))] = np.arange(len(key))
        first = np.argmax(rank[edge], axis=1)
        across = edge[np.arange(len(edge)), first]
        count, every = (np.bincount(some, minlength=len(key)) for some in (across, edge.ravel()))
        halved = long & (count == every)
        middle = len(vertices) + np.cumsum(halved) - 1
        points = 0.5 * (vertices[a[halved]] + vertices[b[halved]])
        vertices = np.concatenate([vertices, points])
        limit = np.concatenate([limit, _edge_limits(max_edge, points)])
        faces, of = _halve_faces(faces, of, halved[across], first, middle[across])
    parts, owners = zip(*done, (faces, of), strict=True)
    owner = np.concatenate(owners)
    # parts of a face side by side, in the order of the faces
    order = np.argsort(owner, kind="stable")
    return Mesh(vertices, np.concatenate(parts)[order]), owner[order]


def _edge_limits(max_edge: float | Callable[[Float], Float], points: Float) -> Float:
    return max_edge(points) if callable(max_edge) else np.full(len(points), float(max_edge))


def _halve_faces(
    faces: Int32, of: Index, halved: Bool, first: Index, middle: Index
) -> tuple[Int32, Index]:
    """Halves faces by the vertices in the middle of their edges that begin at corner `first`."""
    turn = (np.arange(3) + first[halved, None]) % 3
    a, b, c = np.take_along_axis(faces[halved], turn, axis=1).T
    m = middle[halved].astype(np.int32)
    parts = [faces[~halved], np.stack([a, m, c], axis=1), np.stack([m, b, c], axis=1)]
    return np.concatenate(parts), np.concatenate([of[~halved], of[halved], of[halved]])
