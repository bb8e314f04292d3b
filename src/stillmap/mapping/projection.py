"""Projection of a 3D recording onto the plane.

Obstacles are what stands in a band of heights above the ground. A beam that ends within the band is
a hit; a beam that runs through it shows free space up to where it leaves it. So each sweep becomes
a planar scan, and all 2D steps apply.
"""

from dataclasses import dataclass, replace
from functools import partial

import numpy as np

import stillmap._core as _core
from stillmap import em
from stillmap.core import se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.arrays import unique_cells
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.core.square_box import adjacent_pairs, component_labels
from stillmap.core.tiles import tiles_of
from stillmap.em import GroundMap, OccupancyMap
from stillmap.em.types import GROUND_SQUARE

DIRECTIONS = 2048  # of the beams of a scan; at 50 m 15 cm apart

_SENSOR_MARGIN = 0.05  # m by which the band reaches above the sensor


def make_planar_recording(
    recording: Recording, points: Float32, hit: Bool, offset: Int64
) -> Recording:
    """The scans of a 3D recording with planar beams, of one sensor at the robot's center.

    Args:
        recording: 3D, T scans.
        points, hit, offset: (N, 2), (N,), (T + 1,); see Recording.
    """
    return replace(
        recording,
        points=points,
        hit=hit,
        offset=offset,
        T_base_sensor=np.eye(3)[None],
        sensor=np.zeros(recording.n_scans, np.int32),
        T_odom_base=None,
        T_recorded_base=None,
        beam_time=None,
        images=None,
    )


@dataclass(frozen=True, eq=False)
class PlanarProjection:
    """The planar recording of a 3D one, T scans with N beams.

    Attributes:
        recording: 2D, of the same scans. Beams that did not end in the band are misses up to where
            they left it.
        poses: (T, 3, 3) T_map_sensor in the plane.
        beam: (N,) beam of the 3D recording.
    """

    recording: Recording
    poses: Float
    beam: Index


def project_to_plane(
    recording: Recording,
    poses: Float,
    ground: GroundMap,
    band: tuple[float, float],
    cell: float,
    open_space: bool,
    threads: int = 1,
) -> PlanarProjection:
    """Project the beams of a 3D recording that pass the band above the ground.

    Per direction the longest beam without a hit in the band is kept, and the first hit per cell.

    Args:
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base.
        ground: height of the ground.
        band: m above the ground, minimum and maximum height of obstacles.
        cell: m, edge of a map cell.
        open_space: whether beams without a return show free space.
        threads: number of threads; the result does not depend on it.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    planar_poses = se2.project_to_plane(T_map_sensor)
    corner_x, corner_y = ground.corner.tolist()
    project = partial(
        _core.project_scan,
        height=np.ascontiguousarray(ground.height),
        corner_x=corner_x,
        corner_y=corner_y,
        edge=GROUND_SQUARE,
        low=band[0],
        high=band[1],
        top=max(band[1], ground.sensor_height + _SENSOR_MARGIN),
        cell=cell,
        directions=DIRECTIONS,
        open_space=open_space,
    )
    scratch, offset = recording.scratch, np.zeros(recording.n_scans + 1, np.int64)
    ends, hits = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.bool_, (), scratch)
    numbers = ArrayBuilder(np.intp, (), scratch)

    def process(t: int) -> tuple[Float32, Bool, Index]:
        beams = recording.beams_of(t)
        xy, hit, number = project(recording.points[beams], recording.hit[beams], T_map_sensor[t])
        local = (xy - planar_poses[t, :2, 2]) @ planar_poses[t, :2, :2]
        return local.astype(np.float32), hit.view(np.bool_), beams.start + number

    scans = recording.iter_scans(range(recording.n_scans))
    for t, (local, hit, number) in enumerate(map_ordered(process, scans, threads)):
        ends.append(local)
        hits.append(hit)
        numbers.append(number)
        offset[t + 1] = offset[t] + len(number)
    flat = make_planar_recording(recording, ends.finish(), hits.finish(), offset)
    return PlanarProjection(flat, planar_poses, numbers.finish())


def project_cells(
    known: em.CellProbabilities, ground: GroundMap, band: tuple[float, float], cell: float
) -> em.CellProbabilities:
    """Occupancy of columns: that of the most probably occupied voxel within the band.

    Args:
        known: of (K, 3) voxels.
        ground: height of the ground.
        band: m above it, minimum and maximum height of obstacles.
        cell: m, edge of a voxel.
    """
    middle = np.asarray((known.cells + 0.5) * cell, np.float64)
    above = middle[:, 2] - ground.height_at(middle[:, :2])
    inside = (above >= band[0]) & (above <= band[1])
    columns, of = unique_cells(known.cells[inside, :2])
    p = np.zeros(len(columns), np.float32)
    np.maximum.at(p, of, known.p_occupied[inside])
    return em.CellProbabilities(columns, p, known.free_prior)


_OCCUPIED = 0.65  # P(occupied) above which map_server and nav2 take a cell for occupied
_SMALL = 0.3  # m, extent along either axis below which a piece is small
_AREA = 100.0  # m2


def count_small_pieces(occupancy: OccupancyMap) -> float | None:
    """Pieces smaller than 0.3 m per 100 m2 of known area; None where nothing is occupied.

    A piece is a component of occupied cells, of which all eight neighbours are connected.
    """
    known, occupied = 0, [np.empty((0, 2), np.int64)]
    for (rows, columns), part in tiles_of(occupancy.p_occupied):
        known += int(np.count_nonzero(~np.isnan(part)))
        corner = np.array([rows.start or 0, columns.start or 0])
        occupied.append(np.argwhere(part > _OCCUPIED) + corner)
    cells = np.concatenate(occupied)
    if not len(cells):
        return None
    piece = component_labels(adjacent_pairs(cells), len(cells))
    low = np.full((piece.max() + 1, 2), np.iinfo(np.int64).max)
    high = np.full_like(low, np.iinfo(np.int64).min)
    np.minimum.at(low, piece, cells)
    np.maximum.at(high, piece, cells)
    extent = (high - low + 1).max(axis=1) * occupancy.resolution
    small = int(np.count_nonzero(extent < _SMALL))
    return _AREA * small / (known * occupancy.resolution**2)
