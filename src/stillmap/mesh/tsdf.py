"""The static surface: TSDF integration of range images, weighted by P(static).

Curless and Levoy, "A Volumetric Method for Building Complex Models from Range Images", SIGGRAPH
1996. Tiles that no later scan reaches are extracted at once, so memory is that of the voxels around
the sensor, and of as many triangles as are asked for.
"""

from collections.abc import Callable, Iterable
from functools import partial
from itertools import chain, product
from typing import NamedTuple

import numpy as np

import stillmap._core as _core
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.mesh import marching_cubes
from stillmap.mesh.marching_cubes import remove_small_components, weld_meshes
from stillmap.mesh.options import MeshOptions
from stillmap.mesh.range_image import Patch, find_scan_layout, triangulate_scans
from stillmap.mesh.resolution import PatchExtents, choose_resolution, patch_extents
from stillmap.mesh.simplification import simplification_error, simplify, simplify_to_budget
from stillmap.mesh.triangle_mesh import Mesh
from stillmap.mesh.types import Float, Float32, Index, Int32, Int64, Tell

Tile = tuple[int, int, int]

_MIN_P_STATIC = 0.5  # product over a triangle's beams below which it is left out
_MIN_TRAVEL_SHARE = 0.2  # of the median range, between viewpoints
_MIN_TURN = 0.1  # rad, likewise
_SCANS_PER_PLACE = 2  # scans used from each viewpoint: one may be occluded by a mover
_SAMPLED_SCANS = 64  # of which the ranges are taken
_MIN_CELL = 1e-3  # m, of the cells by which viewpoints nearby are found
_EXTRACT_BYTES = 48e6  # of new voxels after which complete tiles are extracted
_MERGE_FACES = 250_000  # triangles that wait to be merged
_SPARE = 2  # times the triangle budget, while the surface grows

_AROUND = list(product((-1, 0, 1), repeat=3))
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
        """Whether enough voxels were added since the last extraction for another one."""
        return self.volume.memory_bytes > self._held + _EXTRACT_BYTES

    def extract_complete(self, extents: PatchExtents, done: int) -> None:
        """Extracts tiles that patches from number `done` on do not reach; frees their voxels."""
        tiles = marching_cubes.occupied_tiles(self.volume)
        edge = marching_cubes.TILE * self.volume.voxel
        self._extract(tiles[extents.is_complete(tiles, edge, done)])
        self._free_voxels()
        self._held = self.volume.memory_bytes

    def finish(self, tell: Tell | None = None) -> Mesh:
        """The whole mesh within the budget; `tell` is called with the tiles done and the total."""
        o = self._parameters
        self._extract(marching_cubes.occupied_tiles(self.volume), tell)
        self._merge()
        whole = remove_small_components(self._mesh, o.min_component_area)
        return simplify_to_budget(simplify(whole, self._error), self._error, o.max_faces)

    def _extract(self, tiles: Int64, tell: Tell | None = None) -> None:
        for done, tile in enumerate(tiles, start=1):
            key = _key(tile)
            if key not in self._extracted:
                self._extracted.add(key)
                part = marching_cubes.extract_tile(self.volume, tile, self._parameters.min_weight)
                if len(part):
                    self._waiting.append(simplify(part, self._error))
            if sum(map(len, self._waiting)) > max(_MERGE_FACES, len(self._mesh)):
                self._merge()
            if tell:
                tell(done, len(tiles))

    def _free_voxels(self) -> None:
        """Frees extracted tiles but those that tiles below, not yet extracted, border on."""
        blocks = self.volume.blocks()
        of_block = [_key(tile) for tile in blocks // marching_cubes.blocks_per_tile(self.volume)]
        there = set(of_block)
        gone = {
            (x, y, z)
            for x, y, z in there & self._extracted
            if not any((x + i, y + j, z + k) in there - self._extracted for i, j, k in _BELOW)
        }
        self.volume.remove_blocks(blocks[[key in gone for key in of_block]])

    def _merge(self) -> None:
        """Welds waiting tiles to the mesh; its border stays, as more tiles may join it."""
        whole = weld_meshes([self._mesh, *self._waiting])
        self._waiting = []
        if len(whole) > _MERGE_FACES:
            whole = simplify(whole, self._error)
            most = _SPARE * self._parameters.max_faces
            whole = simplify_to_budget(whole, self._error, most, whole_border=True)
        self._mesh = whole


def _key(tile: Int64) -> Tile:
    x, y, z = tile.tolist()
    return x, y, z


def build_surface(
    recording: Recording,
    poses: Float,
    p_static: Float32,
    options: MeshOptions | None = None,
    threads: int = 1,
    tell: Tell | None = None,
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
    n, done = len(layout.groups), 0

    def weighted(make: Callable[[], Patch]) -> tuple[Patch, Float32]:
        patch = make()
        return patch, static_weights(patch, p_static)

    def patches() -> Iterable[tuple[Patch, Float32]]:
        nonlocal done
        for one in map_ordered(weighted, triangulate_scans(recording, poses, layout), threads):
            yield one
            done += 1
            if tell:
                tell(done, 2 * n)

    later = partial(_tell_second_half, tell, n) if tell else None
    parameters = TsdfParameters(max_faces=options.max_faces)
    return integrate_patches(patches(), voxel, parameters, threads, later, extents)


def _tell_second_half(tell: Tell, n: int, done: int, total: int) -> None:
    tell(n + n * done // total, 2 * n)


def integrate_patches(
    patches: Iterable[tuple[Patch, Float32]],
    voxel: float,
    parameters: TsdfParameters,
    threads: int = 1,
    tell: Tell | None = None,
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
