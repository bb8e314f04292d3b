"""Which tracks of a 3D recording are movers: those that travel, or whose place is seen to empty.

Hits of something static that its voxels take for dynamic make tracks, too. They go nowhere, and
beams end at their place before and after. What has left or come, a car that was parked, also goes
nowhere while it is seen, but beams pass its place.
"""

import dataclasses
from collections import defaultdict
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.tracking.objects import MovingObject

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_MIN_TRAVEL = 0.5  # m: errors of the poses and visible parts move what stands by less
_RADIUS = 0.4  # m around the center of what stands, that count as its place
_HALF_HEIGHT = 0.2  # m, at least, of its place above and below the center
_LOOK_TIME, _LOOKS = 3.0, 4  # s before the first detection and after the last; looks there at most
_MIN_BEAMS = 5  # that reach a place, for a look
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
    standing = [one for one in objects if np.linalg.norm(np.ptp(one.xy, axis=0)) < _MIN_TRAVEL]
    clutter = _remain_occupied(standing, recording, poses)
    kept = [one for one in objects if one.id not in clutter]
    return [dataclasses.replace(one, id=number) for number, one in enumerate(kept)]


def _remain_occupied(
    standing: Sequence[MovingObject], recording: Recording, poses: Float
) -> set[int]:
    """Ids of those whose place is not seen empty, neither before nor after."""
    looks: dict[int, list[tuple[int, int]]] = defaultdict(list)  # by scan: object, side
    for k, one in enumerate(standing):
        for side, scans in enumerate(_choose_looks(one, recording.stamp_ns)):
            for t in scans.tolist():
                looks[t].append((k, side))
    counts = np.zeros((len(standing), 2, 2), np.int64)  # by side: looks, and those that pass
    T_map_sensor = recording.T_map_sensor(poses)
    for t in sorted(looks):
        beams = recording.beams_of(t)
        points = recording.points[beams][recording.hit[beams]].astype(np.float64)
        ends = points @ T_map_sensor[t, :3, :3].T
        flat = np.ascontiguousarray(ends[:, :2].T)
        length = np.sqrt(np.square(flat[0]) + np.square(flat[1]))
        for k, side in looks[t]:
            place = _place(standing[k]) - T_map_sensor[t, :3, 3]
            near = _find_near_line(flat, length, place)
            passed = _passes(ends[near], place, standing[k])
            if passed is not None:
                counts[k, side] += 1, int(passed)
    is_empty = (counts[..., 0] > 0) & (2 * counts[..., 1] > counts[..., 0])
    return {one.id for one, sides in zip(standing, is_empty, strict=True) if not sides.any()}


def _choose_looks(one: MovingObject, stamp_ns: NDArray[np.int64]) -> tuple[Index, Index]:
    """Scans before the first detection and after the last."""
    reach = round(1e9 * _LOOK_TIME)
    first, last = np.searchsorted(stamp_ns, [one.stamp_ns[0] - reach, one.stamp_ns[-1] + reach])
    sides = np.arange(first, one.scan[0]), np.arange(one.scan[-1] + 1, last)
    before, after = (side[:: max(1, -(-len(side) // _LOOKS))] for side in sides)
    return before, after


def _place(one: MovingObject) -> Float:
    """(3,) mean center in the map frame, metres."""
    assert one.z is not None
    return np.array([*one.xy.mean(axis=0), one.z.mean()])


def _find_near_line(flat: Float, length: Float, place: Float) -> Index:
    """The beams that may come near a place, in the plane; `_passes` decides for these few.

    Args:
        flat: (2, N) ends from the sensor.
        length: (N,) of these.
        place: (3,) from the sensor.
    """
    across = np.abs(flat[0] * place[1] - flat[1] * place[0])
    return np.flatnonzero(across <= (_RADIUS + _ROUNDING) * (length + _ROUNDING))


def _passes(ends: Float, place: Float, one: MovingObject) -> bool | None:
    """True if all beams that reach a place pass it; None: too few do. Most pass a thin post, too.

    Args:
        ends: (N, 3) from the sensor, in the axes of the map.
        place: (3,) from the sensor, likewise.
        one: whose height counts.
    """
    length = np.maximum(np.linalg.norm(ends[:, :2], axis=1), 1e-6)
    along = ends[:, :2] @ place[:2] / length
    off = np.abs(ends[:, 0] * place[1] - ends[:, 1] * place[0]) / length
    height = ends[:, 2] * (along / length) - place[2]
    towards = (along > 0) & (off < _RADIUS) & (length > along - _RADIUS)
    towards &= np.abs(height) < max(0.5 * one.size[2], _HALF_HEIGHT)
    if np.count_nonzero(towards) < _MIN_BEAMS:
        return None
    return bool((length[towards] > along[towards] + _RADIUS).all())
