"""Triangles as points, and how far points are from triangles."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

Float = NDArray[np.float64]
Index = NDArray[np.int32]

_FEW = 6  # triangles that may be the nearest one
_BLOCK = 1 << 18  # points worked on together
_MOST_POINTS = 1 << 24  # that a mesh is looked at
_TILE, _BESIDE = 20.0, 2.0  # m, edge of a part of a large mesh, and how much beside it counts too


class SurfaceSamples(NamedTuple):
    """n points on triangles.

    Attributes:
        points: (n, 3) metres.
        face: (n,) of which triangle each is.
        weight: (n, 3) of the triangle's corners.
    """

    points: Float
    face: NDArray[np.intp]
    weight: Float


def triangle_areas(vertices: Float, faces: Index) -> Float:
    """(F,) square metres."""
    return 0.5 * np.asarray(np.linalg.norm(_across(vertices, faces), axis=1))


def triangle_normals(vertices: Float, faces: Index) -> Float:
    """(F, 3) of length one; zero of triangles without area."""
    across = _across(vertices, faces)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(across / np.where(length > 0.0, length, 1.0))


def sample_surface(vertices: Float, faces: Index, n: int, seed: int = 0) -> SurfaceSamples:
    """n points, as many on each square metre: the same ones at every call.

    Triangles are met in their order at even steps of area, so that shares of areas come out to
    about one over the points, and not to the root of that.
    """
    total = np.cumsum(triangle_areas(vertices, faces))
    if not len(total) or not total[-1] > 0.0:
        return SurfaceSamples(np.empty((0, 3)), np.empty(0, np.intp), np.empty((0, 3)))
    rng = np.random.default_rng(seed)
    at = (np.arange(n) + rng.random(n)) * (total[-1] / n)
    face = np.minimum(np.searchsorted(total, at, side="right"), len(faces) - 1)
    root, share = np.sqrt(rng.random(n)), rng.random(n)
    weight = np.stack([1.0 - root, root * (1.0 - share), root * share], axis=1)
    return SurfaceSamples(_at(vertices, faces, face, weight), face, weight)


def sample_lattice(vertices: Float, faces: Index, spacing: float) -> SurfaceSamples:
    """Points on a lattice within each triangle, no farther than `spacing` from one to the next."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(longest / spacing), 1).astype(np.int64)
    if int((steps * steps).sum()) > _MOST_POINTS:
        raise ValueError(f"spacing: {spacing} m is too fine for so large a mesh")
    of_face, weights = [np.empty(0, np.intp)], [np.empty((0, 3))]
    for n in np.unique(steps).tolist():
        some, cell = np.flatnonzero(steps == n), _middles(n)
        of_face.append(np.repeat(some, len(cell)))
        weights.append(np.tile(cell, (len(some), 1)))
    face, weight = np.concatenate(of_face), np.concatenate(weights)
    return SurfaceSamples(_at(vertices, faces, face, weight), face, weight)


def distance_to_mesh(points: Float, vertices: Float, faces: Index, reach: float) -> Float:
    """(n,) metres from points (n, 3) to the nearest triangle.

    Exact where that is one of those whose lattice comes nearest, which within `reach` it is but
    for slivers; beyond, too far rather than too near. Where a mesh is large, points that have no
    triangle within some metres are infinitely far from it.
    """
    out = np.full(len(points), np.inf)
    if not len(faces) or not len(points):
        return out
    corners = vertices[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    if float(np.ptp(vertices[np.unique(faces)][:, :2], axis=0).max()) <= _TILE:
        return _to_mesh(points, vertices, faces, reach)
    tiles, of = np.unique(np.floor(points[:, :2] / _TILE), axis=0, return_inverse=True)
    for number, tile in enumerate(tiles):
        first, last = tile * _TILE - _BESIDE, (tile + 1.0) * _TILE + _BESIDE
        near = ((low[:, :2] <= last) & (high[:, :2] >= first)).all(axis=1)
        mine = np.flatnonzero(of.ravel() == number)
        out[mine] = _to_mesh(points[mine], vertices, faces[near], reach)
    return out


def _to_mesh(points: Float, vertices: Float, faces: Index, reach: float) -> Float:
    """The same of a mesh that is not large."""
    out = np.full(len(points), np.inf)
    if not len(faces):
        return out
    of_mesh = sample_lattice(vertices, faces, reach)
    tree = scipy.spatial.cKDTree(of_mesh.points)
    few = min(_FEW, len(of_mesh.points))
    for first in range(0, len(points), _BLOCK):
        block = points[first : first + _BLOCK]
        _, near = tree.query(block, k=list(range(1, few + 1)))
        for column in of_mesh.face[near].T:
            found = _to_triangles(block, vertices[faces[column]])
            np.minimum(out[first : first + _BLOCK], found, out=out[first : first + _BLOCK])
    return out


def first_per_voxel(points: Float, size: float) -> NDArray[np.intp]:
    """Which points are the first ones within cubes of that size, rising."""
    _, first = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def _across(vertices: Float, faces: Index) -> Float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def _at(vertices: Float, faces: Index, face: NDArray[np.intp], weight: Float) -> Float:
    return np.asarray(np.einsum("nk,nkd->nd", weight, vertices[faces[face]]))


def _middles(n: int) -> Float:
    """(n * n, 3) the middles of the equal parts of a triangle, whose sides are cut in n."""
    i, j = (one.ravel() for one in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    upward, downward = i + j < n, i + j < n - 1
    first = np.concatenate([i[upward] + 1 / 3, i[downward] + 2 / 3]) / n
    second = np.concatenate([j[upward] + 1 / 3, j[downward] + 2 / 3]) / n
    return np.stack([1.0 - first - second, first, second], axis=1)


def _to_triangles(points: Float, corners: Float) -> Float:
    """(n,) metres from each point (n, 3) to a triangle (n, 3, 3) of its own."""
    a, b, c = np.moveaxis(corners, 1, 0)
    across = np.cross(b - a, c - a)
    square = np.maximum((across * across).sum(axis=1), 1e-300)
    from_a = points - a
    v = (np.cross(from_a, c - a) * across).sum(axis=1) / square
    w = (np.cross(b - a, from_a) * across).sum(axis=1) / square
    above = np.abs((from_a * across).sum(axis=1)) / np.sqrt(square)
    sides = [_to_edges(points, *pair) for pair in ((a, b), (b, c), (c, a))]
    inside = (v >= 0) & (w >= 0) & (v + w <= 1) & (square > 1e-24)
    return np.asarray(np.where(inside, above, np.minimum.reduce(sides)))


def _to_edges(points: Float, a: Float, b: Float) -> Float:
    along = b - a
    square = np.maximum((along * along).sum(axis=1), 1e-300)
    share = np.clip(((points - a) * along).sum(axis=1) / square, 0.0, 1.0)
    return np.asarray(np.linalg.norm(points - a - share[:, None] * along, axis=1))
