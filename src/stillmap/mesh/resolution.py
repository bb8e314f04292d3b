"""How fine a surface can be told: by how far beams lie apart, and how exact ranges are.

How far patches go, and what later ones do not come to any more.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from stillmap.core.recording import Recording
from stillmap.mesh.options import SurfaceOptions
from stillmap.mesh.range_image import Patch, ScanLayout, triangulate_scans
from stillmap.mesh.triangulation import range_std

Float = NDArray[np.float64]

_BESIDE = 2.9  # tiles from the middle of one to the farthest corner of those around, and a bit


class PatchExtents(NamedTuple):
    """How far the patches of a recording go, in their order.

    Attributes:
        place: (n, 3) metres.
        range: (n,) metres from there, in which all of a patch lies.
    """

    position: Float
    range: Float

    def is_complete(self, tiles: NDArray[np.int64], edge: float, done: int) -> NDArray[np.bool_]:
        """(N,) which tiles, metres along an edge, and none beside them, later patches come to."""
        if done >= len(self.position):
            return np.ones(len(tiles), np.bool_)
        middle = (tiles + 0.5) * edge
        away = np.asarray(cKDTree(self.position[done:]).query(middle)[0], np.float64)
        return np.asarray(away > self.range[done:].max() + _BESIDE * edge)


def patch_extents(seen: Recording, poses: Float, order: ScanLayout) -> PatchExtents:
    """How far the patches that come of these scans go.

    Args:
        seen: 3D.
        poses: (T, 4, 4) T_map_base.
        order: of the patches.
    """
    places, ranges = [], []
    sensor = seen.T_map_sensor(poses)[:, :3, 3]
    for scans in order.groups:
        place, far = sensor[scans].mean(axis=0), 0.0
        for t in scans:
            of = seen.beams_of(int(t))
            length = np.linalg.norm(seen.points[of][seen.hit[of]], axis=1)
            longest = float(np.max(length, initial=0.0, where=np.isfinite(length)))
            far = max(far, longest + float(np.linalg.norm(sensor[t] - place)))
        places.append(place)
        ranges.append(far)
    return PatchExtents(np.array(places).reshape(-1, 3), np.array(ranges))


_ASKED = 8  # patches

_FINEST, _COARSEST = 0.02, 0.2  # m; what depth cameras see in a room is no more exact

_NOISES = 2.5  # standard deviations of ranges that a voxel is wide, at least

_NEAR = 0.75  # voxels between rows that are used, at most

_MEMORY = 0.75e9  # bytes for the voxels about the sensor

_CELL = 0.5  # m, of squares by which the area is measured

_BEAMS = 200_000  # by which it is

_PLACES = 32  # where the sensor was

_LAYERS = 2.5  # blocks behind each other across a surface

_EDGE, _BLOCK = 8, 4200  # voxels along a block, and its bytes


def choose_resolution(
    seen: Recording, poses: Float, order: ScanLayout, reach: PatchExtents, o: SurfaceOptions
) -> tuple[float, int]:
    """m, the edge of a voxel, and of how many rows and columns of pictures one is enough.

    The voxel is as wide as beams lie apart where they end, and wider than noise; larger where that
    would take too much memory, or as the options say. Beams are to lie as near to one another as
    that.

    Args:
        seen: 3D, without motion during its scans.
        poses: (T, 4, 4) T_map_base.
        order: see `order_of`.
        reach: of the patches, see `reach_of`.
        o: see SurfaceOptions.
    """
    groups = order.groups
    asked = np.unique(np.linspace(0, len(groups) - 1, min(len(groups), _ASKED)).astype(np.intp))
    some = order._replace(groups=[groups[k] for k in asked])
    parts = [make() for make in triangulate_scans(seen, poses, some, o)]
    parts = [one for one in parts if len(one.faces)]
    if not parts:
        return o.voxel or _COARSEST, 1
    apart = float(np.median([beam_spacing(one) for one in parts]))
    noise = float(np.median([patch_range_std(one) for one in parts]))
    wanted = float(np.clip(max(apart, _NOISES * noise), _FINEST, _COARSEST))
    voxel = o.voxel or max(wanted, min_voxel_size(seen, poses, reach))
    return voxel, max(int(_NEAR * voxel / apart), 1) if apart > 0.0 else 1


def beam_spacing(patch: Patch) -> float:
    """m, median distance between neighbouring beams across the line of sight."""
    a, b, c = np.moveaxis(patch.points[patch.faces], 1, 0)
    sight = patch.origin[patch.faces[:, 0]] - a
    across = np.einsum("ni,ni->n", np.cross(b - a, c - a), sight) / np.linalg.norm(sight, axis=1)
    return float(np.median(np.sqrt(np.maximum(across, 0.0))))


def patch_range_std(patch: Patch) -> float:
    """m, standard deviation of its ranges."""
    return range_std(np.linalg.norm(patch.points - patch.origin, axis=1), patch.faces)


def min_voxel_size(seen: Recording, poses: Float, reach: PatchExtents) -> float:
    """m, the edge of voxels that fit into memory, by the cells in which beams end.

    Those count that are as near to where the sensor is at some time as it sees: voxels farther
    away are triangles by then.
    """
    beams = np.arange(0, seen.n_beams, max(seen.n_beams // _BEAMS, 1))
    beams = beams[seen.hit[beams]]
    ends = seen.end_points(beams, poses)
    cells = np.unique(np.floor(ends[np.isfinite(ends).all(axis=1)] / _CELL), axis=0) * _CELL
    asked = np.unique(np.linspace(0, len(reach.position) - 1, _PLACES).astype(np.intp))
    most = max(
        int(np.count_nonzero(np.linalg.norm(cells - place, axis=1) <= reach.range.max()))
        for place in reach.position[asked]
    )
    bytes_of_one = _LAYERS * _BLOCK * most * (_CELL / _EDGE) ** 2
    return float(np.sqrt(bytes_of_one / _MEMORY))
