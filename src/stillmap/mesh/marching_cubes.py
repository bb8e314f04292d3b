"""Meshes from signed distances: marching cubes, tile by tile, welded."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import stillmap._core as _core
from stillmap.core.errors import import_extra
from stillmap.mesh.triangle_mesh import Mesh, concatenate_meshes

Float = NDArray[np.float64]

TILE = 64  # voxels along a tile, whole blocks
_LEAP = 2.5  # voxels by which distances differ within a cube where there are two surfaces


def occupied_tiles(distances: _core.TsdfVolume) -> NDArray[np.int64]:
    """(N, 3) tiles in which something is known, in the order of their numbers."""
    return np.unique(distances.blocks() // blocks_per_tile(distances), axis=0)


def blocks_per_tile(distances: _core.TsdfVolume) -> int:
    """Blocks along the edge of a tile."""
    return TILE // distances.block_edge


def march_tile(distances: _core.TsdfVolume, tile: NDArray[np.int64], fewest: float) -> Mesh:
    """The surface within one tile; vertices on its borders are those of the tile beside.

    There is no surface where a corner of a cube is not known, nor where distances leap: there
    what lies behind one surface meets what lies in front of another one.

    Args:
        distances: signed distances.
        tile: (3,) in tiles.
        fewest: weight that a voxel needs.
    """
    measure: Any = import_extra("skimage.measure", "mesh.glb", "made", group="mesh")
    first = [int(c) * TILE for c in tile]
    metres, weight = distances.dense(first, [TILE + 1] * 3)
    known = weight > fewest
    cubes = _of_cubes(np.logical_and, known)
    low = _of_cubes(np.minimum, np.where(known, metres, np.inf))
    high = _of_cubes(np.maximum, np.where(known, metres, -np.inf))
    cubes &= (low < 0.0) & (high >= 0.0) & (high - low <= _LEAP * distances.voxel)
    if not cubes.any():
        return Mesh(np.zeros((0, 3)), np.zeros((0, 3), np.int32))
    # the library asks the mask at the last corner of a cube
    mask = np.zeros(metres.shape, np.bool_)
    mask[1:, 1:, 1:] = cubes
    found, faces, _, _ = measure.marching_cubes(
        np.where(known, metres, np.float32(1.0)), 0.0, mask=mask, gradient_direction="ascent"
    )
    vertices = found[:, ::-1].astype(np.float64) + first
    return Mesh(vertices, np.ascontiguousarray(faces, np.int32))


def _of_cubes(
    ufunc: Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]], values: NDArray[Any]
) -> NDArray[Any]:
    """What the eight corners of each cube come to."""
    for axis in range(3):
        low = tuple(slice(None, -1) if d == axis else slice(None) for d in range(3))
        high = tuple(slice(1, None) if d == axis else slice(None) for d in range(3))
        values = ufunc(values[low], values[high])
    return values


def extract_tile(distances: _core.TsdfVolume, tile: NDArray[np.int64], fewest: float) -> Mesh:
    """The surface within one tile, in metres; see `meshed`."""
    mesh = march_tile(distances, tile, fewest)
    return _in_metres(weld(mesh), distances.voxel) if len(mesh) else mesh


def _in_metres(mesh: Mesh, voxel: float) -> Mesh:
    """Vertices are counted from the middle of voxel 0."""
    return Mesh((mesh.vertices + 0.5) * voxel, mesh.faces)


def weld(mesh: Mesh) -> Mesh:
    """Vertices at exactly the same place are one; faces without area are gone."""
    # + 0.0: zero has one sign
    rows = np.ascontiguousarray(mesh.vertices + 0.0).view(np.dtype((np.void, 24))).ravel()
    _, first, number = np.unique(rows, return_index=True, return_inverse=True)
    order = np.sort(first)
    place = np.searchsorted(order, first)
    faces = place[number][mesh.faces]
    a, b, c = faces.T
    faces = faces[(a != b) & (b != c) & (c != a)]
    return Mesh(mesh.vertices[order], faces.astype(np.int32))


def remove_small_components(mesh: Mesh, area: float) -> Mesh:
    """Without the connected pieces that have less area, in square metres."""
    if not len(mesh):
        return mesh
    V = len(mesh.vertices)
    a, b, c = mesh.faces.T
    ones = np.ones(2 * len(mesh), np.int32)
    graph = coo_matrix((ones, (np.concatenate([a, b]), np.concatenate([b, c]))), (V, V))
    count, piece = connected_components(graph, directed=False)
    areas = np.bincount(piece[a], mesh.areas(), count)
    return mesh.select(areas[piece[a]] >= area)


def weld_meshes(parts: list[Mesh]) -> Mesh:
    """One mesh of the tiles', vertices on borders welded."""
    return weld(concatenate_meshes(parts))
