"""Encounters: where two tracks come so near that they may exchange their points.

There both are cut. What is seen of them before and after says who is who (`joins.py`), and the
points in between go to the nearest path. Tracks are cut at gaps as well.
"""

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from stillmap.tracking.association import HORIZON, regress_velocity
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.detections import Centroids, find_near_pairs

Float = NDArray[np.float64]
Index = NDArray[np.intp]

NO_PIECE = -1
_NEAR = 0.6  # m between the centroids of two tracks: less than between people who pass
_MAX_DURATION = 3.0  # s: who stays together for longer keeps his track
_MAX_PAUSE = 0.41  # s within one encounter
_MAX_GAP = 0.5  # s within a piece
_CLAIM = 0.6  # m from a path to its points
_REACH = 1.0  # s by which a path extends at constant velocity
_REST_TIME = 0.3  # s, see regress_velocity


def cut_tracks(found: Centroids, seconds: Float, whole: Index) -> Index:
    """(L,) numbers of the pieces that centroids are of, rising; -1 in encounters.

    Args:
        found: of all tracks.
        seconds: (T,) times of the scans.
        whole: tracks that are not cut.
    """
    t, may_be_cut = seconds[found.scan], ~np.isin(found.track, whole)
    near = np.zeros(len(t), bool)
    near[find_near_pairs(found.scan, found.xy, _NEAR).ravel()] = True
    near = _select_short_runs(np.flatnonzero(near & may_be_cut), found.track, t)
    begins = np.diff(found.track, prepend=-1) != 0
    begins |= np.diff(near, prepend=False)
    begins |= (np.diff(t, prepend=t[:1]) > _MAX_GAP) & may_be_cut
    pieces = np.cumsum(begins & ~near) - 1
    return np.where(near, NO_PIECE, pieces)


def _select_short_runs(at: Index, track: Index, t: Float) -> NDArray[np.bool_]:
    """(L,) which centroids lie within encounters; `at` (n,) are near others."""
    last = np.diff(track[at], append=-1) != 0
    last |= np.diff(t[at], append=np.inf) > _MAX_PAUSE
    first = np.roll(last, 1)
    low, high = at[first], at[last]
    short = t[high] - t[low] <= _MAX_DURATION
    steps = np.zeros(len(t) + 1, np.intp)
    steps[low[short]] += 1
    steps[high[short] + 1] -= 1
    return np.asarray(np.cumsum(steps[:-1]) > 0)


def assign_to_paths(points: DynamicPoints, rest: Index, found: Centroids, mover: Index) -> Index:
    """(n,) the mover whose path is nearest to each of some points, -1: none.

    Args:
        points: dynamic end points.
        rest: (n,) indices of points, rising.
        found: (L,) centroids outside of encounters.
        mover: (L,) whose they are.
    """
    scan, out = points.scan[rest], np.full(len(rest), -1)
    best = np.full(len(rest), _CLAIM**2)
    for number, t, xy in _iterate_paths(found, mover, points.seconds):
        reach = np.searchsorted(points.seconds, [t[0] - _REACH, t[-1] + _REACH])
        low, high = np.searchsorted(scan, reach).tolist()
        if low == high:
            continue
        here = slice(low, high)
        squared = points.xy[rest[here]] - _locate(points.seconds[scan[here]], t, xy)
        distance = (squared**2).sum(axis=1)
        nearer = np.flatnonzero(distance < best[here]) + low
        best[nearer], out[nearer] = distance[nearer - low], number
    return out


def _iterate_paths(
    found: Centroids, mover: Index, seconds: Float
) -> Iterator[tuple[int, Float, Float]]:
    """Yield each mover with its times and positions."""
    order = np.lexsort((found.scan, mover))
    cuts = np.flatnonzero(np.diff(mover[order])) + 1
    for part in np.split(order, cuts) if len(order) else []:
        yield int(mover[part[0]]), seconds[found.scan[part]], found.xy[part]


def _locate(seconds: Float, t: Float, xy: Float) -> Float:
    """(n, 2) positions at times (n,) on the path through (L, 2) at (L,)."""
    out = np.stack([np.interp(seconds, t, column) for column in xy.T], axis=-1)
    for outside, end, near in (
        (seconds < t[0], 0, t <= t[0] + HORIZON),
        (seconds > t[-1], -1, t >= t[-1] - HORIZON),
    ):
        if outside.any():
            velocity = regress_velocity(t[near], xy[near], _REST_TIME)
            out[outside] += (seconds[outside] - t[end])[:, None] * velocity
    return out
