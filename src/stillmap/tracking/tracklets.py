"""Pieces of tracks put together: parts of one thing, and a thing before and after it was hidden."""

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.options import ObjectOptions

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_HORIZON = 1.0  # s at either end of a track that tell its velocity
_CHI2 = 9.0  # two ways fit together below
_SIGMA, _SIGMA_SPEED = 0.2, 0.3  # m and m/s, of the ends of tracks
_TOGETHER = 0.7  # share of the shorter one's scans that two things go together: one thing
_NEVER = 1e6  # cost of what does not fit at all
_TOGETHER_ENDS = 1 << 12  # ends of tracks that are looked at together
_STANDING = 0.15  # s by which few points are taken to stand still


class Centroids(NamedTuple):
    """Where things are in each scan that sees them; in the order of things, then scans.

    Attributes:
        thing: (L,) numbers.
        scan: (L,) of the recording.
        xy: (L, 2) mean of the end points, in the map frame.
        ends: (L,) how many end points.
    """

    track: Index
    scan: Index
    xy: Float
    count: Index


def compute_centroids(points: DynamicPoints, owner: Index, here: slice | Index) -> Centroids:
    """Where things are by some points, all or none of a scan; those of nobody (-1) are left out."""
    thing, scan, xy = owner[here], points.scan[here], points.xy[here]
    own = np.flatnonzero(thing >= 0)
    order = own[np.lexsort((scan[own], thing[own]))]
    thing, scan = thing[order], scan[order]
    begins = np.flatnonzero(np.diff(thing, prepend=-1) | np.diff(scan, prepend=-1))
    count = np.diff(begins, append=len(order))
    sums = np.add.reduceat(xy[order], begins) if len(begins) else np.zeros((0, 2))
    return Centroids(thing[begins], scan[begins], sums / count[:, None], count)


def iterate_tracks(points: DynamicPoints, owner: Index) -> Iterator[tuple[int, Index]]:
    """Each thing's number, rising, and its points, rising."""
    count = np.zeros(0, np.intp)
    for block in arrays.iter_blocks(owner):
        here = np.bincount(owner[block][owner[block] >= 0], minlength=len(count))
        here[: len(count)] += count
        count = here
    first = np.cumsum(count) - count
    order = arrays.empty((int(count.sum()),), np.intp, points.scratch)
    free = first.copy()
    for block in arrays.iter_blocks(owner, order):
        own = np.flatnonzero(owner[block] >= 0)
        own = own[np.argsort(owner[block][own], kind="stable")]
        thing = owner[block][own]
        begins = np.flatnonzero(np.diff(thing, prepend=-1))
        runs = np.diff(begins, append=len(thing))
        at = np.repeat(free[thing[begins]] - begins, runs) + np.arange(len(thing))
        order[at] = block.start + own
        free[thing[begins]] += runs
    seen = 0
    for k in np.flatnonzero(count).tolist():
        yield k, np.array(order[first[k] : first[k] + count[k]])
        seen += count[k]
        if seen > arrays.BLOCK:
            points.release(owner, order)
            seen = 0


def _blocks(points: DynamicPoints, *beside: Index) -> Iterator[slice]:
    """Slices of points, of whole scans; what was looked at is let go."""
    first, at = points.first, 0
    while at < len(points.scan):
        end = first[np.searchsorted(first, at + arrays.BLOCK, side="right") - 1]
        if end <= at:  # one scan alone
            end = first[np.searchsorted(first, at, side="right")]
        yield slice(at, int(end))
        points.release(*beside)
        at = int(end)


def _renamed(points: DynamicPoints, owner: Index, name: Callable[[Index], Index]) -> Index:
    """(N,) other numbers for the things."""
    out = arrays.empty(owner.shape, np.intp, points.scratch)
    for block in arrays.iter_blocks(owner, out):
        out[block] = name(owner[block])
    return out


def stitch_tracklets(points: DynamicPoints, owner: Index, options: ObjectOptions) -> Index:
    """(N,) numbers of things after pieces of one thing have become one; -1: of nothing.

    Args:
        points: what moves.
        owner: (N,) numbers as `followed` gives them.
        options: see ObjectOptions.
    """
    owner = _side_by_side(points, owner, options)
    owner = _one_after_the_other(points, owner, options)
    return _confirmed(points, owner, options)


def _side_by_side(points: DynamicPoints, owner: Index, options: ObjectOptions) -> Index:
    """Things that always go together, nearer than people do: legs that were taken for two."""
    from scipy.spatial import KDTree  # takes long to load

    parts, scans = list[tuple[Index, Index]](), np.zeros(0, np.intp)
    for here in _blocks(points, owner):
        found = compute_centroids(points, owner, here)
        # one more axis keeps scans apart
        apart = np.column_stack([found.xy, 100.0 * max(options.beside, 1.0) * found.scan])
        pairs = KDTree(apart).query_pairs(options.beside, output_type="ndarray")
        pairs = np.sort(found.track[pairs], axis=1)
        parts.append(np.unique(pairs, axis=0, return_counts=True))
        scans = _added(scans, np.bincount(found.track))
    things, which = np.unique(
        np.concatenate([pairs for pairs, _ in parts]), axis=0, return_inverse=True
    )
    if len(things) == 0:
        return owner
    count = np.zeros(len(things), np.intp)
    np.add.at(count, which.reshape(-1), np.concatenate([count for _, count in parts]))
    one = count >= _TOGETHER * scans[things].min(axis=1)
    first = _first_of_each(_components(things[one], len(scans)))
    return _renamed(points, owner, lambda old: first[old])


def _added(one: Index, other: Index) -> Index:
    """Sums of counts, of which the shorter ones end in zeros."""
    out = np.zeros(max(len(one), len(other)), np.intp)
    out[: len(one)] += one
    out[: len(other)] += other
    return out


def _one_after_the_other(points: DynamicPoints, owner: Index, options: ObjectOptions) -> Index:
    """Things that were hidden for a while, and seen again where they were going."""
    from scipy.optimize import linear_sum_assignment  # takes long to load

    things, ends = _ends(points, owner)
    before, after, cost = _candidates(ends, options)
    if len(before) == 0:
        return owner
    pairs = np.column_stack([before, after + len(things)])
    label = _components(pairs, 2 * len(things))
    follows = np.arange(len(things))  # itself: nothing comes before it
    for group in _groups(label[before]):
        rows, i = np.unique(before[group], return_inverse=True)
        columns, j = np.unique(after[group], return_inverse=True)
        costs = np.full((len(rows), len(columns)), _NEVER)
        costs[i, j] = cost[group]
        for r, c in zip(*linear_sum_assignment(costs), strict=True):
            if costs[r, c] < _NEVER:
                follows[columns[c]] = rows[r]
    for k in np.argsort(ends.first, kind="stable").tolist():
        follows[k] = k if follows[k] == k else follows[follows[k]]
    return _renamed(
        points,
        owner,
        lambda old: np.where(old >= 0, things[follows[np.searchsorted(things, old)]], -1),
    )


class _Ends(NamedTuple):
    """The ends of K tracks: (K,) when, (K, 2) where, (K, 2) how fast."""

    first: Float
    first_xy: Float
    first_v: Float
    last: Float
    last_xy: Float
    last_v: Float


def _ends(points: DynamicPoints, owner: Index) -> tuple[Index, _Ends]:
    """Numbers of the things (K,), and their ends."""
    things, rows = [], []
    for thing, here in iterate_tracks(points, owner):
        found = compute_centroids(points, owner, here)
        t, xy = points.seconds[found.scan], found.xy
        things.append(thing)
        first, last = t <= t[0] + _HORIZON, t >= t[-1] - _HORIZON
        rows.append((t[0], *_line(t[first] - t[0], xy[first])))
        rows.append((t[-1], *_line(t[last] - t[-1], xy[last])))
    t, x, v = (np.array(column) for column in zip(*rows, strict=True))
    return np.array(things), _Ends(t[::2], x[::2], v[::2], t[1::2], x[1::2], v[1::2])


def _line(t: Float, xy: Float) -> tuple[Float, Float]:
    """Where a thing is at 0, and its velocity: a straight line through (n, 2), drawn to rest."""
    off = t - t.mean()
    v = (off[:, None] * (xy - xy.mean(axis=0))).sum(axis=0) / ((off**2).sum() + _STANDING**2)
    return xy.mean(axis=0) - v * t.mean(), v


def _candidates(ends: _Ends, options: ObjectOptions) -> tuple[Index, Index, Float]:
    """Tracks that one may be the other's end, and what it costs: -2 ln of how well they fit."""
    order = np.argsort(ends.first, kind="stable")
    parts = []
    for some in range(0, len(order), _TOGETHER_ENDS):
        k = np.arange(some, min(some + _TOGETHER_ENDS, len(order)))
        until = ends.last[k] + options.gap_between
        low = np.searchsorted(ends.first[order], ends.last[k], side="right")
        high = np.searchsorted(ends.first[order], until, side="right")
        after = order[np.concatenate([np.arange(a, b) for a, b in zip(low, high, strict=True)])]
        parts.append(_fitting(ends, np.repeat(k, high - low), after, options))
    before, after, cost = (np.concatenate(part) for part in zip(*parts, strict=True))
    return before, after, cost


def _fitting(
    ends: _Ends, before: Index, after: Index, options: ObjectOptions
) -> tuple[Index, Index, Float]:
    """Those of the pairs that fit, and what they cost."""
    hidden = ends.first[after] - ends.last[before]
    half = 0.5 * hidden[:, None]
    d = ends.last_xy[before] + half * ends.last_v[before]
    d = d - (ends.first_xy[after] - half * ends.first_v[after])
    q = options.acceleration
    variance = _SIGMA**2 + (_SIGMA_SPEED * hidden) ** 2 + q * hidden**3 / 12.0
    faster = ends.last_v[before] - ends.first_v[after]
    of_speed = 2.0 * (2.0 * _SIGMA_SPEED**2 + q * hidden)  # twice: speeds at ends are rough
    chi2 = (d**2).sum(axis=1) / variance + (faster**2).sum(axis=1) / of_speed
    fits = chi2 < _CHI2
    cost = chi2 + 2.0 * np.log(variance / _SIGMA**2)
    return before[fits], after[fits], cost[fits]


def _confirmed(points: DynamicPoints, owner: Index, options: ObjectOptions) -> Index:
    """Things that were seen for long enough; -1 for all others."""
    scans = np.zeros(0, np.intp)
    first, last = np.full(0, np.inf), np.full(0, -np.inf)
    for here in _blocks(points, owner):
        found = compute_centroids(points, owner, here)
        scans = _added(scans, np.bincount(found.track))
        more = len(scans) - len(first)
        first = np.concatenate([first, np.full(more, np.inf)])
        last = np.concatenate([last, np.full(more, -np.inf)])
        np.minimum.at(first, found.track, points.seconds[found.scan])
        np.maximum.at(last, found.track, points.seconds[found.scan])
    if len(scans) == 0:
        return owner
    lasted = np.subtract(last, first, out=np.zeros(len(scans)), where=scans > 0)
    enough = (scans >= options.least_scans) & (lasted >= options.least_seconds)
    return _renamed(points, owner, lambda old: np.where((old >= 0) & enough[old], old, -1))


def _components(pairs: Index, n: int) -> Index:
    """(n,) labels: the same for all that pairs (P, 2) connect."""
    from scipy import sparse
    from scipy.sparse import csgraph  # take long to load

    ones: NDArray[np.float64] = np.ones(len(pairs))
    graph: sparse.csr_array[np.float64] = sparse.csr_array((ones, pairs.T), shape=(n, n))
    return np.asarray(csgraph.connected_components(graph, directed=False)[1], np.intp)


def _groups(label: Index) -> list[Index]:
    """Indices of equal labels."""
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


def _first_of_each(label: Index) -> Index:
    """(K,) the first of those with the same label."""
    _, first, which = np.unique(label, return_index=True, return_inverse=True)
    return first[which]
