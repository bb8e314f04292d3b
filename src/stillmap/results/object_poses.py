"""Poses of moving objects at a time, interpolated along their tracks."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.results.reader import Track
from stillmap.tracking import MovingObject

Float = NDArray[np.float64]
Mover = MovingObject | Track

_MIN_SPEED = 0.2  # m/s from which a velocity gives the heading


class ObjectPoses(NamedTuple):
    """Poses of n objects at one time.

    Attributes:
        track: (n,) index of the track.
        T_map_object: (n, 4, 4) of the center, x along the heading.
        size: (n, 3) length, width and height in m; height 0 in 2D.
    """

    track: NDArray[np.intp]
    T_map_object: Float
    size: Float


def headings(velocity: Float) -> Float:
    """Headings (K,) in rad from velocities (K, 2), interpolated where an object stands."""
    moving = np.flatnonzero(np.linalg.norm(velocity, axis=1) >= _MIN_SPEED)
    if not len(moving):
        return np.zeros(len(velocity))
    angle = np.unwrap(np.arctan2(velocity[moving, 1], velocity[moving, 0]))
    return np.asarray(np.interp(np.arange(len(velocity)), moving, angle))


def interpolate_pose(track: Mover, stamp_ns: int) -> Float:
    """T_map_object (4, 4) at a time, interpolated; constant beyond the ends of the track."""
    # differences first: stamps in ns exceed the precision of float64
    seconds = 1e-9 * (track.stamp_ns - stamp_ns)
    x, y, angle = (np.interp(0.0, seconds, row) for row in (*track.xy.T, headings(track.velocity)))
    T = np.eye(4)
    T[0, :2], T[1, :2] = (np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))
    T[:3, 3] = x, y, 0.0 if track.z is None else np.interp(0.0, seconds, track.z)
    return T


def object_poses_at(tracks: Sequence[Mover], stamp_ns: int) -> ObjectPoses:
    """Poses of the objects index tracks span a time."""
    index = [n for n, one in enumerate(tracks) if is_present(one, stamp_ns)]
    T = [interpolate_pose(tracks[n], stamp_ns) for n in index]
    size = [(*tracks[n].size, 0.0)[:3] for n in index]
    return ObjectPoses(
        np.array(index, np.intp), np.array(T).reshape(-1, 4, 4), np.array(size).reshape(-1, 3)
    )


def is_present(track: Mover, stamp_ns: int) -> bool:
    """True if the track spans a time."""
    return bool(track.stamp_ns[0] <= stamp_ns <= track.stamp_ns[-1])


def iter_present_tracks(
    tracks: Sequence[Mover], stamp_ns: NDArray[np.int64]
) -> Iterator[list[int]]:
    """For each of the rising stamps (T,), the indices of the tracks that span it."""
    first = [int(np.searchsorted(stamp_ns, one.stamp_ns[0])) for one in tracks]
    last = [int(np.searchsorted(stamp_ns, one.stamp_ns[-1], "right")) for one in tracks]
    starting: dict[int, list[int]] = {}
    for index, scan in enumerate(first):
        starting.setdefault(scan, []).append(index)
    present: list[int] = []
    for t in range(len(stamp_ns)):
        present = [n for n in (*present, *starting.get(t, ())) if last[n] > t]
        yield present
