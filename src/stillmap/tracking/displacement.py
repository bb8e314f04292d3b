"""Which tracks of a 3D recording are movers: those that travel, or whose place is seen to empty.

Hits of something static that its voxels take for dynamic make tracks, too. They go nowhere, and
beams end at their place before and after. What has left or come, a car that was parked, also goes
nowhere while it is seen, but beams pass its place.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.recording import Recording
from stillmap.tracking.objects import MovingObject

_MIN_TRAVEL = 0.5  # m: errors of the poses and visible parts move what stands by less
_RADIUS = 0.4  # m around the center of what stands, that count as its place
_HALF_HEIGHT = 0.2  # m, at least, of its place above and below the center
_VIEW_TIME, _VIEWS = 3.0, 4  # s before the first detection and after the last; views there at most
_MIN_BEAMS = 5  # that reach a place, for a view
_BEFORE, _AFTER, _DURING = 0, 1, 2
_MIN_HALF_SIZE = 0.05  # m, of the outline of a thin or flat object
_MAX_P_MISSED = 0.05  # that an object which is still there stops no beam
_ROUNDING = 1e-3  # m, far more than rounding errors of distances


def select_movers(
    objects: Sequence[MovingObject], recording: Recording, poses: Float
) -> list[MovingObject]:
    """The objects that travel 0.5 m, or whose place beams pass before or after; ids from 0.

    Args:
        objects: of the recording, with heights.
        recording: 3D, deskewed.
        poses: (T, 4, 4) T_map_base.
    """
    standing = [
        mover for mover in objects if np.linalg.norm(np.ptp(mover.xy, axis=0)) < _MIN_TRAVEL
    ]
    clutter = _remain_occupied(standing, recording, poses)
    kept = [mover for mover in objects if mover.id not in clutter]
    return [dataclasses.replace(mover, id=number) for number, mover in enumerate(kept)]


class _PlaceView(NamedTuple):
    """Beams of a scan that reach a place.

    Attributes:
        around: number of them within 0.4 m of its center line.
        stopped: number of those that do not pass.
        through: number of them within the outline of the object.
        inside: number of those that end there.
    """

    around: int
    stopped: int
    through: int
    inside: int


def _remain_occupied(
    standing: Sequence[MovingObject], recording: Recording, poses: Float
) -> set[int]:
    """Ids of those whose place is not seen empty, neither before nor after."""
    by_scan: dict[int, list[tuple[int, int]]] = defaultdict(list)  # by scan: object, time
    for k, mover in enumerate(standing):
        for time, scans in enumerate(_choose_scans(mover, recording.stamp_ns)):
            for t in scans.tolist():
                by_scan[t].append((k, time))
    views: dict[tuple[int, int], list[_PlaceView]] = defaultdict(list)
    T_map_sensor = recording.T_map_sensor(poses)
    for t in recording.iter_scans(sorted(by_scan)):
        beams = recording.beams_of(t)
        points = recording.points[beams].compress(recording.hit[beams], axis=0).astype(np.float64)
        ends = points @ T_map_sensor[t, :3, :3].T
        flat = np.ascontiguousarray(ends[:, :2].T)
        length = np.sqrt(np.square(flat[0]) + np.square(flat[1]))
        for k, time in by_scan[t]:
            place = _place(standing[k]) - T_map_sensor[t, :3, 3]
            near = _find_near_line(flat, length, place)
            views[k, time].append(_view_place(ends[near], place, standing[k].size))
    return {
        mover.id
        for k, mover in enumerate(standing)
        if not any(_is_empty(views[k, side], views[k, _DURING]) for side in (_BEFORE, _AFTER))
    }


def _is_empty(views: Sequence[_PlaceView], during: Sequence[_PlaceView]) -> bool:
    """True if other views show that the object of the views `during` its track is not there.

    Most views see all beams pass, and so many of them within its outline that the object, which
    stopped a share of such beams, would have stopped one.
    """
    views = [view for view in views if view.around >= _MIN_BEAMS]
    passed = [view for view in views if not view.stopped]
    through, inside = sum(view.through for view in during), sum(view.inside for view in during)
    p_pass = 1.0 - inside / max(through, 1)
    expected = sum(view.through for view in passed)
    return 2 * len(passed) > len(views) and p_pass**expected < _MAX_P_MISSED


def _choose_scans(mover: MovingObject, stamp_ns: Int64) -> tuple[Index, Index, Index]:
    """Scans before the first detection, after the last, and some with a detection."""
    reach = round(1e9 * _VIEW_TIME)
    first, last = np.searchsorted(stamp_ns, [mover.stamp_ns[0] - reach, mover.stamp_ns[-1] + reach])
    times = np.arange(first, mover.scan[0]), np.arange(mover.scan[-1] + 1, last), mover.scan
    before, after, during = (scans[:: max(1, -(-len(scans) // _VIEWS))] for scans in times)
    return before, after, during


def _place(mover: MovingObject) -> Float:
    """(3,) mean center in the map frame, metres."""
    assert mover.z is not None
    return np.array([*mover.xy.mean(axis=0), mover.z.mean()])


def _find_near_line(flat: Float, length: Float, place: Float) -> Index:
    """The beams that may come near a place, in the plane; `_view_place` decides for these few.

    Args:
        flat: (2, N) ends from the sensor.
        length: (N,) of these.
        place: (3,) from the sensor.
    """
    across = np.abs(flat[0] * place[1] - flat[1] * place[0])
    return np.flatnonzero(across <= (_RADIUS + _ROUNDING) * (length + _ROUNDING))


def _view_place(ends: Float, place: Float, size: Sequence[float]) -> _PlaceView:
    """Count the beams of a scan that reach the place of an object, and those that end there.

    Args:
        ends: (N, 3) from the sensor, in the axes of the map.
        place: (3,) from the sensor, likewise.
        size: metres along, across and up.
    """
    length = np.maximum(np.linalg.norm(ends[:, :2], axis=1), 1e-6)
    along = ends[:, :2] @ place[:2] / length
    off = np.abs(ends[:, 0] * place[1] - ends[:, 1] * place[0]) / length
    height = np.abs(ends[:, 2] * (along / length) - place[2])
    towards = (along > 0) & (off < _RADIUS) & (length > along - _RADIUS)
    towards &= height < max(0.5 * size[2], _HALF_HEIGHT)
    passes = length > along + _RADIUS
    width = max(0.5 * min(size[:2]), _MIN_HALF_SIZE)
    within = towards & (off < width) & (height < max(0.5 * size[2], _MIN_HALF_SIZE))
    return _PlaceView(
        int(np.count_nonzero(towards)),
        int(np.count_nonzero(towards & ~passes)),
        int(np.count_nonzero(within)),
        int(np.count_nonzero(within & ~passes)),
    )


_VIEWS_OF_SURFACE = 4  # scans of a track that are evaluated
_NEIGHBORS = 8  # of a beam: the ring around it in an image
_MAX_STEP = 0.15  # m between the ranges of neighbors on one surface
_MARGIN = 0.03  # rad around an object, within which the neighbors of its beams are searched
_MAX_ATTACHMENT = 0.4  # one side of an object and its ground are less


def drop_surface_parts(
    objects: Sequence[MovingObject], recording: Recording, p_static: Float32
) -> list[MovingObject]:
    """The objects that are no part of a static surface.

    Args:
        objects: of the recording.
        recording: 3D, M beams, deskewed.
        p_static: (M,) P(c = 1) of every beam.
    """
    counts = count_neighbors(objects, recording, p_static)
    attached = counts[:, 0] > _MAX_ATTACHMENT * np.maximum(counts.sum(axis=1), _MIN_BEAMS)
    return [mover for mover, is_part in zip(objects, attached, strict=True) if not is_part]


def count_neighbors(
    objects: Sequence[MovingObject], recording: Recording, p_static: Float32
) -> Int64:
    """(K, 2) beams beside each object that end on its surface, and behind it.

    Static beams at the range of the object's nearest one end on its surface. Others at that range
    and before it do not count.
    """
    counts = np.zeros((len(objects), 2), np.int64)
    by_scan: dict[int, list[int]] = defaultdict(list)  # by scan: objects
    for k, mover in enumerate(objects):
        for t in mover.scan[:: -(-len(mover.scan) // _VIEWS_OF_SURFACE)].tolist():
            by_scan[t].append(k)
    for t in recording.iter_scans(sorted(by_scan), p_static):
        beams = recording.beams_of(t)
        numbers = beams.start + np.flatnonzero(recording.hit[beams])
        # `take` is several times as fast as an index where rows are short
        directions = recording.points.take(numbers, axis=0).astype(np.float64)
        x, y, z = directions.T  # a column at a time: rows of three numbers are slow
        ranges = np.sqrt(x * x + y * y + z * z)
        directions /= np.maximum(ranges, 1e-9)[:, None]
        is_static = p_static[numbers] >= 0.5
        for k in by_scan[t]:
            own = _find_own(numbers, objects[k].beams)
            counts[k] += _count_beside(directions, ranges, own, is_static)
    return counts


def _find_own(numbers: Index, beams: Index) -> Index:
    """Indices into the rising beam numbers (N,) of the rising beam numbers of an object."""
    first, last = np.searchsorted(beams, [numbers[0], numbers[-1] + 1]) if len(numbers) else (0, 0)
    return np.asarray(np.searchsorted(numbers, beams[first:last]))


def _count_beside(directions: Float, ranges: Float, own: Index, is_static: Bool) -> tuple[int, int]:
    """Beams beside an object's own that end on its surface, and behind it.

    Args:
        directions: (N, 3) of unit length.
        ranges: (N,) metres.
        own: beams of the object, rising.
        is_static: (N,) others that are static.
    """
    if not len(own):
        return 0, 0
    from scipy.spatial import cKDTree  # slow to load

    middle = directions[own].mean(axis=0)
    middle /= max(float(np.linalg.norm(middle)), 1e-9)
    away = directions @ middle
    reach = float(np.arccos(np.clip(away[own].min(), -1.0, 1.0))) + _MARGIN
    near = np.flatnonzero(away >= np.cos(min(reach, np.pi)))
    tree = cKDTree(directions[near])
    _, neighbors = tree.query(directions[own], k=min(_NEIGHBORS + 1, len(near)))
    is_beside = np.zeros(len(ranges), np.bool_)
    is_beside[near[neighbors]] = True
    is_beside[own] = False
    beside = np.flatnonzero(is_beside)
    if not len(beside):
        return 0, 0
    nearest = cKDTree(directions[own]).query(directions[beside])[1]
    step = ranges[beside] - ranges[own][nearest]
    on_it = (np.abs(step) <= _MAX_STEP) & is_static[beside]
    return int(np.count_nonzero(on_it)), int(np.count_nonzero(step > _MAX_STEP))
