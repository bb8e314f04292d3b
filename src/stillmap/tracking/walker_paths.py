"""Paths of walkers, with a circle about each, from tracks that certainly are movers."""

from collections.abc import Container, Iterator

import numpy as np

from stillmap.core.array_types import Float, Index
from stillmap.tracking.association import ACCELERATION
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.detections import compute_centroids, iterate_tracks
from stillmap.tracking.mover_path import MoverPath
from stillmap.tracking.objects import SMOOTHER_STD, estimate_center_offset
from stillmap.tracking.vehicle_filter import smooth_track

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


_WINDOW, _MIN_WINDOW_SCANS = 1.5, 5  # s, and detections at least
_OVERLAP = 3  # windows that begin within one
_MAX_GAP = 0.5  # s without a detection
_MIN_WINDOW_TRAVEL = 0.5  # m
_SCATTER, _RELATIVE_SCATTER = 0.03, 0.15  # m off the line (rms), and more as share of the travel


def count_steady_windows(t: Float, xy: Float, period: float) -> tuple[float, float]:
    """Windows along a track, and those in which it moves along a line at constant velocity.

    Windows overlap; their number is divided by how many do, so that they count as independent.

    Args:
        t: (L,) seconds, rising.
        xy: (L, 2) metres.
        period: seconds from scan to scan.
    """
    length, max_gap = max(_WINDOW, _MIN_WINDOW_SCANS * period), max(_MAX_GAP, 1.5 * period)
    start = np.arange(t[0], t[-1] - length + 1e-6, length / _OVERLAP)
    if not len(start):
        return 0.0, 0.0
    low, high = np.searchsorted(t, start), np.searchsorted(t, start + length, side="right")
    enough = high - low >= _MIN_WINDOW_SCANS
    start, low, high = start[enough], low[enough], high[enough]
    breaks = np.concatenate([[0], np.cumsum(np.diff(t) > max_gap)])
    whole = breaks[high - 1] == breaks[low]
    whole &= (t[low] - start <= max_gap) & (start + length - t[high - 1] <= max_gap)
    speed, scatter = _fit_lines(t - t[0], xy - xy[0], low, high)
    travel = speed * length
    steady = (travel >= _MIN_WINDOW_TRAVEL) & (scatter <= _SCATTER + _RELATIVE_SCATTER * travel)
    return len(enough) / _OVERLAP, float(np.count_nonzero(whole & steady)) / _OVERLAP


def _fit_lines(t: Float, xy: Float, low: Index, high: Index) -> tuple[Float, Float]:
    """Speed and rms distance (W,) of lines through detections low to high, over time."""
    terms = np.column_stack([t, t * t, xy, t[:, None] * xy, (xy**2).sum(axis=1)])
    sums = np.concatenate([np.zeros((1, terms.shape[1])), np.cumsum(terms, axis=0)])
    of, n = sums[high] - sums[low], high - low
    spread = np.maximum(of[:, 1] - of[:, 0] ** 2 / n, 1e-9)  # sum (t - mean t)^2
    moment = of[:, 4:6] - of[:, :1] * of[:, 2:4] / n[:, None]
    squares = of[:, 6] - (of[:, 2:4] ** 2).sum(axis=1) / n - (moment**2).sum(axis=1) / spread
    return np.linalg.norm(moment, axis=1) / spread, np.sqrt(np.maximum(squares, 0.0) / n)
