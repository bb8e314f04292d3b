"""End points of dynamic beams, clustered along each scan by the distance between neighbours."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.array_builder import ArrayBuilder
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording

# P(dynamic) from which a beam may belong to a moving object: 1 - p_static of what is known to move
# lies near 1, of what is not known at the prior
MIN_P_DYNAMIC = 0.7
_LINK = 0.35  # m: distance between neighbours of one cluster
LINK_PER_METRE = 0.02  # m more per metre of range

# of a scan, the largest ones, that are followed: pairs of them are compared, and objects that a
# laser sees at once, which hide each other, are fewer
_MAX_CLUSTERS = 250


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
    recording: Recording, poses: Float, p_static: Float32, min_p_dynamic: float
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
    types = {"scan": np.intp, "beam": np.intp, "xy": float, "range": float, "cluster": np.intp}
    columns = {
        name: ArrayBuilder(dtype, (2,) if name == "xy" else (), scratch)
        for name, dtype in types.items()
    }
    count = np.zeros(recording.n_scans + 1, np.intp)
    n_clusters = 0
    for _, block, _ in iter_chunks(recording, release=[p_static]):
        dynamic = recording.hit[block] & (p_static[block] <= 1.0 - min_p_dynamic)
        beam = block.start + np.flatnonzero(dynamic)
        if len(beam) == 0:
            continue
        scan, xy = recording.scans_of(beam), recording.end_points(beam, poses)
        distance = np.linalg.norm(recording.points[beam].astype(np.float64), axis=1)
        cluster = _cluster(scan, xy, distance)
        kept = _largest_clusters(scan, cluster)
        if not kept.all():
            beam, scan, xy, distance = beam[kept], scan[kept], xy[kept], distance[kept]
            cluster = np.cumsum(np.diff(cluster[kept], prepend=-1) > 0) - 1
        cluster += n_clusters
        n_clusters = int(cluster[-1]) + 1
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


def _cluster(scan: Index, xy: Float, distance: Float) -> Index:
    """(N,) cluster numbers from 0: one ends with its scan, or at a gap to the next end point."""
    step = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    max_step = _LINK + LINK_PER_METRE * np.minimum(distance[1:], distance[:-1])
    return np.append(0, np.cumsum((np.diff(scan) > 0) | (step > max_step)))


def _largest_clusters(scan: Index, cluster: Index) -> Bool:
    """(N,) whether a point is of one of the clusters of its scan that are followed."""
    _, first, size = np.unique(cluster, return_index=True, return_counts=True)
    of = scan[first]
    order = np.lexsort((-size, of))
    begin = np.searchsorted(of, of)
    kept = np.empty(len(of), bool)
    kept[order] = np.arange(len(of)) - begin < _MAX_CLUSTERS
    return kept[cluster]
