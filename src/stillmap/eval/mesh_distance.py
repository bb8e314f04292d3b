"""Points sampled on triangles, and distances from points to a mesh."""

from typing import NamedTuple

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core.errors import import_extra

Float = NDArray[np.float64]
Index = NDArray[np.int32]

_CANDIDATES = 6  # triangles per point whose exact distance is computed
_BLOCK = 1 << 18  # points processed at once
_MAX_SAMPLES = 1 << 24  # of the lattice of a mesh
_TILE, _OVERLAP = 20.0, 2.0  # m, edge of a tile of a large mesh, and overlap of tiles


class SurfaceSamples(NamedTuple):
    """n points on triangles.

    Attributes:
        points: (n, 3) metres.
        face: (n,) triangle of each.
        weight: (n, 3) barycentric coordinates.
    """

    points: Float
    face: NDArray[np.intp]
    weight: Float


def triangle_areas(vertices: Float, faces: Index) -> Float:
    """(F,) square metres."""
    return 0.5 * np.asarray(np.linalg.norm(_cross_products(vertices, faces), axis=1))


def triangle_normals(vertices: Float, faces: Index) -> Float:
    """(F, 3) unit normals; zero of triangles without area."""
    across = _cross_products(vertices, faces)
    length = np.linalg.norm(across, axis=1, keepdims=True)
    return np.asarray(across / np.where(length > 0.0, length, 1.0))


def sample_surface(vertices: Float, faces: Index, n: int, seed: int = 0) -> SurfaceSamples:
    """n points, uniform over the area, the same at every call.

    Triangles are sampled in order at even steps of area, so that the error of a share of the area
    is about 1 / n, not 1 / sqrt(n).
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
    """Points on a lattice within each triangle, at most `spacing` metres apart."""
    corners = vertices[faces]
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    steps = np.maximum(np.ceil(longest / spacing), 1).astype(np.int64)
    if int((steps * steps).sum()) > _MAX_SAMPLES:
        raise ValueError(f"spacing: {spacing} m is too fine for so large a mesh")
    of_face, weights = [np.empty(0, np.intp)], [np.empty((0, 3))]
    for n in np.unique(steps).tolist():
        some, cell = np.flatnonzero(steps == n), _subtriangle_centers(n)
        of_face.append(np.repeat(some, len(cell)))
        weights.append(np.tile(cell, (len(some), 1)))
    face, weight = np.concatenate(of_face), np.concatenate(weights)
    return SurfaceSamples(_at(vertices, faces, face, weight), face, weight)


def distance_to_mesh(points: Float, vertices: Float, faces: Index, spacing: float) -> Float:
    """(n,) metres from points (n, 3) to the nearest triangle.

    Exact up to `spacing` except for slivers, because only the triangles with the nearest lattice
    points are candidates; beyond, possibly too large. Of a large mesh, points without a triangle
    within some metres have infinite distance.
    """
    out = np.full(len(points), np.inf)
    if not len(faces) or not len(points):
        return out
    corners = vertices[faces]
    low, high = corners.min(axis=1), corners.max(axis=1)
    if float(np.ptp(vertices[np.unique(faces)][:, :2], axis=0).max()) <= _TILE:
        return _distance_to_tile(points, vertices, faces, spacing)
    tiles, of = np.unique(np.floor(points[:, :2] / _TILE), axis=0, return_inverse=True)
    for number, tile in enumerate(tiles):
        first, last = tile * _TILE - _OVERLAP, (tile + 1.0) * _TILE + _OVERLAP
        near = ((low[:, :2] <= last) & (high[:, :2] >= first)).all(axis=1)
        mine = np.flatnonzero(of.ravel() == number)
        out[mine] = _distance_to_tile(points[mine], vertices, faces[near], spacing)
    return out


def _distance_to_tile(points: Float, vertices: Float, faces: Index, spacing: float) -> Float:
    """(n,) metres to the nearest triangle of a mesh that is not large."""
    out = np.full(len(points), np.inf)
    if not len(faces):
        return out
    of_mesh = sample_lattice(vertices, faces, spacing)
    tree = scipy.spatial.cKDTree(of_mesh.points)
    few = min(_CANDIDATES, len(of_mesh.points))
    for first in range(0, len(points), _BLOCK):
        block = points[first : first + _BLOCK]
        _, near = tree.query(block, k=list(range(1, few + 1)))
        for column in of_mesh.face[near].T:
            found = _distance_to_triangles(block, vertices[faces[column]])
            np.minimum(out[first : first + _BLOCK], found, out=out[first : first + _BLOCK])
    return out


def first_per_voxel(points: Float, size: float) -> NDArray[np.intp]:
    """Indices, rising, of the first point in each voxel of edge `size`."""
    _, first = np.unique(np.floor(points / size).astype(np.int64), axis=0, return_index=True)
    return np.sort(first)


def _cross_products(vertices: Float, faces: Index) -> Float:
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    return np.cross(b - a, c - a)


def _at(vertices: Float, faces: Index, face: NDArray[np.intp], weight: Float) -> Float:
    return np.asarray(np.einsum("nk,nkd->nd", weight, vertices[faces[face]]))


def _subtriangle_centers(n: int) -> Float:
    """(n * n, 3) barycentric centers of the equal parts of a triangle whose sides are cut in n."""
    i, j = (one.ravel() for one in np.meshgrid(np.arange(n), np.arange(n), indexing="ij"))
    upward, downward = i + j < n, i + j < n - 1
    first = np.concatenate([i[upward] + 1 / 3, i[downward] + 2 / 3]) / n
    second = np.concatenate([j[upward] + 1 / 3, j[downward] + 2 / 3]) / n
    return np.stack([1.0 - first - second, first, second], axis=1)


def _distance_to_triangles(points: Float, corners: Float) -> Float:
    """(n,) metres from each point (n, 3) to its triangle (n, 3, 3)."""
    closest = import_extra("trimesh.triangles", "mesh", "compared with the truth", group="mesh")
    return np.asarray(np.linalg.norm(closest.closest_point(corners, points) - points, axis=1))
