"""End points of beams that something moving reflected."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.arrays import ArrayBuilder
from stillmap.core.recording import Recording
from stillmap.tracking.options import ObjectOptions

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_Last = tuple[Index, Float, Float, int]
_NOTHING: _Last = np.zeros(0, np.intp), np.zeros((0, 2)), np.zeros(0), -1


@dataclass(frozen=True, eq=False)
class DynamicPoints:
    """N end points, in the order of the recording.

    Attributes:
        seconds: (T,) when each scan was taken, from the first.
        scan: (N,) which scan.
        beam: (N,) which beam of the recording.
        xy: (N, 2) in the map frame.
        range: (N,) metres from the sensor.
        sensor: (T, 2) where the sensor was at each scan, in the map frame.
        cluster: (N,) numbers of runs of neighbours in a scan that lie on one thing, rising.
        first: (T + 1,) scan t has the points first[t]:first[t + 1].
        scratch: folder for what becomes known of them, where it is large, see Recording.
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

    def release(self, *more: NDArray[Any]) -> None:
        """What lies in memory of the points, and of other arrays, only because it was looked at."""
        for array in (self.scan, self.beam, self.xy, self.range, self.cluster, *more):
            arrays.release_pages(array)


def extract_dynamic_points(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], options: ObjectOptions
) -> DynamicPoints:
    """The hits that are dynamic as probably as `options.dynamic`, and which belong together.

    Args:
        recording: 2D; M beams, without motion during scans.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) probability that a static object reflected each beam.
        options: see ObjectOptions.
    """
    # a scan's stamps may go backwards where clocks jump; time does not
    seconds = np.maximum.accumulate(1e-9 * (recording.stamp_ns - recording.stamp_ns[:1]))
    scratch = recording.scratch
    scans, beams = ArrayBuilder(np.intp, (), scratch), ArrayBuilder(np.intp, (), scratch)
    ends, distances = ArrayBuilder(np.float64, (2,), scratch), ArrayBuilder(np.float64, (), scratch)
    clusters, count = ArrayBuilder(np.intp, (), scratch), np.zeros(recording.n_scans + 1, np.intp)
    last = _NOTHING
    for block in arrays.iter_blocks(recording.hit, p_static):
        dynamic = recording.hit[block] & (p_static[block] <= 1.0 - options.dynamic)
        beam = block.start + np.flatnonzero(dynamic)
        if len(beam) == 0:
            continue
        scan, xy = recording.scans_of(beam), recording.end_points(beam, poses)
        distance = np.linalg.norm(recording.points[beam].astype(np.float64), axis=1)
        cluster = _clusters(scan, xy, distance, options, last)
        last = scan[-1:], xy[-1:], distance[-1:], int(cluster[-1])
        for column, part in (
            (scans, scan), (beams, beam), (ends, xy), (distances, distance), (clusters, cluster)
        ):  # fmt: skip
            column.append(part)
        count[scan[0] + 1 : scan[-1] + 2] += np.bincount(scan - scan[0])
    return DynamicPoints(
        seconds,
        scans.finished(),
        beams.finished(),
        ends.finished(),
        distances.finished(),
        recording.T_map_sensor(poses)[:, :2, 2],
        clusters.finished(),
        np.cumsum(count),
        scratch,
    )


def _clusters(
    scan: Index,
    xy: Float,
    distance: Float,
    options: ObjectOptions,
    last: _Last = _NOTHING,
) -> Index:
    """(N,) a new number where the next end point is of another scan, or too far off.

    `last` are scan, place, distance and number of the point before these, if there is one.
    """
    new = len(scan)
    scan = np.concatenate([last[0], scan])
    xy, distance = np.concatenate([last[1], xy]), np.concatenate([last[2], distance])
    step = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    wide = options.link + options.link_slope * np.minimum(distance[1:], distance[:-1])
    begins = (np.diff(scan) > 0) | (step > wide)
    if len(scan) == new:  # the first of all
        begins = np.concatenate([[True], begins])
    return last[-1] + np.cumsum(begins)
