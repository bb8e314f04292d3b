"""The beams of one scan at a time: where they ended, and how probably on something static."""

from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.recording.model import Recording
from stillmap.slam.deskew import deskewed
from stillmap.slam.incremental import SlamOptions
from stillmap.viewer.thinning import chosen

MOST_BEAMS = 60_000  # of a scan that are shown
# scans before and after one that tell how the robot moved meanwhile; lasers take turns in the plane
_REACH = {2: 8, 3: 1}


class Seen(NamedTuple):
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

    def at(self, scan: int, most: int = MOST_BEAMS) -> Seen:
        """At most so many beams of a scan; only it and those beside it are read."""
        D, T = self.recording.dimension, self.recording.n_scans
        first, end = max(scan - _REACH[D], 0), min(scan + _REACH[D] + 1, T)
        near = deskewed(part(self.recording, first, end), self.poses[first:end], self.slam)
        beams, at = self.recording.beams_of(scan), near.beams_of(scan - first)
        use = np.flatnonzero(near.hit[at])
        use = use[chosen(len(use), most)]
        T_map_sensor = near.T_map_sensor(self.poses[first:end])[scan - first]
        ends, origin = np.zeros((len(use), 3)), np.zeros(3)
        its = near.points[at][use].astype(np.float64)
        ends[:, :D] = its @ T_map_sensor[:D, :D].T + T_map_sensor[:D, D]
        origin[:D] = T_map_sensor[:D, D]
        p_static = np.asarray(self.p_static[beams][use])
        self.recording.let_go(self.p_static)
        return Seen(ends, p_static, origin)


def part(recording: Recording, first: int, end: int) -> Recording:
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
