"""Things that moved, at a time: where each was, its box, and where its model stood."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.export.result import Track

Float = NDArray[np.float64]

_STANDS = 0.2  # m/s: what is slower says nothing of where it looks
# corners of a box that an edge joins; a corner's bits say on which side it lies, x, y, z
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
_FLOOR = _EDGES[(_EDGES < 4).all(axis=1)]


class Placed(NamedTuple):
    """Where n things are at a time.

    Attributes:
        number: (n,) which of the tracks.
        T_map_thing: (n, 4, 4) from its middle, x along its way, to the map frame.
        size: (n, 3) metres along, across and high; 0 high in the plane.
    """

    number: NDArray[np.intp]
    T_map_thing: Float
    size: Float


def headings(velocity: Float) -> Float:
    """(K,) radians, where a thing looks, of its velocities (K, 2); it goes on looking while it
    stands, and turns evenly in between."""
    going = np.flatnonzero(np.linalg.norm(velocity, axis=1) >= _STANDS)
    if not len(going):
        return np.zeros(len(velocity))
    angle = np.unwrap(np.arctan2(velocity[going, 1], velocity[going, 0]))
    return np.asarray(np.interp(np.arange(len(velocity)), going, angle))


def pose_at(track: Track, stamp_ns: int) -> Float:
    """(4, 4) T_map_thing at a time: between where it was seen before and after; from its first
    place before, at its last one after."""
    # seconds from this very time: nanoseconds of today have more digits than a float64
    since = 1e-9 * (track.stamp_ns - stamp_ns)
    x, y, angle = (np.interp(0.0, since, row) for row in (*track.xy.T, headings(track.velocity)))
    T = np.eye(4)
    T[0, :2], T[1, :2] = (np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))
    T[:3, 3] = x, y, 0.0 if track.z is None else np.interp(0.0, since, track.z)
    return T


def placed(tracks: Sequence[Track], stamp_ns: int) -> Placed:
    """Those that are seen before and after a time, or at it."""
    number = [n for n, one in enumerate(tracks) if is_there(one, stamp_ns)]
    T = [pose_at(tracks[n], stamp_ns) for n in number]
    size = [(*tracks[n].size, 0.0)[:3] for n in number]
    return Placed(
        np.array(number, np.intp), np.array(T).reshape(-1, 4, 4), np.array(size).reshape(-1, 3)
    )


def is_there(track: Track, stamp_ns: int) -> bool:
    """Whether it is seen at or before a time, and at or after it."""
    return bool(track.stamp_ns[0] <= stamp_ns <= track.stamp_ns[-1])


def edges(things: Placed) -> Float:
    """(n, 12, 2, 3) metres in the map frame, both ends of the edges of their boxes; (n, 4, 2, 3)
    where none is high."""
    joined = _EDGES if things.size[:, 2].any() else _FLOOR
    sides = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5  # (8, 3)
    corners = sides * things.size[:, None]
    R, t = things.T_map_thing[:, :3, :3], things.T_map_thing[:, :3, 3]
    return np.asarray((corners @ R.transpose(0, 2, 1) + t[:, None])[:, joined])


def ways(tracks: Sequence[Track]) -> tuple[Float, NDArray[np.intp]]:
    """(m, 2, 3) metres, the pieces of all ways, and (m,) whose each is."""
    rows = [
        np.column_stack([one.xy, np.zeros(len(one.xy)) if one.z is None else one.z])
        for one in tracks
    ]
    pieces = [np.stack([row[:-1], row[1:]], axis=1) for row in rows]
    whose = np.repeat(np.arange(len(rows)), [len(one) for one in pieces])
    return np.concatenate([np.zeros((0, 2, 3)), *pieces]), whose
