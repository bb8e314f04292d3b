"""Choice of the scans of a surface and of its voxels: by beam spacing, range noise and memory."""

from itertools import chain, product
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from stillmap.core.recording import Recording
from stillmap.mesh.range_image import Patch, ScanLayout, triangulate_scans
from stillmap.mesh.triangulation import range_std
from stillmap.mesh.types import Bool, Float, Index, Int32, Int64

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
