"""Triangle meshes."""

from dataclasses import dataclass

import numpy as np

from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import component_labels
from stillmap.mesh.types import Bool, Float, Index, Int32


@dataclass(frozen=True, eq=False)
class Mesh(ShortRepr):
    """F triangles over V vertices.

    Attributes:
        vertices: (V, 3) float64, metres, z up.
        faces: (F, 3) int32, counter-clockwise as seen from the sensor.
    """

    vertices: Float
    faces: Int32

    def __post_init__(self) -> None:
        V = len(self.vertices)
        if self.vertices.shape != (V, 3) or self.vertices.dtype != np.float64:
            raise ValueError(f"vertices: expected (V, 3) float64, got {self.vertices.shape}")
        if self.faces.shape != (len(self.faces), 3) or self.faces.dtype != np.int32:
            raise ValueError(f"faces: expected (F, 3) int32, got {self.faces.shape}")
        if self.faces.size and (self.faces.min() < 0 or self.faces.max() >= V):
            raise ValueError(f"faces: a vertex that is not there, of {V}")

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


def row_lengths(vectors: Float) -> Float:
    """(n,) lengths of vectors (n, 3)."""
    return np.asarray(np.sqrt(np.einsum("ni,ni->n", vectors, vectors)))
