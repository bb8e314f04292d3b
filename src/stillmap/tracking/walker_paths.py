"""Paths of walkers, with a circle about each, from tracks that certainly are movers."""

from collections.abc import Container, Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap.tracking.association import ACCELERATION
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.detections import compute_centroids, iterate_tracks
from stillmap.tracking.mover_path import MoverPath
from stillmap.tracking.objects import SMOOTHER_STD, estimate_center_offset
from stillmap.tracking.smoother import smooth_track

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_MIN_P_MOVER = 0.99  # what explains hits must be certain: clutter would make more of itself
_WIDTH = 0.5  # m, of a person
_MIN_TRAVEL, _MIN_LOOKS = 1.5, 5  # m, several times that; looks


def iterate_walker_paths(
    points: DynamicPoints, owner: Index, p_mover: Float, others: Container[int]
) -> Iterator[tuple[int, MoverPath]]:
    """Yield tracks that are certainly movers and went somewhere, and their paths.

    Args:
        points: dynamic end points.
        owner: (N,) their tracks.
        p_mover: (K,) by track.
        others: tracks that are left out.
    """
    for track, here in iterate_tracks(points, owner):
        if track in others or p_mover[track] <= _MIN_P_MOVER:
            continue
        found = compute_centroids(points, owner, here)
        scan, xy = found.scan, found.xy
        if len(scan) < _MIN_LOOKS or np.linalg.norm(np.ptp(xy, axis=0)) < _MIN_TRAVEL:
            continue
        at = np.searchsorted(scan, points.scan[here])
        center = xy + estimate_center_offset(xy, points.sensor[scan], points.xy[here], at)
        t = points.seconds[scan]
        smooth = smooth_track(t, center, SMOOTHER_STD, ACCELERATION)
        yield track, MoverPath(t, *smooth, _WIDTH, _WIDTH, is_round=True)
