"""Triangles in space."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]
Index = NDArray[np.int32]


@dataclass(frozen=True, eq=False)
class Mesh:
    """F triangles over V vertices.

    Attributes:
        vertices: (V, 3) float64, metres, z up.
        faces: (F, 3) int32, counter-clockwise seen from where the sensor was.
    """

    vertices: Float
    faces: Index

    def __post_init__(self) -> None:
        V = len(self.vertices)
        if self.vertices.shape != (V, 3) or self.vertices.dtype != np.float64:
            raise ValueError(f"vertices: expected (V, 3) float64, got {self.vertices.shape}")
        if self.faces.shape != (len(self.faces), 3) or self.faces.dtype != np.int32:
            raise ValueError(f"faces: expected (F, 3) int32, got {self.faces.shape}")
        if self.faces.size and (self.faces.min() < 0 or self.faces.max() >= V):
            raise ValueError(f"faces: a vertex that is not there, of {V}")

    def __len__(self) -> int:
        return len(self.faces)

    @property
    def corners(self) -> Float:
        """(F, 3, 3) metres: the three vertices of each face."""
        return self.vertices[self.faces]

    @property
    def centres(self) -> Float:
        """(F, 3) metres."""
        return np.asarray(self.corners.mean(axis=1))

    def areas(self) -> Float:
        """(F,) square metres."""
        return 0.5 * np.asarray(np.linalg.norm(self._spans(), axis=1))

    def normals(self) -> Float:
        """(F, 3) of length one, zero for faces without area; towards where the sensor was."""
        spans = self._spans()
        length = np.linalg.norm(spans, axis=1, keepdims=True)
        return spans / np.where(length > 0.0, length, 1.0)

    def _spans(self) -> Float:
        a, b, c = np.moveaxis(self.corners, 1, 0)
        return np.cross(b - a, c - a)

    def pairs(self) -> Index:
        """(N, 2) faces that share an edge, the lower number first, each pair once, rising.

        Of an edge that more than two share, each is beside the next.
        """
        F = len(self.faces)
        edges = np.sort(self.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2).astype(np.int64), axis=1)
        key, face = edges[:, 0] * len(self.vertices) + edges[:, 1], np.repeat(np.arange(F), 3)
        order = np.argsort(key, kind="stable")
        same = np.flatnonzero(np.diff(key[order]) == 0)
        pairs = np.sort(np.stack([face[order[same]], face[order[same + 1]]], axis=1), axis=1)
        pairs = pairs[pairs[:, 0] < pairs[:, 1]]
        return np.unique(pairs, axis=0).astype(np.int32)

    def part(self, kept: NDArray[np.bool_]) -> "Mesh":
        """The faces (F,) that are kept, with the vertices that they use, in their order."""
        faces = self.faces[kept]
        used = np.zeros(len(self.vertices), np.bool_)
        used[faces] = True
        number = np.cumsum(used, dtype=np.int64) - 1
        return Mesh(self.vertices[used], number[faces].astype(np.int32))


def joined(meshes: list[Mesh]) -> Mesh:
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
