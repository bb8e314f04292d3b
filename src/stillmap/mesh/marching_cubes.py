"""Marching cubes over the tiles of a TSDF, and welding of their meshes."""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

import stillmap._core as _core
from stillmap.core.errors import import_extra
from stillmap.mesh.triangle_mesh import Mesh, concatenate_meshes
from stillmap.mesh.types import Int64

TILE = 64  # voxels along a tile, whole blocks
_MAX_STEP = 2.5  # voxels between distances within a cube: more, and two surfaces meet there


def occupied_tiles(volume: _core.TsdfVolume) -> Int64:
    """(N, 3) tiles with observed voxels, sorted."""
    return np.unique(volume.blocks() // blocks_per_tile(volume), axis=0)


def blocks_per_tile(volume: _core.TsdfVolume) -> int:
    """Blocks along the edge of a tile."""
    return TILE // volume.block_edge


def extract_tile(volume: _core.TsdfVolume, tile: Int64, min_weight: float) -> Mesh:
    """The surface within one tile, in metres; see `march_tile`."""
    mesh = march_tile(volume, tile, min_weight)
    if not len(mesh):
        return mesh
    mesh = weld(mesh)
    # vertices are counted from the center of voxel 0
    return Mesh((mesh.vertices + 0.5) * volume.voxel, mesh.faces)


def march_tile(volume: _core.TsdfVolume, tile: Int64, min_weight: float) -> Mesh:
    """The surface within one tile, in voxels; border vertices equal those of adjacent tiles.

    Cubes with an unobserved corner are skipped, and cubes in which distances step: there the back
    of one surface meets the front of another.

    Args:
        volume: signed distances and weights.
        tile: (3,) in tiles.
        min_weight: voxels need more weight than this.
    """
    measure: Any = import_extra("skimage.measure", "mesh.glb", "made", group="mesh")
    first = [int(c) * TILE for c in tile]
    metres, weight = volume.dense(first, [TILE + 1] * 3)
    known = weight > min_weight
    cubes = _reduce_cubes(np.logical_and, known)
    low = _reduce_cubes(np.minimum, np.where(known, metres, np.inf))
    high = _reduce_cubes(np.maximum, np.where(known, metres, -np.inf))
    cubes &= (low < 0.0) & (high >= 0.0) & (high - low <= _MAX_STEP * volume.voxel)
    if not cubes.any():
        return Mesh.empty()
    # scikit-image tests the mask at the last corner of a cube
    mask = np.zeros(metres.shape, np.bool_)
    mask[1:, 1:, 1:] = cubes
    found, faces, _, _ = measure.marching_cubes(
        np.where(known, metres, np.float32(1.0)), 0.0, mask=mask, gradient_direction="ascent"
    )
    vertices = found[:, ::-1].astype(np.float64) + first
    return Mesh(vertices, np.ascontiguousarray(faces, np.int32))


def _reduce_cubes(
    ufunc: Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]], values: NDArray[Any]
) -> NDArray[Any]:
    """Reduces the eight corners of each cube."""
    for axis in range(3):
        low = tuple(slice(None, -1) if d == axis else slice(None) for d in range(3))
        high = tuple(slice(1, None) if d == axis else slice(None) for d in range(3))
        values = ufunc(values[low], values[high])
    return values


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


def weld_meshes(parts: list[Mesh]) -> Mesh:
    """One mesh of the parts, their common border vertices merged."""
    return weld(concatenate_meshes(parts))


def remove_small_components(mesh: Mesh, min_area: float) -> Mesh:
    """Drops connected components with less than `min_area` square metres."""
    if not len(mesh):
        return mesh
    V = len(mesh.vertices)
    a, b, c = mesh.faces.T
    ones = np.ones(2 * len(mesh), np.int32)
    graph = coo_matrix((ones, (np.concatenate([a, b]), np.concatenate([b, c]))), (V, V))
    count, component = connected_components(graph, directed=False)
    areas = np.bincount(component[a], mesh.areas(), count)
    return mesh.select(areas[component[a]] >= min_area)
