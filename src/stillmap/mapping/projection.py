"""Projection of a 3D recording onto the plane.

Obstacles are what stands in a band of heights above the ground. A beam that ends within the band is
a hit; a beam that runs through it shows free space up to where it leaves it. So each sweep becomes
a planar scan, and all 2D steps apply.
"""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from stillmap import em
from stillmap.core import se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.arrays import finite_rows, first_index_per_group, unique_cells
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.em import GroundMap

Float = NDArray[np.float64]
Index = NDArray[np.intp]

DIRECTIONS = 2048  # of the beams of a scan; at 50 m 15 cm apart

_SENSOR_MARGIN = 0.05  # m by which the band reaches above the sensor


def make_planar_recording(
    recording: Recording,
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    offset: NDArray[np.int64],
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
    low, high = band
    top = max(high, ground.sensor_height + _SENSOR_MARGIN)
    scratch, offset = recording.scratch, np.zeros(recording.n_scans + 1, np.int64)
    ends, hits = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.bool_, (), scratch)
    numbers = ArrayBuilder(np.intp, (), scratch)

    def process(t: int) -> tuple[NDArray[np.float32], NDArray[np.bool_], Index]:
        beams = recording.beams_of(t)
        xy, hit, number = _project_scan(
            recording.points[beams], recording.hit[beams], T_map_sensor[t], ground,
            (low, high, top), cell, open_space,
        )  # fmt: skip
        local = (xy - planar_poses[t, :2, 2]) @ planar_poses[t, :2, :2]
        return local.astype(np.float32), hit, beams.start + number

    scans = recording.iter_scans(range(recording.n_scans))
    for t, (local, hit, number) in enumerate(map_ordered(process, scans, threads)):
        ends.append(local)
        hits.append(hit)
        numbers.append(number)
        offset[t + 1] = offset[t] + len(number)
    flat = make_planar_recording(recording, ends.finish(), hits.finish(), offset)
    return PlanarProjection(flat, planar_poses, numbers.finish())


def _project_scan(
    points: NDArray[np.float32],
    hit: NDArray[np.bool_],
    T: Float,
    ground: GroundMap,
    heights: tuple[float, float, float],
    cell: float,
    open_space: bool,
) -> tuple[Float, NDArray[np.bool_], Index]:
    """End points (n, 2) in the map frame, whether they are hits, and their beams."""
    low, high, top = heights
    at = np.flatnonzero(finite_rows(points) & (hit | open_space))
    end: Float = points.take(at, axis=0).astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    start = T[:3, 3] - [0.0, 0.0, ground.height_at(T[None, :2, 3])[0]]
    above: Float = end[:, 2] - ground.height_at(end[:, :2])
    is_obstacle = hit[at] & (above >= low) & (above <= high)
    share = _share_in_band(start[2], above, low, top)
    beam = (end[:, :2] - T[:2, 3]) * share[:, None]
    length = np.sqrt(np.square(beam[:, 0]) + np.square(beam[:, 1]))
    direction = np.floor(np.arctan2(beam[:, 1], beam[:, 0]) * (DIRECTIONS / (2.0 * np.pi)))
    direction = direction.astype(np.int64) % DIRECTIONS
    kept = _select_beams(direction, length, is_obstacle, cell)
    return T[:2, 3] + beam[kept], is_obstacle[kept], at[kept]


def _select_beams(
    direction: Index, length: Float, is_obstacle: NDArray[np.bool_], cell: float
) -> Index:
    """Indices of the first hit per direction and cell, and of the longest other beam per direction.

    Of equals the first. Sorted by direction, the other beam first, then the hits by distance.
    """
    rank = np.where(is_obstacle, 1 + np.floor(length / cell).astype(np.int64), 0)
    group = direction * (rank.max(initial=0) + 1) + rank
    hits, others = np.flatnonzero(is_obstacle), np.flatnonzero(~is_obstacle)
    hits = hits[first_index_per_group(group[hits])]
    longest = np.zeros(DIRECTIONS)
    np.maximum.at(longest, direction[others], length[others])
    others = others[length[others] == longest[direction[others]]]
    others = others[first_index_per_group(direction[others])]
    kept = np.concatenate([others, hits])
    return np.asarray(kept[np.argsort(group[kept])])


def _share_in_band(start: float, above: Float, low: float, top: float) -> Float:
    """(n,) share of its length after which a beam leaves the band; heights above the ground."""
    rise = above - start
    with np.errstate(divide="ignore", invalid="ignore"):
        down = np.where(above < low, (start - low) / -rise, 1.0)
        up = np.where(above > top, (top - start) / rise, 1.0)
    return np.clip(np.minimum(down, up), 0.0, 1.0)


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
