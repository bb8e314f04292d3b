"""What moves in a 3D recording: seen from above, followed on the ground, given its height back."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.arrays import ArrayBuilder, take_rows
from stillmap.core.parallel import map_ordered
from stillmap.core.recording import Recording
from stillmap.em import GroundMap
from stillmap.mapping.projection import make_planar_recording
from stillmap.tracking import MovingObject, ObjectOptions, track_objects

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_LOWEST, _HIGHEST = 0.2, 3.0  # m above the ground, between which things move
_DIRECTIONS = 2048  # in which the nearest end point of a scan is looked for
_COLUMN = 0.3  # m, edge of the columns that neighbouring end points fill
_FEWEST = 3  # end points of a part: fewer are noise
_EDGE = 2.0  # percent of the end points that lie lower than a thing, or higher


def track_objects_3d(
    recording: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    ground: GroundMap,
    options: ObjectOptions,
    threads: int = 1,
) -> list[MovingObject]:
    """What moved, each with the height of its track and its box.

    End points that are dynamic and lie in neighbouring columns over the ground are a part of one
    thing. The nearest ones in each direction are what a planar laser would see, and followed as
    such; the rest of a part belongs to the thing that most of those are of.

    Args:
        recording: 3D, M beams without motion during its scans.
        poses: (T, 4, 4) T_map_base.
        p_static: (M,) P(c = 1) of every beam.
        ground: how high it is.
        options: see ObjectOptions.
        threads: same result with any number.
    """
    if not options.enabled:
        return []
    flat_poses = se2.project_to_plane(recording.T_map_sensor(poses))
    found = _dynamic_parts(recording, poses, flat_poses, p_static, ground, options, threads)
    hit = np.ones(len(found.nearest), np.bool_)
    flat = make_planar_recording(recording, found.points, hit, found.offset)
    things = track_objects(flat, flat_poses, p_static[found.nearest], options)
    owned = _of_parts(things, found.nearest, found.part, found.beam)
    return [
        _in_space(one, beams, recording, poses, p_static)
        for one, beams in zip(things, owned, strict=True)
    ]


class _Parts(NamedTuple):
    """What is dynamic over the ground.

    Attributes:
        points: (N, 2) metres, the nearest in each direction, in the planar frame of each sensor.
        nearest: (N,) their beams.
        offset: (T + 1,) where those of each scan begin.
        part: (K,) of each dynamic beam, rising from scan to scan.
        beam: (K,) their numbers, rising.
    """

    points: NDArray[np.float32]
    nearest: Index
    offset: NDArray[np.int64]
    part: Index
    beam: Index


def _dynamic_parts(
    recording: Recording,
    poses: Float,
    flat_poses: Float,
    p_static: NDArray[np.float32],
    ground: GroundMap,
    options: ObjectOptions,
    threads: int,
) -> _Parts:
    T_map_sensor, T = recording.T_map_sensor(poses), recording.n_scans
    scratch, offset, parts = recording.scratch, np.zeros(T + 1, np.int64), 0
    points, nearest = ArrayBuilder(np.float32, (2,), scratch), ArrayBuilder(np.intp, (), scratch)
    part_of, beam = ArrayBuilder(np.int64, (), scratch), ArrayBuilder(np.intp, (), scratch)

    def of_scan(t: int) -> tuple[Index, Index, Float, Index]:
        beams = recording.beams_of(t)
        moves = recording.hit[beams] & (p_static[beams] <= 1.0 - options.dynamic)
        number, end = _above_ground(beams, moves, recording, T_map_sensor[t], ground)
        part = _parts(end[:, :2])
        kept = np.bincount(part, minlength=1)[part] >= _FEWEST
        local = (end[kept, :2] - flat_poses[t, :2, 2]) @ flat_poses[t, :2, :2]
        return number[kept], part[kept], local, _nearest(local)

    in_turn = recording.iter_scans(range(T), p_static)
    for t, (number, part, local, near) in enumerate(map_ordered(of_scan, in_turn, threads)):
        points.append(local[near].astype(np.float32))
        nearest.append(number[near])
        part_of.append(parts + part)
        beam.append(number)
        parts += int(part.max()) + 1 if len(part) else 0
        offset[t + 1] = offset[t] + len(near)
    return _Parts(points.finish(), nearest.finish(), offset, part_of.finish(), beam.finish())


def _above_ground(
    beams: slice, moves: NDArray[np.bool_], recording: Recording, T: Float, ground: GroundMap
) -> tuple[Index, Float]:
    """Numbers and ends (n, 3) in the map frame of what moves over the ground."""
    number = beams.start + np.flatnonzero(moves)
    end = recording.points[number].astype(np.float64) @ T[:3, :3].T + T[:3, 3]
    above = end[:, 2] - ground.at(end[:, :2])
    kept = (above > _LOWEST) & (above < _HIGHEST)
    return number[kept], end[kept]


def _parts(xy: Float) -> Index:
    """(n,) which connected set of columns each place (n, 2) lies in."""
    import scipy  # its parts load when they are first used

    if not len(xy):
        return np.zeros(0, np.intp)
    column = np.floor(xy / _COLUMN).astype(np.int64)
    x, y = (column - column.min(axis=0)).T
    wide = int(y.max()) + 1
    flat, of = np.unique(x * wide + y, return_inverse=True)  # faster than that of rows
    cells = np.stack(np.divmod(flat, wide), axis=1)
    pairs = scipy.spatial.cKDTree(cells).query_pairs(1.5, output_type="ndarray")
    near = scipy.sparse.coo_array(
        (np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(len(cells),) * 2
    )
    part = scipy.sparse.csgraph.connected_components(near, directed=False)[1]
    return np.asarray(part[of.reshape(-1)], np.intp)


def _nearest(local: Float) -> Index:
    """The nearest of places (n, 2) in each direction, one direction after the other."""
    direction = np.floor(np.arctan2(local[:, 1], local[:, 0]) * (_DIRECTIONS / (2.0 * np.pi)))
    order = np.lexsort((np.linalg.norm(local, axis=1), direction))
    return order[np.diff(direction[order], prepend=-np.inf) > 0]


def _of_parts(things: list[MovingObject], nearest: Index, part: Index, beam: Index) -> list[Index]:
    """Of each thing all beams: its own, and those of the parts that are mostly its own.

    Args:
        things: their beams are numbers of the nearest ones.
        nearest: beams that were followed, rising within a scan's directions.
        part: of each moving beam, rising from scan to scan.
        beam: their numbers, rising.
    """
    if not len(beam):
        return [nearest[one.beams] for one in things]
    part_of = part[np.searchsorted(beam, nearest)]
    owner = np.full(len(nearest), len(things), np.int64)
    for k, one in enumerate(things):
        owner[one.beams] = k
    pairs, counts = np.unique(np.stack([part_of, owner], axis=1), axis=0, return_counts=True)
    order = np.lexsort((-counts, pairs[:, 0]))
    first = np.diff(pairs[order, 0], prepend=-1) > 0
    of_part = np.full(int(part.max()) + 1, len(things))
    of_part[pairs[order[first], 0]] = pairs[order[first], 1]
    of_beam = of_part[part]
    rank = np.argsort(of_beam, kind="stable")
    ends = np.searchsorted(of_beam[rank], np.arange(len(things) + 1))
    return [
        np.union1d(beam[rank[a:b]], nearest[one.beams])
        for one, a, b in zip(things, ends[:-1], ends[1:], strict=True)
    ]


def _in_space(
    one: MovingObject,
    beams: Index,
    recording: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
) -> MovingObject:
    """The same with all its beams, the height of its middle at each scan, and of its box."""
    z = recording.end_points(beams, poses)[:, 2]
    at = np.searchsorted(one.scan, recording.scans_of(beams)).clip(0, len(one.scan) - 1)
    low, high = np.full(len(one.scan), np.inf), np.full(len(one.scan), -np.inf)
    np.minimum.at(low, at, z)
    np.maximum.at(high, at, z)
    middle = 0.5 * (low + high)
    known = np.isfinite(middle)
    middle = np.interp(np.arange(len(middle)), np.flatnonzero(known), middle[known])
    bottom, top = np.percentile(z - middle[at], [_EDGE, 100.0 - _EDGE])
    return dataclasses.replace(
        one,
        beams=beams,
        z=middle,
        size=(*one.size[:2], float(top - bottom)),
        p_dynamic=float(1.0 - take_rows(p_static, beams).mean(dtype=np.float64)),
    )
