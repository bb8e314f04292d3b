"""End points of beams that something moving reflected."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.objects.options import ObjectOptions
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Index = NDArray[np.intp]


@dataclass(frozen=True, eq=False)
class MovingPoints:
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
    """

    seconds: Float
    scan: Index
    beam: Index
    xy: Float
    range: Float
    sensor: Float
    cluster: Index
    first: Index


def moving_points(
    recording: Recording, poses: Float, p_static: NDArray[np.float32], options: ObjectOptions
) -> MovingPoints:
    """The hits that are dynamic as probably as `options.dynamic`, and which belong together.

    Args:
        recording: 2D; M beams, without motion during scans.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) probability that a static object reflected each beam.
        options: see ObjectOptions.
    """
    # a scan's stamps may go backwards where clocks jump; time does not
    seconds = np.maximum.accumulate(1e-9 * (recording.stamp_ns - recording.stamp_ns[:1]))
    beam = np.flatnonzero(recording.hit & (p_static <= 1.0 - options.dynamic))
    scan, xy = recording.scans_of(beam), recording.end_points(beam, poses)
    distance = np.linalg.norm(recording.points[beam].astype(np.float64), axis=1)
    return MovingPoints(
        seconds,
        scan,
        beam,
        xy,
        distance,
        recording.T_map_sensor(poses)[:, :2, 2],
        _clusters(scan, xy, distance, options),
        np.searchsorted(scan, np.arange(recording.n_scans + 1)),
    )


def _clusters(scan: Index, xy: Float, distance: Float, options: ObjectOptions) -> Index:
    """(N,) a new number where the next end point is of another scan, or too far off."""
    step = np.linalg.norm(np.diff(xy, axis=0), axis=1)
    wide = options.link + options.link_slope * np.minimum(distance[1:], distance[:-1])
    begins = (np.diff(scan) > 0) | (step > wide)
    return np.concatenate([np.zeros(min(len(scan), 1), np.intp), np.cumsum(begins)])
