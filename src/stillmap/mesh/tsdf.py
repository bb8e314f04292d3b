"""The static surface: TSDF integration of range images, weighted by P(static).

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH
1996. Tiles that no later scan reaches are extracted at once, so memory is that of the voxels around
the sensor, and of as many triangles as are asked for.
"""

from collections.abc import Callable, Iterable
from itertools import chain, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

import stillmap._core as _core
from stillmap.core.errors import import_extra
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.mesh.options import MeshOptions
from stillmap.mesh.range_image import Patch, ScanLayout, find_scan_layout, triangulate_scans
from stillmap.mesh.triangle_mesh import (
    Bool,
    Float,
    Float32,
    Index,
    Int32,
    Int64,
    Mesh,
    Tell,
    concatenate_meshes,
    no_tell,
    remove_small_components,
    simplification_error,
    simplify,
    simplify_to_budget,
    weld,
)
from stillmap.mesh.triangulation import range_std

_TILE_RADIUS = 2.9  # tile edges from a tile's center to the farthest corner around, and some slack
_SAMPLED_PATCHES = 8
_MIN_VOXEL, _MAX_VOXEL = 0.02, 0.2  # m; depth cameras are no more exact than the first
_NOISE_RATIO = 2.5  # voxel edge over the standard deviation of ranges, at least
_MAX_SPACING = 0.75  # voxels between rows that are used
_MAX_BYTES = 0.75e9  # of the voxels around the sensor
_AREA_CELL = 0.5  # m, cells by which surface area is estimated
_SAMPLED_BEAMS = 200_000
_SAMPLED_POSITIONS = 32  # of the sensor
_LAYERS = 2.5  # blocks across a surface
_BLOCK_EDGE, _BLOCK_BYTES = 8, 4200  # voxels along a block, and its size
_MIN_TRAVEL_SHARE = 0.2  # of the median range, between viewpoints
_MIN_TURN = 0.1  # rad, likewise
_SCANS_PER_PLACE = 2  # scans used from each viewpoint: one may be occluded by a mover
_SAMPLED_SCANS = 64  # of which the ranges are taken
_MIN_CELL = 1e-3  # m, of the cells by which viewpoints nearby are found
_AROUND = list(product((-1, 0, 1), repeat=3))


class PatchExtents(NamedTuple):
    """Bounding spheres of the patches of a recording, in their order.

    Attributes:
        position: (n, 3) metres, mean sensor position.
        range: (n,) metres, radius.
    """

    position: Float
    range: Float

    def is_complete(self, tiles: Int64, edge: float, done: int) -> Bool:
        """(N,) whether patches from number `done` on reach neither a tile nor its neighbors.

        Args:
            tiles: (N, 3).
            edge: metres, of a tile.
            done: number of patches that are integrated.
        """
        if done >= len(self.position):
            return np.ones(len(tiles), np.bool_)
        middle = (tiles + 0.5) * edge
        away = np.asarray(cKDTree(self.position[done:]).query(middle)[0], np.float64)
        return np.asarray(away > self.range[done:].max() + _TILE_RADIUS * edge)


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


def patch_extents(recording: Recording, poses: Float, layout: ScanLayout) -> PatchExtents:
    """Bounding spheres of the patches that these scans become.

    Args:
        recording: 3D.
        poses: (T, 4, 4) T_map_base.
        layout: the patches.
    """
    positions, ranges = [], []
    sensor = recording.T_map_sensor(poses)[:, :3, 3]
    for scans in layout.groups:
        position, far = sensor[scans].mean(axis=0), 0.0
        for t in scans:
            of = recording.beams_of(int(t))
            length = np.linalg.norm(recording.points[of][recording.hit[of]], axis=1)
            longest = float(np.max(length, initial=0.0, where=np.isfinite(length)))
            far = max(far, longest + float(np.linalg.norm(sensor[t] - position)))
        positions.append(position)
        ranges.append(far)
    return PatchExtents(np.array(positions).reshape(-1, 3), np.array(ranges))


def choose_resolution(
    recording: Recording,
    poses: Float,
    layout: ScanLayout,
    extents: PatchExtents,
    voxel_size: float | None = None,
) -> tuple[float, int]:
    """The edge of a voxel in metres, and the stride of rows and columns of range images.

    A voxel is as wide as the beam spacing on surfaces, and wider than range noise; larger where
    memory would exceed its limit. The stride keeps the spacing of beams below that.

    Args:
        recording: 3D, deskewed.
        poses: (T, 4, 4) T_map_base.
        layout: see `find_scan_layout`.
        extents: of the patches.
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
    voxel = voxel_size or max(wanted, min_voxel_size(recording, poses, extents))
    return voxel, max(int(_MAX_SPACING * voxel / spacing), 1) if spacing > 0.0 else 1


def beam_spacing(patch: Patch) -> float:
    """m, median distance between neighboring beams across the line of sight."""
    a, b, c = np.moveaxis(patch.points[patch.faces], 1, 0)
    sight = patch.origin[patch.faces[:, 0]] - a
    across = np.einsum("ni,ni->n", np.cross(b - a, c - a), sight) / np.linalg.norm(sight, axis=1)
    return float(np.median(np.sqrt(np.maximum(across, 0.0))))


def min_voxel_size(recording: Recording, poses: Float, extents: PatchExtents) -> float:
    """m, edge of a voxel so that those around the sensor fit into memory.

    Farther voxels have been extracted by then. Surface area is estimated by the cells in which
    beams end.
    """
    beams = np.arange(0, recording.n_beams, max(recording.n_beams // _SAMPLED_BEAMS, 1))
    beams = beams[recording.hit[beams]]
    ends = recording.end_points(beams, poses)
    cells = np.unique(np.floor(ends[np.isfinite(ends).all(axis=1)] / _AREA_CELL), axis=0)
    cells = cells * _AREA_CELL
    n = len(extents.position)
    sampled = np.unique(np.linspace(0, n - 1, _SAMPLED_POSITIONS).astype(np.intp))
    most = max(
        int(np.count_nonzero(np.linalg.norm(cells - at, axis=1) <= extents.range.max()))
        for at in extents.position[sampled]
    )
    bytes_of_one = _LAYERS * _BLOCK_BYTES * most * (_AREA_CELL / _BLOCK_EDGE) ** 2
    return float(np.sqrt(bytes_of_one / _MAX_BYTES))


Tile = tuple[int, ...]

_MIN_P_STATIC = 0.8  # product over a triangle's beams; below, a beam has little but its prior
TILE = 64  # voxels along a tile, whole blocks
_MAX_STEP = 2.5  # voxels between distances within a cube: more, and two surfaces meet there
_EXTRACT_BYTES = 48e6  # of new voxels after which complete tiles are extracted
_MERGE_FACES = 250_000  # triangles that wait to be merged
_SPARE = 2  # times the triangle budget, while the surface grows

_BELOW = [way for way in product((-1, 0), repeat=3) if any(way)]


class TsdfParameters(NamedTuple):
    """Parameters of TSDF integration; the defaults are those of the static surface.

    Attributes:
        truncation_front: voxels in front of a surface in which distances are stored.
        truncation_back: voxels behind it.
        min_weight: voxels need more weight than this.
        min_component_area: square metres; smaller connected components are dropped.
        error: metres of simplification; None: from the voxel size.
        max_faces: triangle budget, whatever the error.
    """

    truncation_front: float = 3.0
    truncation_back: float = 2.0
    min_weight: float = 0.0
    min_component_area: float = 0.05
    error: float | None = None
    max_faces: int = 200_000


class StreamingSurface:
    """A surface under construction: a TSDF around the sensor, and a mesh where it is complete."""

    def __init__(self, volume: _core.TsdfVolume, parameters: TsdfParameters) -> None:
        self.volume = volume
        self._parameters = parameters
        error = parameters.error
        self._error = simplification_error(volume.voxel) if error is None else error
        self._mesh = Mesh.empty()
        self._waiting = list[Mesh]()
        self._extracted = set[Tile]()
        self._held = 0.0

    def is_large(self) -> bool:
        """True if enough voxels were added since the last extraction for another one."""
        return self.volume.memory_bytes > self._held + _EXTRACT_BYTES

    def extract_complete(self, extents: PatchExtents, done: int) -> None:
        """Extracts tiles that patches from number `done` on do not reach; frees their voxels."""
        tiles = self._occupied_tiles()
        edge = TILE * self.volume.voxel
        self._extract(tiles[extents.is_complete(tiles, edge, done)])
        self._free_voxels()
        self._held = self.volume.memory_bytes

    def finish(self, tell: Tell = no_tell) -> Mesh:
        """The whole mesh within the budget; `tell` is called with the tiles done and the total."""
        o = self._parameters
        self._extract(self._occupied_tiles(), tell)
        self._merge()
        whole = remove_small_components(self._mesh, o.min_component_area)
        return simplify_to_budget(simplify(whole, self._error), self._error, o.max_faces)

    def _occupied_tiles(self) -> Int64:
        """(N, 3) tiles with observed voxels, sorted."""
        return np.unique(self.volume.blocks() // (TILE // self.volume.block_edge), axis=0)

    def _extract(self, tiles: Int64, tell: Tell = no_tell) -> None:
        for done, tile in enumerate(tiles, start=1):
            key = tuple(tile.tolist())
            if key not in self._extracted:
                self._extracted.add(key)
                part = extract_tile(self.volume, tile, self._parameters.min_weight)
                if len(part):
                    self._waiting.append(simplify(part, self._error))
            if sum(map(len, self._waiting)) > max(_MERGE_FACES, len(self._mesh)):
                self._merge()
            tell(done, len(tiles))

    def _free_voxels(self) -> None:
        """Frees extracted tiles but those that tiles below, not yet extracted, border on."""
        blocks = self.volume.blocks()
        tiles = blocks // (TILE // self.volume.block_edge)
        of_block = [tuple(tile) for tile in tiles.tolist()]
        there = set(of_block)
        gone = {
            (x, y, z)
            for x, y, z in there & self._extracted
            if not any((x + i, y + j, z + k) in there - self._extracted for i, j, k in _BELOW)
        }
        self.volume.remove_blocks(blocks[[key in gone for key in of_block]])

    def _merge(self) -> None:
        """Welds waiting tiles to the mesh; its border stays, as more tiles may join it."""
        whole = weld(concatenate_meshes([self._mesh, *self._waiting]))
        self._waiting = []
        if len(whole) > _MERGE_FACES:
            whole = simplify(whole, self._error)
            most = _SPARE * self._parameters.max_faces
            whole = simplify_to_budget(whole, self._error, most, whole_border=True)
        self._mesh = whole


def build_surface(
    recording: Recording,
    poses: Float,
    p_static: Float32,
    options: MeshOptions | None = None,
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
    options = options or MeshOptions()
    T = recording.T_map_sensor(poses)
    chosen = select_scans(T, recording.sensor, median_range(recording))
    layout = find_scan_layout(recording, chosen)
    extents = patch_extents(recording, poses, layout)
    voxel, stride = choose_resolution(recording, poses, layout, extents, options.voxel_size)
    layout = layout._replace(stride=stride)
    n = len(layout.groups)

    def weighted(make: Callable[[], Patch]) -> tuple[Patch, Float32]:
        patch = make()
        return patch, static_weights(patch, p_static)

    def patches() -> Iterable[tuple[Patch, Float32]]:
        made = map_ordered(weighted, triangulate_scans(recording, poses, layout), threads)
        for done, one in enumerate(made, start=1):
            yield one
            tell(done, 2 * n)

    def tell_later(done: int, total: int) -> None:
        tell(n + n * done // total, 2 * n)

    parameters = TsdfParameters(max_faces=options.max_faces)
    return integrate_patches(patches(), voxel, parameters, threads, tell_later, extents)


def integrate_patches(
    patches: Iterable[tuple[Patch, Float32]],
    voxel: float,
    parameters: TsdfParameters,
    threads: int = 1,
    tell: Tell = no_tell,
    extents: PatchExtents | None = None,
) -> Mesh:
    """One surface of many patches, in the frame of their points.

    Args:
        patches: each with the weights (m,) of its faces; those of weight 0 are left out.
        voxel: edge in metres.
        parameters: see TsdfParameters.
        threads: same result with any number.
        tell: called with the tiles done and the total, after integration.
        extents: of the patches; without them all voxels are kept to the end.
    """
    volume = _core.TsdfVolume(
        voxel,
        truncation_front=parameters.truncation_front * voxel,
        truncation_back=parameters.truncation_back * voxel,
    )
    surface = StreamingSurface(volume, parameters)
    for done, (patch, weight) in enumerate(patches, start=1):
        volume.integrate(
            patch.points, patch.origin, patch.standoff, patch.faces, weight, threads=threads
        )
        if extents is not None and surface.is_large():
            surface.extract_complete(extents, done)
    return surface.finish(tell)


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
    found, faces, _, _ = measure.marching_cubes(
        np.where(known, metres, np.float32(1.0)), 0.0, mask=mask, gradient_direction="ascent"
    )
    vertices = found[:, ::-1].astype(np.float64) + first
    mesh = weld(Mesh(vertices, np.ascontiguousarray(faces, np.int32)))
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
