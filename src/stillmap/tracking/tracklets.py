"""Tracklet stitching: merge tracks of parts of one object, join tracks across occlusions."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.core.components import component_labels, group_indices
from stillmap.em.people_tracker import MIN_TRACK_SCANS
from stillmap.tracking.association import ACCELERATION, HORIZON, regress_velocity
from stillmap.tracking.clustering import DynamicPoints

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_MIN_DURATION = 0.6  # s from the first to the last detection of a confirmed track
_PAIR_DISTANCE = 0.55  # m between two tracks that always move together: legs
_MIN_SHARED = 0.7  # share of the shorter one's scans in which they do
_MAX_STITCH_GAP = 3.0  # s
_CHI2 = 9.0  # gate of position and velocity at a gap
_END_STD, _END_SPEED_STD = 0.2, 0.3  # m and m/s, of the ends of tracks
_NO_MATCH = 1e6  # cost of a pair outside the gate
_MAX_ENDS = 1 << 12  # ends of tracks compared at once
_REST_TIME = 0.15  # s: shrinks the speed of few detections towards 0


class Centroids(NamedTuple):
    """Mean end point of each track in each scan, in the order of tracks, then scans.

    Attributes:
        track: (L,) track numbers.
        scan: (L,) of the recording.
        xy: (L, 2) mean of the end points, in the map frame.
    """

    track: Index
    scan: Index
    xy: Float


def compute_centroids(points: DynamicPoints, owner: Index, here: slice | Index) -> Centroids:
    """Centroids of some points, all or none of a scan; points without a track (-1) are left out."""
    track, scan, xy = owner[here], points.scan[here], points.xy[here]
    own = np.flatnonzero(track >= 0)
    order = own[np.lexsort((scan[own], track[own]))]
    track, scan = track[order], scan[order]
    begins = np.flatnonzero(np.diff(track, prepend=-1) | np.diff(scan, prepend=-1))
    count = np.diff(begins, append=len(order))
    sums = np.add.reduceat(xy[order], begins) if len(begins) else np.zeros((0, 2))
    return Centroids(track[begins], scan[begins], sums / count[:, None])


def iterate_tracks(points: DynamicPoints, owner: Index) -> Iterator[tuple[int, Index]]:
    """Yield each track number, rising, with its points, rising; in bounded memory."""
    count = np.zeros(_count_tracks(owner), np.intp)
    for block in arrays.iter_blocks(owner):
        count += np.bincount(owner[block][owner[block] >= 0], minlength=len(count))
    first = np.cumsum(count) - count
    order = arrays.empty((int(count.sum()),), np.intp, points.scratch)
    free = first.copy()
    for block in arrays.iter_blocks(owner, order):
        own = np.flatnonzero(owner[block] >= 0)
        own = own[np.argsort(owner[block][own], kind="stable")]
        track = owner[block][own]
        begins = np.flatnonzero(np.diff(track, prepend=-1))
        runs = np.diff(begins, append=len(track))
        at = np.repeat(free[track[begins]] - begins, runs) + np.arange(len(track))
        order[at] = block.start + own
        free[track[begins]] += runs
    read = 0
    for k in np.flatnonzero(count).tolist():
        yield k, np.array(order[first[k] : first[k] + count[k]])
        read += count[k]
        if read > arrays.BLOCK:
            points.release(owner, order)
            read = 0


def _count_tracks(owner: Index) -> int:
    """The largest track number + 1."""
    return max((int(owner[b].max()) for b in arrays.iter_blocks(owner)), default=-1) + 1


def _scan_blocks(points: DynamicPoints, *beside: Index) -> Iterator[slice]:
    """Slices of points of whole scans; their cached pages are released afterwards."""
    first, at = points.first, 0
    while at < len(points.scan):
        end = first[np.searchsorted(first, at + arrays.BLOCK, side="right") - 1]
        if end <= at:  # one scan alone
            end = first[np.searchsorted(first, at, side="right")]
        yield slice(at, int(end))
        points.release(*beside)
        at = int(end)


def _renumber(points: DynamicPoints, owner: Index, new_number: Callable[[Index], Index]) -> Index:
    """(N,) track numbers replaced block by block."""
    out = arrays.empty(owner.shape, np.intp, points.scratch)
    for block in arrays.iter_blocks(owner, out):
        out[block] = new_number(owner[block])
    return out


def stitch_tracklets(points: DynamicPoints, owner: Index) -> Index:
    """(N,) track numbers after stitching; -1: of no confirmed track.

    Args:
        points: dynamic end points.
        owner: (N,) track numbers from `assign_tracks`.
    """
    return _confirm(points, join_tracklets(points, owner))


def join_tracklets(points: DynamicPoints, owner: Index) -> Index:
    """(N,) track numbers after parts of one object were joined, at one time and across gaps.

    Args: see `stitch_tracklets`.
    """
    return _join_across_gaps(points, _merge_pairs(points, owner))


def _merge_pairs(points: DynamicPoints, owner: Index) -> Index:
    """Merge tracks that always move together, nearer than people do: legs tracked apart."""
    parts, scans = list[tuple[Index, Index]](), np.zeros(_count_tracks(owner), np.intp)
    for here in _scan_blocks(points, owner):
        found = compute_centroids(points, owner, here)
        pairs = np.sort(found.track[_near_pairs(found.scan, found.xy, _PAIR_DISTANCE)], axis=1)
        parts.append(np.unique(pairs, axis=0, return_counts=True))
        scans += np.bincount(found.track, minlength=len(scans))
    tracks, which = np.unique(
        np.concatenate([pairs for pairs, _ in parts]), axis=0, return_inverse=True
    )
    if len(tracks) == 0:
        return owner
    count = np.zeros(len(tracks), np.intp)
    np.add.at(count, which.reshape(-1), np.concatenate([count for _, count in parts]))
    together = count >= _MIN_SHARED * scans[tracks].min(axis=1)
    label = component_labels(tracks[together], len(scans))
    _, first, which = np.unique(label, return_index=True, return_inverse=True)
    merged = first[which]
    return _renumber(points, owner, lambda old: merged[old])


def _near_pairs(scan: Index, xy: Float, max_distance: float) -> Index:
    """(P, 2) pairs of positions (K, 2) of the same scan within a distance of each other.

    The k-th and the (k + shift)-th position by scan are compared for every shift, of which there
    are as many as positions in one scan.
    """
    order = np.argsort(scan, kind="stable")
    scan, xy = scan[order], xy[order]
    parts, shift = [np.empty((0, 2), np.intp)], 1
    while (first := np.flatnonzero(scan[shift:] == scan[:-shift])).size:
        near = ((xy[first + shift] - xy[first]) ** 2).sum(axis=1) <= max_distance**2
        parts.append(np.column_stack([first, first + shift])[near])
        shift += 1
    return order[np.concatenate(parts)]


def _join_across_gaps(points: DynamicPoints, owner: Index) -> Index:
    """Join tracks that end with tracks that begin later, by least total cost."""
    tracks, ends = _track_ends(points, owner)
    before, after, cost = _candidates(ends)
    if len(before) == 0:
        return owner
    label = component_labels(np.column_stack([before, after + len(tracks)]), 2 * len(tracks))
    follows = np.arange(len(tracks))  # itself: nothing precedes it
    for group in group_indices(label[before]):
        rows, i = np.unique(before[group], return_inverse=True)
        columns, j = np.unique(after[group], return_inverse=True)
        costs = np.full((len(rows), len(columns)), _NO_MATCH)
        costs[i, j] = cost[group]
        for r, c in zip(*_assign(costs), strict=True):
            if costs[r, c] < _NO_MATCH:
                follows[columns[c]] = rows[r]
    for k in np.argsort(ends.first, kind="stable").tolist():
        follows[k] = k if follows[k] == k else follows[follows[k]]
    return _renumber(
        points,
        owner,
        lambda old: np.where(old >= 0, tracks[follows[np.searchsorted(tracks, old)]], -1),
    )


def _assign(costs: Float) -> tuple[Index, Index]:
    """Rows and columns of a matching (n, m) of least total cost, of min(n, m) pairs.

    Where the cheapest columns of all rows differ, they are the solution; else SciPy finds it.
    """
    if costs.shape[0] > costs.shape[1]:
        columns, rows = _assign(costs.T)
        return rows, columns
    cheapest = costs.argmin(axis=1)
    if len(np.unique(cheapest)) == len(cheapest):
        return np.arange(len(cheapest)), cheapest
    from scipy.optimize import linear_sum_assignment  # takes long to load

    return linear_sum_assignment(costs)


class _Ends(NamedTuple):
    """First and last time (K,), position (K, 2) and velocity (K, 2) of K tracks."""

    first: Float
    first_xy: Float
    first_v: Float
    last: Float
    last_xy: Float
    last_v: Float


def _track_ends(points: DynamicPoints, owner: Index) -> tuple[Index, _Ends]:
    """Track numbers (K,), and the tracks' ends."""
    tracks, rows = [], []
    for track, here in iterate_tracks(points, owner):
        found = compute_centroids(points, owner, here)
        t, xy = points.seconds[found.scan], found.xy
        tracks.append(track)
        first, last = t <= t[0] + HORIZON, t >= t[-1] - HORIZON
        rows.append((t[0], *_fit_line(t[first] - t[0], xy[first])))
        rows.append((t[-1], *_fit_line(t[last] - t[-1], xy[last])))
    t, x, v = (np.array(column) for column in zip(*rows, strict=True))
    return np.array(tracks), _Ends(t[::2], x[::2], v[::2], t[1::2], x[1::2], v[1::2])


def _fit_line(t: Float, xy: Float) -> tuple[Float, Float]:
    """Position at time 0 and velocity of the line through (n, 2), shrunk towards rest."""
    v = regress_velocity(t, xy, _REST_TIME)
    return xy.mean(axis=0) - v * t.mean(), v


def _candidates(ends: _Ends) -> tuple[Index, Index, Float]:
    """Pairs of tracks that may be one across a gap, and their costs: -2 ln likelihood."""
    order = np.argsort(ends.first, kind="stable")
    parts = []
    for some in range(0, len(order), _MAX_ENDS):
        k = np.arange(some, min(some + _MAX_ENDS, len(order)))
        until = ends.last[k] + _MAX_STITCH_GAP
        low = np.searchsorted(ends.first[order], ends.last[k], side="right")
        high = np.searchsorted(ends.first[order], until, side="right")
        after = order[np.concatenate([np.arange(a, b) for a, b in zip(low, high, strict=True)])]
        parts.append(_gate(ends, np.repeat(k, high - low), after))
    before, after, cost = (np.concatenate(part) for part in zip(*parts, strict=True))
    return before, after, cost


def _gate(ends: _Ends, before: Index, after: Index) -> tuple[Index, Index, Float]:
    """The pairs within the gate, and their costs."""
    gap = ends.first[after] - ends.last[before]
    half = 0.5 * gap[:, None]
    d = ends.last_xy[before] + half * ends.last_v[before]
    d = d - (ends.first_xy[after] - half * ends.first_v[after])
    q = ACCELERATION
    variance = _END_STD**2 + (_END_SPEED_STD * gap) ** 2 + q * gap**3 / 12.0
    dv = ends.last_v[before] - ends.first_v[after]
    speed_variance = 2.0 * (2.0 * _END_SPEED_STD**2 + q * gap)  # twice: speeds at ends are rough
    chi2 = (d**2).sum(axis=1) / variance + (dv**2).sum(axis=1) / speed_variance
    fits = chi2 < _CHI2
    cost = chi2 + 2.0 * np.log(variance / _END_STD**2)
    return before[fits], after[fits], cost[fits]


def _confirm(points: DynamicPoints, owner: Index) -> Index:
    """Set the points of tracks that are too short to -1."""
    n = _count_tracks(owner)
    if n == 0:
        return owner
    scans, first, last = np.zeros(n, np.intp), np.full(n, np.inf), np.full(n, -np.inf)
    for here in _scan_blocks(points, owner):
        found = compute_centroids(points, owner, here)
        scans += np.bincount(found.track, minlength=n)
        np.minimum.at(first, found.track, points.seconds[found.scan])
        np.maximum.at(last, found.track, points.seconds[found.scan])
    duration = np.subtract(last, first, out=np.zeros(n), where=scans > 0)
    confirmed = (scans >= MIN_TRACK_SCANS) & (duration >= _MIN_DURATION)
    return _renumber(points, owner, lambda old: np.where((old >= 0) & confirmed[old], old, -1))
