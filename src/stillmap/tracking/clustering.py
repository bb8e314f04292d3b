"""End points of dynamic beams, clustered along each scan by the distance between neighbours."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.recording import Recording

Float = NDArray[np.float64]
Index = NDArray[np.intp]

# P(dynamic) from which a beam may belong to a moving object: 1 - p_static of what is known to move
# lies near 1, of what is not known at the prior
MIN_P_DYNAMIC = 0.7
_LINK = 0.35  # m: distance between neighbours of one cluster
LINK_PER_METRE = 0.02  # m more per metre of range

_Last = tuple[Index, Float, Float, int]
_FIRST: _Last = np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0), -1


@dataclass(frozen=True, eq=False)
class DynamicPoints:
    """N end points of dynamic beams, in the order of the recording.

    Attributes:
        seconds: (T,) time of each scan since the first.
        scan: (N,) scan of each point.
        beam: (N,) beam of the recording.
        xy: (N, 2) in the map frame.
        range: (N,) metres from the sensor.
        sensor: (T, 2) position of the sensor in the map frame.
        cluster: (N,) rising cluster numbers; a cluster lies within one scan.
        first: (T + 1,) scan t has the points first[t]:first[t + 1].
        scratch: folder for large arrays derived from these, see Recording.
    """

    seconds: Float
    scan: Index
    beam: Index
    xy: Float
    range: Float
    sensor: Float
    cluster: Index
    first: Index
    scratch: Path | None = None

    @property
    def period(self) -> float:
        """Median time from scan to scan, s; 0 of one scan."""
        return float(np.median(np.diff(self.seconds))) if len(self.seconds) > 1 else 0.0

    def release(self, *more: NDArray[Any]) -> None:
        """Release the cached pages of the memory-mapped points, and of other arrays."""
        for array in (self.scan, self.beam, self.xy, self.range, self.cluster, *more):
            arrays.release_pages(array)


def extract_dynamic_points(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], min_p_dynamic: float
) -> DynamicPoints:
    """Select the hits whose P(dynamic) is at least `min_p_dynamic`, and cluster them.

    Args:
        recording: 2D; M beams, deskewed.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1) of each beam.
        min_p_dynamic: threshold of 1 - p_static.
    """
    # stamps may go backwards where clocks jump; time does not
    seconds = np.maximum.accumulate(1e-9 * (recording.stamp_ns - recording.stamp_ns[:1]))
    scratch = recording.scratch
    columns = {
        name: ArrayBuilder(dtype, row, scratch)
        for name, dtype, row in (
            ("scan", np.intp, ()),
            ("beam", np.intp, ()),
            ("xy", np.float64, (2,)),
            ("range", np.float64, ()),
            ("cluster", np.intp, ()),
        )
    }
    count = np.zeros(recording.n_scans + 1, np.intp)
    last = _FIRST
    for block in arrays.iter_blocks(recording.hit, p_static):
        dynamic = recording.hit[block] & (p_static[block] <= 1.0 - min_p_dynamic)
        beam = block.start + np.flatnonzero(dynamic)
        if len(beam) == 0:
            continue
        scan, xy = recording.scans_of(beam), recording.end_points(beam, poses)
        distance = np.linalg.norm(recording.points[beam].astype(np.float64), axis=1)
        cluster = _cluster(scan, xy, distance, last)
        last = scan[-1:], xy[-1:], distance[-1:], int(cluster[-1])
        for column, part in zip(columns.values(), (scan, beam, xy, distance, cluster), strict=True):
            column.append(part)
        count[scan[0] + 1 : scan[-1] + 2] += np.bincount(scan - scan[0])
    return DynamicPoints(
        seconds=seconds,
        sensor=recording.T_map_sensor(poses)[:, :2, 2],
        first=np.cumsum(count),
        scratch=scratch,
        **{name: column.finish() for name, column in columns.items()},
    )


def _cluster(scan: Index, xy: Float, distance: Float, last: _Last = _FIRST) -> Index:
    """(N,) cluster numbers: a cluster ends with its scan or at a gap to the next end point.

    `last` holds scan, position, range and cluster number of the preceding point.
    """
    new = len(scan)
    scan = np.concatenate([last[0], scan])
    xy, distance = np.concatenate([last[1], xy]), np.concatenate([last[2], distance])
    step = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    max_step = _LINK + LINK_PER_METRE * np.minimum(distance[1:], distance[:-1])
    begins = (np.diff(scan) > 0) | (step > max_step)
    if len(scan) == new:  # no preceding point
        begins = np.concatenate([[True], begins])
    return last[-1] + np.cumsum(begins)
