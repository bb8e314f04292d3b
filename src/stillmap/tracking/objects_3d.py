"""Bird's-eye-view tracking of 3D recordings.

The dynamic end points above the ground are projected to the plane and tracked like planar scans;
the tracks get all beams of the object, and its height, back afterwards.
"""

import dataclasses

import numpy as np

from stillmap.core import se2
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Float, Float32, Index, Int64
from stillmap.core.arrays import take_rows, unique_cells
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.core.square_box import component_labels, neighbor_pairs
from stillmap.em import GroundMap
from stillmap.mapping.projection import DIRECTIONS, make_planar_recording
from stillmap.tracking import MovingObject, ObjectOptions, track_objects
from stillmap.tracking.clustering import MIN_P_DYNAMIC
from stillmap.tracking.displacement import drop_surface_parts, select_movers

_MIN_HEIGHT, _MAX_HEIGHT = 0.2, 3.0  # m above the ground
_COLUMN = 0.3  # m, edge of the columns whose connected components are segments
MIN_POINTS = 3  # of a segment: fewer are noise
_OUTLIERS = 2.0  # percent of the end points below the box, and above


def track_objects_3d(
    recording: Recording,
    poses: Float,
    p_static: Float32,
    ground: GroundMap,
    options: ObjectOptions,
    threads: int = 1,
) -> list[MovingObject]:
    """Detect and track the moving objects of a 3D recording, with the height of track and box.

    What goes nowhere, and whose place is never seen empty, is left out (`displacement.py`), and so
    are parts of static surfaces (`displacement.py`).

    Dynamic end points in connected columns above the ground are one segment. The nearest point in
    each direction, which a planar laser would see, is tracked; the other points of a segment
    belong to the object that owns most of its tracked ones.

    Args:
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1) of every beam.
        ground: height of the ground.
        options: see ObjectOptions.
        threads: number of threads; the result does not depend on it.
    """
    if not options.enabled:
        return []
    planar_poses = se2.project_to_plane(recording.T_map_sensor(poses))
    points, nearest, offset, segment, beam = _segment_scans(
        recording, poses, planar_poses, p_static, ground, threads
    )
    planar = make_planar_recording(recording, points, np.ones(len(nearest), np.bool_), offset)
    objects = track_objects(planar, planar_poses, p_static[nearest], options)
    owned = _collect_beams(objects, nearest, segment, beam)
    pairs = zip(objects, owned, strict=True)
    found_3d = [_add_height(mover, beams, recording, poses, p_static) for mover, beams in pairs]
    return select_movers(drop_surface_parts(found_3d, recording, p_static), recording, poses)


def _segment_scans(
    recording: Recording,
    poses: Float,
    planar_poses: Float,
    p_static: Float32,
    ground: GroundMap,
    threads: int,
) -> tuple[Float32, Index, Int64, Index, Index]:
    """Segments of dynamic end points above the ground.

    Returns:
        (N, 2) metres, the nearest in each direction, in the planar frame of each sensor; (N,) their
        beams; (T + 1,) scan t has offset[t]:offset[t + 1] of them; (K,) segment of each dynamic
        beam, rising from scan to scan; (K,) the numbers of these, rising.
    """
    T_map_sensor, n = recording.T_map_sensor(poses), recording.n_scans
    scratch, offset, segments = recording.scratch, np.zeros(n + 1, np.int64), 0
    points, nearest = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.intp, (), scratch)
    segment_of, beam = ArrayBuilder(np.int64, (), scratch), ArrayBuilder(np.intp, (), scratch)

    def process(t: int) -> tuple[Index, Index, Float, Index]:
        beams = recording.beams_of(t)
        dynamic = recording.hit[beams] & (p_static[beams] <= 1.0 - MIN_P_DYNAMIC)
        number, T = beams.start + np.flatnonzero(dynamic), T_map_sensor[t]
        end = recording.points.take(number, axis=0).astype(np.float64) @ T[:3, :3].T + T[:3, 3]
        above = end[:, 2] - ground.height_at(end[:, :2])
        kept = (above > _MIN_HEIGHT) & (above < _MAX_HEIGHT)
        number, end = number[kept], end[kept]
        segment = _connect_columns(end[:, :2])
        kept = np.bincount(segment, minlength=1)[segment] >= MIN_POINTS
        local = (end[kept, :2] - planar_poses[t, :2, 2]) @ planar_poses[t, :2, :2]
        return number[kept], segment[kept], local, _nearest_per_direction(local)

    scans = recording.iter_scans(range(n), p_static)
    for t, (number, segment, local, near) in enumerate(map_ordered(process, scans, threads)):
        points.append(local[near].astype(np.float32))
        nearest.append(number[near])
        segment_of.append(segments + segment)
        beam.append(number)
        segments += int(segment.max()) + 1 if len(segment) else 0
        offset[t + 1] = offset[t] + len(near)
    return points.finish(), nearest.finish(), offset, segment_of.finish(), beam.finish()


def _connect_columns(xy: Float) -> Index:
    """(n,) connected component of columns that each position (n, 2) lies in."""
    if not len(xy):
        return np.zeros(0, np.intp)
    cells, of = unique_cells(np.floor(xy / _COLUMN).astype(np.int64))
    return component_labels(neighbor_pairs(cells, 1.5), len(cells))[of]


def _nearest_per_direction(local: Float) -> Index:
    """Indices of the nearest of positions (n, 2) in each direction, in the order of directions."""
    direction = np.floor(np.arctan2(local[:, 1], local[:, 0]) * (DIRECTIONS / (2.0 * np.pi)))
    order = np.lexsort((np.linalg.norm(local, axis=1), direction))
    return order[np.diff(direction[order], prepend=-np.inf) > 0]


def _collect_beams(
    objects: list[MovingObject], nearest: Index, segment: Index, beam: Index
) -> list[Index]:
    """All beams of each object: its own, and those of the segments it owns most of.

    Args:
        objects: their beams are indices into `nearest`.
        nearest: tracked beams.
        segment: of each dynamic beam, rising from scan to scan.
        beam: their numbers, rising.
    """
    if not len(beam):
        return [nearest[mover.beams] for mover in objects]
    segment_of = segment[np.searchsorted(beam, nearest)]
    owner = np.full(len(nearest), len(objects), np.int64)
    for k, mover in enumerate(objects):
        owner[mover.beams] = k
    pairs, counts = np.unique(np.stack([segment_of, owner], axis=1), axis=0, return_counts=True)
    order = np.lexsort((-counts, pairs[:, 0]))
    first = np.diff(pairs[order, 0], prepend=-1) > 0
    of_segment = np.full(int(segment.max()) + 1, len(objects))
    of_segment[pairs[order[first], 0]] = pairs[order[first], 1]
    of_beam = of_segment[segment]
    rank = np.argsort(of_beam, kind="stable")
    ends = np.searchsorted(of_beam[rank], np.arange(len(objects) + 1))
    return [
        np.union1d(beam[rank[a:b]], nearest[mover.beams])
        for mover, a, b in zip(objects, ends[:-1], ends[1:], strict=True)
    ]


def _add_height(
    mover: MovingObject, beams: Index, recording: Recording, poses: Float, p_static: Float32
) -> MovingObject:
    """The object with all its beams, the height of its center in each scan, and of its box."""
    z = recording.end_points(beams, poses)[:, 2]
    at = np.searchsorted(mover.scan, recording.scans_of(beams)).clip(0, len(mover.scan) - 1)
    low, high = np.full(len(mover.scan), np.inf), np.full(len(mover.scan), -np.inf)
    np.minimum.at(low, at, z)
    np.maximum.at(high, at, z)
    center = 0.5 * (low + high)
    known = np.isfinite(center)
    center = np.interp(np.arange(len(center)), np.flatnonzero(known), center[known])
    bottom, top = np.percentile(z - center[at], [_OUTLIERS, 100.0 - _OUTLIERS])
    return dataclasses.replace(
        mover,
        beams=beams,
        z=center,
        size=(*mover.size[:2], float(top - bottom)),
        p_dynamic=float(1.0 - take_rows(p_static, beams).mean(dtype=np.float64)),
    )
