"""The static surface: TSDF integration of range images, weighted by P(static).

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH
1996. Memory is bounded by the edge of a voxel, which is larger where much surface was seen.
"""

from collections.abc import Callable, Iterable
from itertools import chain, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.array_types import Float, Float32, Index, Int32, Int64
from stillmap.core.arrays import unique_cells
from stillmap.core.errors import import_extra
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.mesh import triangle_mesh
from stillmap.mesh.options import MeshOptions
from stillmap.mesh.range_image import Patch, ScanLayout, find_scan_layout, triangulate_scans
from stillmap.mesh.triangle_mesh import Mesh, Tell, no_tell
from stillmap.mesh.triangulation import range_std

_SAMPLED_PATCHES = 8
_MIN_VOXEL, _MAX_VOXEL = 0.02, 0.2  # m; depth cameras are no more exact than the first
_NOISE_RATIO = 2.5  # voxel edge over the standard deviation of ranges, at least
_MAX_SPACING = 0.75  # voxels between rows that are used
_MAX_BYTES = 0.75e9  # of the voxels
_AREA_CELL = 0.5  # m, cells by which surface area is estimated
_SAMPLED_BEAMS = 200_000
_LAYERS = 2.5  # blocks across a surface
_BLOCK_EDGE, _BLOCK_BYTES = 8, 4200  # voxels along a block, and its size
_MIN_TRAVEL_SHARE = 0.2  # of the median range, between viewpoints
_MIN_TURN = 0.1  # rad, likewise
_SCANS_PER_PLACE = 2  # scans used from each viewpoint: one may be occluded by a mover
_SAMPLED_SCANS = 64  # of which the ranges are taken
_MIN_CELL = 1e-3  # m, of the cells by which viewpoints nearby are found
_AROUND = list(product((-1, 0, 1), repeat=3))


def median_range(recording: Recording) -> float:
    """Median range in metres of the hits of some scans; 0 where there are none."""
    n = recording.n_scans
    sampled = np.unique(np.linspace(0, n - 1, min(n, _SAMPLED_SCANS)).astype(np.intp))
    parts = [recording.points[b][recording.hit[b]] for b in map(recording.beams_of, sampled)]
    ranges = np.concatenate([np.zeros(0), *(np.linalg.norm(part, axis=1) for part in parts)])
    ranges = ranges[np.isfinite(ranges)]
    return float(np.median(ranges)) if len(ranges) else 0.0


def select_scans(T_map_sensor: Float, sensor: Int32, range: float) -> Index:
    """The first `_SCANS_PER_PLACE` scans from each viewpoint.

    Args:
        T_map_sensor: (T, 4, 4).
        sensor: (T,) sensor of each scan.
        range: metres, median.
    """
    position, R = T_map_sensor[:, :3, 3], T_map_sensor[:, :3, :3]
    travel = _MIN_TRAVEL_SHARE * range
    # by cells, so that each scan is compared only with those around
    cells = np.floor(position / max(travel, _MIN_CELL)).astype(np.int64).tolist()
    known: dict[tuple[int, ...], list[int]] = {}
    chosen = list[int]()
    for t, (x, y, z) in enumerate(cells):
        mine = int(sensor[t])
        around = [known.get((mine, x + i, y + j, z + k), ()) for i, j, k in _AROUND]
        before = np.fromiter(chain.from_iterable(around), np.intp)
        near = before[np.linalg.norm(position[before] - position[t], axis=1) < travel]
        cosine = 0.5 * (np.einsum("nij,ij->n", R[near], R[t]) - 1.0)
        if np.count_nonzero(cosine > np.cos(_MIN_TURN)) < _SCANS_PER_PLACE:
            chosen.append(t)
            known.setdefault((mine, x, y, z), []).append(t)
    return np.array(chosen, np.intp)


def choose_resolution(
    recording: Recording, poses: Float, layout: ScanLayout, voxel_size: float | None
) -> tuple[float, int]:
    """The edge of a voxel in metres, and the stride of rows and columns of range images.

    A voxel is as wide as the beam spacing on surfaces, and wider than range noise; larger where
    memory would exceed its limit. The stride keeps the spacing of beams below that.

    Args:
        recording: 3D, deskewed.
        poses: (T, 4, 4) T_map_base.
        layout: see `find_scan_layout`.
        voxel_size: metres; None: chosen.
    """
    groups = layout.groups
    n = min(len(groups), _SAMPLED_PATCHES)
    sampled = np.unique(np.linspace(0, len(groups) - 1, n).astype(np.intp))
    some = layout._replace(groups=[groups[k] for k in sampled])
    patches = [make() for make in triangulate_scans(recording, poses, some)]
    patches = [one for one in patches if len(one.faces)]
    if not patches:
        return voxel_size or _MAX_VOXEL, 1
    spacing = float(np.median([beam_spacing(one) for one in patches]))
    ranges = [np.linalg.norm(one.points - one.origin, axis=1) for one in patches]
    noises = [range_std(away, one.faces) for away, one in zip(ranges, patches, strict=True)]
    noise = float(np.median(noises))
    wanted = float(np.clip(max(spacing, _NOISE_RATIO * noise), _MIN_VOXEL, _MAX_VOXEL))
    voxel = voxel_size or max(wanted, min_voxel_size(recording, poses))
    return voxel, max(int(_MAX_SPACING * voxel / spacing), 1) if spacing > 0.0 else 1


def beam_spacing(patch: Patch) -> float:
    """m, median distance between neighboring beams across the line of sight."""
    a, b, c = np.moveaxis(patch.points[patch.faces], 1, 0)
    sight = patch.origin[patch.faces[:, 0]] - a
    across = np.einsum("ni,ni->n", np.cross(b - a, c - a), sight) / np.linalg.norm(sight, axis=1)
    return float(np.median(np.sqrt(np.maximum(across, 0.0))))


def min_voxel_size(recording: Recording, poses: Float) -> float:
    """m, edge of a voxel so that all of them fit into memory.

    Surface area is estimated by the cells in which beams end.
    """
    beams = np.arange(0, recording.n_beams, max(recording.n_beams // _SAMPLED_BEAMS, 1))
    ends = recording.end_points(beams[recording.hit[beams]], poses)
    ends = ends[np.isfinite(ends).all(axis=1)]
    cells, _ = unique_cells(np.floor(ends / _AREA_CELL).astype(np.int64))
    bytes_of_one = _LAYERS * _BLOCK_BYTES * len(cells) * (_AREA_CELL / _BLOCK_EDGE) ** 2
    return float(np.sqrt(bytes_of_one / _MAX_BYTES))


_MIN_P_STATIC = 0.8  # product over a triangle's beams; below, a beam has little but its prior
TILE = 64  # voxels along a tile, whole blocks
_MAX_STEP = 2.5  # voxels between distances within a cube: more, and two surfaces meet there
_TRUNCATION = 3.0, 2.0  # voxels in front of a surface and behind it
_MIN_AREA = 0.05  # m2: smaller connected components are dropped


def build_surface(
    recording: Recording,
    poses: Float,
    p_static: Float32,
    options: MeshOptions,
    threads: int = 1,
    tell: Tell = no_tell,
) -> Mesh:
    """The static surface in the map frame.

    Args:
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(static) of each beam, NaN where unknown.
        options: `voxel_size` and `max_faces`.
        threads: same result with any number.
        tell: called with the work done and the total.
    """
    T = recording.T_map_sensor(poses)
    chosen = select_scans(T, recording.sensor, median_range(recording))
    layout = find_scan_layout(recording, chosen)
    voxel, stride = choose_resolution(recording, poses, layout, options.voxel_size)
    layout = layout._replace(stride=stride)
    n = len(layout.groups)

    def weighted(make: Callable[[], Patch]) -> tuple[Patch, Float32]:
        patch = make()
        return patch, static_weights(patch, p_static)

    patches = map_ordered(weighted, triangulate_scans(recording, poses, layout), threads)
    return integrate_patches(
        patches, n, voxel, max_faces=options.max_faces, threads=threads, tell=tell
    )


def integrate_patches(
    patches: Iterable[tuple[Patch, Float32]],
    n: int,
    voxel: float,
    *,
    truncation: tuple[float, float] = _TRUNCATION,
    min_weight: float = 0.0,
    min_area: float = _MIN_AREA,
    max_faces: int,
    threads: int = 1,
    tell: Tell = no_tell,
) -> Mesh:
    """One surface of many patches, in the frame of their points.

    Args:
        patches: each with the weights (m,) of its faces; those of weight 0 are left out.
        n: number of patches.
        voxel: edge in metres.
        truncation: voxels in front of and behind a surface in which distances are stored.
        min_weight: voxels need more weight than this.
        min_area: square metres; smaller connected components are dropped.
        max_faces: triangle budget.
        threads: same result with any number.
        tell: called with the work done and the total.
    """
    front, back = (voxel * share for share in truncation)
    volume = _core.TsdfVolume(voxel, truncation_front=front, truncation_back=back)
    for done, (patch, weight) in enumerate(patches, start=1):
        at = (patch.points, patch.origin, patch.standoff)
        volume.integrate(*at, patch.faces, weight, threads=threads)
        tell(done, 2 * n)
    error = triangle_mesh.simplification_error(voxel)
    tiles, _ = unique_cells(volume.blocks() // (TILE // volume.block_edge))
    parts = list[Mesh]()
    for done, tile in enumerate(tiles, start=1):
        parts.append(triangle_mesh.simplify(extract_tile(volume, tile, min_weight), error))
        tell(n + n * done // len(tiles), 2 * n)
    del volume  # frees the voxels before the mesh grows
    welded = triangle_mesh.weld(triangle_mesh.concatenate_meshes(parts))
    mesh = triangle_mesh.remove_small_components(welded, min_area)
    return triangle_mesh.simplify_to_budget(triangle_mesh.simplify(mesh, error), error, max_faces)


def static_weights(patch: Patch, p_static: Float32) -> Float32:
    """(m,) weights of a patch's faces: the product of P(static) of the three beams, thresholded."""
    p = np.nan_to_num(p_static[patch.beam].astype(np.float64), nan=0.0)
    a, b, c = patch.faces.T
    weight = p[a] * p[b] * p[c]
    return np.where(weight >= _MIN_P_STATIC, weight, 0.0).astype(np.float32)


def extract_tile(volume: _core.TsdfVolume, tile: Int64, min_weight: float) -> Mesh:
    """The surface within one tile, in metres; border vertices equal those of adjacent tiles.

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
    values = np.where(known, metres, np.float32(1.0))
    found, faces, *_ = measure.marching_cubes(values, 0.0, mask=mask, gradient_direction="ascent")
    vertices = found[:, ::-1].astype(np.float64) + first
    mesh = triangle_mesh.weld(Mesh(vertices, np.ascontiguousarray(faces, np.int32)))
    # vertices are counted from the center of voxel 0
    return Mesh((mesh.vertices + 0.5) * volume.voxel, mesh.faces)


def _reduce_cubes(
    ufunc: Callable[[NDArray[Any], NDArray[Any]], NDArray[Any]], values: NDArray[Any]
) -> NDArray[Any]:
    """Reduces the eight corners of each cube."""
    for axis in range(3):
        low = tuple(slice(None, -1) if d == axis else slice(None) for d in range(3))
        high = tuple(slice(1, None) if d == axis else slice(None) for d in range(3))
        values = ufunc(values[low], values[high])
    return values
