"""Boxes and tracks of moving objects as lines, and the beams of a scan."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.core.recording import Recording
from stillmap.results.object_poses import ObjectPoses
from stillmap.results.reader import Track
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.options import SlamOptions

Float = NDArray[np.float64]

# corners of a box that each edge joins; bits 0 to 2 of a corner are its side in x, y, z
_EDGES = np.array([(a, a | bit) for bit in (1, 2, 4) for a in range(8) if not a & bit])
_FLOOR = _EDGES[(_EDGES < 4).all(axis=1)]


def box_edges(objects: ObjectPoses) -> Float:
    """Both ends of the box edges, (n, 12, 2, 3) m in the map frame; (n, 4, 2, 3) in 2D."""
    edges = _EDGES if objects.size[:, 2].any() else _FLOOR
    sides = ((np.arange(8)[:, None] >> np.arange(3)) & 1) - 0.5  # (8, 3)
    corners = sides * objects.size[:, None]
    R, t = objects.T_map_object[:, :3, :3], objects.T_map_object[:, :3, 3]
    return np.asarray((corners @ R.transpose(0, 2, 1) + t[:, None])[:, edges])


def track_segments(tracks: Sequence[Track]) -> tuple[Float, NDArray[np.intp]]:
    """Line segments (m, 2, 3) in m of all tracks, and the index (m,) of their tracks."""
    lines = [
        np.column_stack([one.xy, np.zeros(len(one.xy)) if one.z is None else one.z])
        for one in tracks
    ]
    segments = [np.stack([row[:-1], row[1:]], axis=1) for row in lines]
    index = np.repeat(np.arange(len(lines)), [len(one) for one in segments])
    return np.concatenate([np.zeros((0, 2, 3)), *segments]), index


MAX_BEAMS = 60_000  # shown of a scan
# scans before and after one from which it is deskewed; in 2D several lasers may take turns
_NEIGHBORS = {2: 8, 3: 1}


class ScanView(NamedTuple):
    """Returns of one scan.

    Attributes:
        ends: (n, 3) m in the map frame; z = 0 in 2D.
        p_static: (n,) float32.
        origin: (3,) m, position of the sensor.
    """

    ends: NDArray[np.float64]
    p_static: NDArray[np.float32]
    origin: NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Beams:
    """The recording of a result with labels and poses.

    Attributes:
        recording: T scans, M beams; may be memory-mapped.
        p_static: (M,) float32, P(c = 1), NaN for unusable beams.
        poses: (T, D+1, D+1) T_map_base.
        slam: options of deskewing.
    """

    recording: Recording
    p_static: NDArray[np.float32]
    poses: NDArray[np.float64]
    slam: SlamOptions

    def scan_view(self, scan: int, max_count: int = MAX_BEAMS) -> ScanView:
        """At most `max_count` returns of a scan; reads only this scan and its neighbors."""
        D, T = self.recording.dimension, self.recording.n_scans
        first, end = max(scan - _NEIGHBORS[D], 0), min(scan + _NEIGHBORS[D] + 1, T)
        near = deskew_recording(
            slice_scans(self.recording, first, end), self.poses[first:end], self.slam
        )
        beams, at = self.recording.beams_of(scan), near.beams_of(scan - first)
        use = np.flatnonzero(near.hit[at])
        use = use[sample_indices(len(use), max_count)]
        T_map_sensor = near.T_map_sensor(self.poses[first:end])[scan - first]
        ends, origin = np.zeros((len(use), 3)), np.zeros(3)
        points = near.points[at][use].astype(np.float64)
        ends[:, :D] = points @ T_map_sensor[:D, :D].T + T_map_sensor[:D, D]
        origin[:D] = T_map_sensor[:D, D]
        p_static = np.asarray(self.p_static[beams][use])
        self.recording.release_pages(self.p_static)
        return ScanView(ends, p_static, origin)


def slice_scans(recording: Recording, first: int, end: int) -> Recording:
    """Scans first:end without odometry, as views of the arrays."""
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
