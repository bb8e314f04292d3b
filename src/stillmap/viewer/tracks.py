"""Things that moved, at a time: where each was, its box, and where its model stood.

The beams of one scan at a time: where they ended, and how probably on something static.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.recording import Recording
from stillmap.results.reader import Track
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.options import SlamOptions
from stillmap.viewer.display import sample_indices

Float = NDArray[np.float64]

_STANDS = 0.2  # m/s: what is slower says nothing of where it looks

# corners of a box that an edge joins; a corner's bits say on which side it lies, x, y, z
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])

_FLOOR = _EDGES[(_EDGES < 4).all(axis=1)]


class ObjectPoses(NamedTuple):
    """Where n things are at a time.

    Attributes:
        number: (n,) which of the tracks.
        T_map_thing: (n, 4, 4) from its middle, x along its way, to the map frame.
        size: (n, 3) metres along, across and high; 0 high in the plane.
    """

    index: NDArray[np.intp]
    T_map_object: Float
    size: Float


def headings(velocity: Float) -> Float:
    """(K,) radians, where a thing looks, of its velocities (K, 2); it goes on looking while it
    stands, and turns evenly in between."""
    going = np.flatnonzero(np.linalg.norm(velocity, axis=1) >= _STANDS)
    if not len(going):
        return np.zeros(len(velocity))
    angle = np.unwrap(np.arctan2(velocity[going, 1], velocity[going, 0]))
    return np.asarray(np.interp(np.arange(len(velocity)), going, angle))


def interpolate_pose(track: Track, stamp_ns: int) -> Float:
    """(4, 4) T_map_thing at a time: between where it was seen before and after; from its first
    place before, at its last one after."""
    # seconds from this very time: nanoseconds of today have more digits than a float64
    since = 1e-9 * (track.stamp_ns - stamp_ns)
    x, y, angle = (np.interp(0.0, since, row) for row in (*track.xy.T, headings(track.velocity)))
    T = np.eye(4)
    T[0, :2], T[1, :2] = (np.cos(angle), -np.sin(angle)), (np.sin(angle), np.cos(angle))
    T[:3, 3] = x, y, 0.0 if track.z is None else np.interp(0.0, since, track.z)
    return T


def object_poses_at(tracks: Sequence[Track], stamp_ns: int) -> ObjectPoses:
    """Those that are seen before and after a time, or at it."""
    number = [n for n, one in enumerate(tracks) if is_present(one, stamp_ns)]
    T = [interpolate_pose(tracks[n], stamp_ns) for n in number]
    size = [(*tracks[n].size, 0.0)[:3] for n in number]
    return ObjectPoses(
        np.array(number, np.intp), np.array(T).reshape(-1, 4, 4), np.array(size).reshape(-1, 3)
    )


def is_present(track: Track, stamp_ns: int) -> bool:
    """Whether it is seen at or before a time, and at or after it."""
    return bool(track.stamp_ns[0] <= stamp_ns <= track.stamp_ns[-1])


def box_edges(things: ObjectPoses) -> Float:
    """(n, 12, 2, 3) metres in the map frame, both ends of the edges of their boxes; (n, 4, 2, 3)
    where none is high."""
    joined = _EDGES if things.size[:, 2].any() else _FLOOR
    sides = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5  # (8, 3)
    corners = sides * things.size[:, None]
    R, t = things.T_map_object[:, :3, :3], things.T_map_object[:, :3, 3]
    return np.asarray((corners @ R.transpose(0, 2, 1) + t[:, None])[:, joined])


def track_segments(tracks: Sequence[Track]) -> tuple[Float, NDArray[np.intp]]:
    """(m, 2, 3) metres, the pieces of all ways, and (m,) whose each is."""
    rows = [
        np.column_stack([one.xy, np.zeros(len(one.xy)) if one.z is None else one.z])
        for one in tracks
    ]
    pieces = [np.stack([row[:-1], row[1:]], axis=1) for row in rows]
    whose = np.repeat(np.arange(len(rows)), [len(one) for one in pieces])
    return np.concatenate([np.zeros((0, 2, 3)), *pieces]), whose


MAX_BEAMS = 60_000  # of a scan that are shown

# scans before and after one that tell how the robot moved meanwhile; lasers take turns in the plane
_REACH = {2: 8, 3: 1}


class ScanView(NamedTuple):
    """What is shown of a scan.

    Attributes:
        ends: (n, 3) metres in the map frame, of beams that hit something; z = 0 in the plane.
        p_static: (n,) float32.
        origin: (3,) metres, where the sensor was.
    """

    ends: NDArray[np.float64]
    p_static: NDArray[np.float32]
    origin: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Beams:
    """The recording of a result, its labels, and where the robot was.

    Attributes:
        recording: T scans, M beams; it may lie in files.
        p_static: (M,) float32, P(c = 1), NaN for unusable beams.
        poses: (T, D+1, D+1) T_map_base.
        slam: how the motion during scans was taken out.
    """

    recording: Recording
    p_static: NDArray[np.float32]
    poses: NDArray[np.float64]
    slam: SlamOptions

    def scan_view(self, scan: int, most: int = MAX_BEAMS) -> ScanView:
        """At most so many beams of a scan; only it and those beside it are read."""
        D, T = self.recording.dimension, self.recording.n_scans
        first, end = max(scan - _REACH[D], 0), min(scan + _REACH[D] + 1, T)
        near = deskew_recording(
            slice_scans(self.recording, first, end), self.poses[first:end], self.slam
        )
        beams, at = self.recording.beams_of(scan), near.beams_of(scan - first)
        use = np.flatnonzero(near.hit[at])
        use = use[sample_indices(len(use), most)]
        T_map_sensor = near.T_map_sensor(self.poses[first:end])[scan - first]
        ends, origin = np.zeros((len(use), 3)), np.zeros(3)
        its = near.points[at][use].astype(np.float64)
        ends[:, :D] = its @ T_map_sensor[:D, :D].T + T_map_sensor[:D, D]
        origin[:D] = T_map_sensor[:D, D]
        p_static = np.asarray(self.p_static[beams][use])
        self.recording.release_pages(self.p_static)
        return ScanView(ends, p_static, origin)


def slice_scans(recording: Recording, first: int, end: int) -> Recording:
    """Scans first:end alone, without odometry; its arrays are parts of those of the whole."""
    beams = slice(int(recording.offset[first]), int(recording.offset[end]))
    times = recording.beam_time
    return replace(
        recording,
        stamp_ns=recording.stamp_ns[first:end],
        offset=recording.offset[first : end + 1] - recording.offset[first],
        points=recording.points[beams],
        hit=recording.hit[beams],
        sensor=recording.sensor[first:end],
        T_odom_base=None,
        T_recorded_base=None,
        beam_time=None if times is None else times[beams],
        images=None,
    )
