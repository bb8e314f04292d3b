"""Fewer triangles for the same surface: quadric error metrics.

Triangles that are divided until no edge is long, without gaps between them.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core.errors import import_extra
from stillmap.mesh.triangle_mesh import Mesh

Float = NDArray[np.float64]

Index = NDArray[np.int32]

_SIMPLIFICATION_ROUNDS = 20  # in which the error that is let pass grows to what is allowed

_GROWTH = 3.0  # with this power

_FIRST = 3.0  # the round with which it begins

_AGAIN = 2.0  # times as much error is allowed next, while there are too many triangles

_MOST = 24  # times

_LITTLE = 0.9  # of the triangles left: more error does not help


def simplify(mesh: Mesh, error: float, *, whole_border: bool = True, most: int = 0) -> Mesh:
    """The mesh with fewer triangles; none is turned over.

    Garland and Heckbert, "Surface Simplification Using Quadric Error Metrics", SIGGRAPH 1997.

    Args:
        mesh: welded.
        error: metres, root of the sum of squared distances from the planes around that a vertex
            may have.
        whole_border: keep each vertex on the border.
        most: triangles that are enough; as few as the error allows in any case if 0.
    """
    if len(mesh) <= most or not len(mesh) or error <= 0.0:
        return mesh
    pyfqmr: Any = import_extra("pyfqmr", "mesh.glb", "made", group="mesh")
    work = pyfqmr.Simplify()
    work.setMesh(mesh.vertices, mesh.faces)
    work.simplify_mesh(
        target_count=most,
        max_iterations=_SIMPLIFICATION_ROUNDS,
        aggressiveness=_GROWTH,
        K=_FIRST,
        alpha=error * error / (_SIMPLIFICATION_ROUNDS + _FIRST) ** _GROWTH,
        preserve_border=whole_border,
        verbose=False,
    )
    vertices, faces, _ = work.getMesh()
    return Mesh(np.array(vertices, np.float64), np.array(faces, np.int32).reshape(-1, 3))


def simplify_to_budget(mesh: Mesh, error: float, most: int, *, whole_border: bool = False) -> Mesh:
    """The mesh with so many triangles at most, whatever the error; borders go last.

    With `whole_border` they stay, and there may be more triangles.
    """
    for _ in range(_MOST):
        before = len(mesh)
        if before <= most:
            break
        error *= _AGAIN
        mesh = simplify(mesh, error, most=most)
        if not whole_border:
            # before the surface goes, which would have to make up for ragged borders
            mesh = simplify(mesh, error, whole_border=False, most=most)
        elif len(mesh) > _LITTLE * before:
            break
    return mesh


_SUBDIVISION_ROUNDS = 12  # at most; each halves the longest edges


def subdivide(mesh: Mesh, edge: float | Callable[[Float], Float]) -> tuple[Mesh, NDArray[np.intp]]:
    """The same surface, all of whose edges are shorter; neighbours stay neighbours.

    Edges longer than `edge` metres are halved, and triangles with one, two or three such edges
    become two, three or four, again and again.

    Args:
        mesh: F faces.
        edge: metres; or what says of points (n, 3) how long edges may be that end there.

    Returns:
        The mesh, its first vertices those of the old one, and (F,) the face of the old one that
        each face is a part of.
    """
    vertices, faces = mesh.vertices, mesh.faces
    of = np.arange(len(faces))
    limit = _limits(edge, vertices)
    for _ in range(_SUBDIVISION_ROUNDS):
        long = np.column_stack(
            [_long(vertices, limit, faces[:, k], faces[:, (k + 1) % 3]) for k in range(3)]
        )
        if not long.any():
            break
        ends = np.stack([faces, np.roll(faces, -1, axis=1)], axis=2)  # (F, 3, 2): edges ab, bc, ca
        middle, vertices = _halved(ends, long, vertices)
        limit = np.concatenate([limit, _limits(edge, vertices[len(limit) :])])
        faces, of = _parted(faces, middle, of)
    return Mesh(vertices, faces), of


def _limits(edge: float | Callable[[Float], Float], points: Float) -> Float:
    """(n,) metres, how long edges that end at points (n, 3) may be."""
    return edge(points) if callable(edge) else np.full(len(points), float(edge))


def _long(vertices: Float, limit: Float, a: Index, b: Index) -> NDArray[np.bool_]:
    """(F,) whether edges from a to b are too long."""
    x, y, z = (vertices[a] - vertices[b]).T
    return np.asarray(x * x + y * y + z * z > np.minimum(limit[a], limit[b]) ** 2)


def _halved(ends: Index, long: NDArray[np.bool_], vertices: Float) -> tuple[Index, Float]:
    """(F, 3) vertices in the middle of long edges, -1 for others; all vertices, with these."""
    one, other = ends[long].astype(np.int64).T
    key = np.minimum(one, other) * len(vertices) + np.maximum(one, other)
    key, number = np.unique(key, return_inverse=True)
    middle = np.full(long.shape, -1, np.int32)
    middle[long] = len(vertices) + number
    a, b = key // len(vertices), key % len(vertices)
    return middle, np.concatenate([vertices, 0.5 * (vertices[a] + vertices[b])])


def _parted(faces: Index, middle: Index, of: NDArray[np.intp]) -> tuple[Index, NDArray[np.intp]]:
    """The parts of faces whose edges have middles, by how many have."""
    count = (middle >= 0).sum(axis=1)
    parts, origin = [faces[count == 0]], [of[count == 0]]
    for n in (1, 2, 3):
        rows = np.flatnonzero(count == n)
        # turned so that the first edge has a middle, or with two the last one has none
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
