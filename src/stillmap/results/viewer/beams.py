"""The beams of a result's recording in the map frame."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import sample_indices
from stillmap.core.recording import Recording
from stillmap.mapping.beam_statistics import sample_dynamic_points
from stillmap.slam.deskew import deskew_recording
from stillmap.slam.options import SlamOptions

Float = NDArray[np.float64]

MAX_BEAMS = 60_000  # shown of a scan
_BLOCK_SCANS = 256  # deskewed at once
_MAX_READ = 20_000_000  # beams read to find the dynamic ones, which takes seconds
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
            self.recording.slice_scans(first, end), self.poses[first:end], self.slam
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

    def dynamic_ends(self, max_count: int) -> Float:
        """At most `max_count` end points (n, D) in m, in the map frame, of dynamic returns.

        The recording is read in blocks of scans; of a long one not every block.
        """
        offset, T = self.recording.offset, self.recording.n_scans
        blocks = np.arange(0, T, _BLOCK_SCANS)
        most = max(1, _MAX_READ * len(blocks) // max(self.recording.n_beams, 1))
        parts = [np.zeros((0, self.recording.dimension))]
        for first in blocks[sample_indices(len(blocks), most)].tolist():
            end = min(first + _BLOCK_SCANS, T)
            poses, p_static = self.poses[first:end], self.p_static[offset[first] : offset[end]]
            block = deskew_recording(self.recording.slice_scans(first, end), poses, self.slam)
            parts.append(sample_dynamic_points(block, poses, p_static, len(p_static)))
            self.recording.release_pages(self.p_static)
        ends = np.concatenate(parts)
        return ends[sample_indices(len(ends), max_count)]
