"""Moving things followed from scan to scan: which end point is of which thing.

Two things that were taken for one: seen apart at last, they are told apart back in time.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, kalman
from stillmap.core.kalman import TrackStates
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.options import ObjectOptions

Float = NDArray[np.float64]

Index = NDArray[np.intp]

BACK = 6.0  # s that it is gone back in time

_MISSED = 1.0  # s without any point after which one of them was not there yet

_HORIZON = 1.0  # s of points that tell a velocity

_STANDING = 0.3  # s by which few points are taken to stand still

_REACH = 0.45  # m from the middle of a thing to its points


@dataclass(frozen=True, eq=False)
class TrackSplit:
    """Points of who was there first, and of the other; in the scan, and before."""

    older_current: Index
    older_past: Index
    newer_current: Index
    newer_past: Index


def split_track(
    points: DynamicPoints, owned: Index, one: Index, other: Index, options: ObjectOptions
) -> TrackSplit:
    """Whose the points of a thing were before it was seen to be two.

    Args:
        points: what moves.
        owned: points of the thing in earlier scans, rising.
        one, other: points of either in the scan where they are seen apart.
        options: see ObjectOptions.
    """
    xy, seconds = points.xy, points.seconds[points.scan]
    at = float(seconds[one[0]])
    middles = np.array([xy[one].mean(axis=0), xy[other].mean(axis=0)])
    motion = kalman.initialize(middles, options.sigma, options.sigma_speed)
    seen = np.array([at, at])
    shares: tuple[list[Index], list[Index]] = ([owned[:0]], [owned[:0]])
    owned = owned[seconds[owned] > at - BACK]
    for here in np.split(owned, np.flatnonzero(np.diff(points.scan[owned])) + 1)[::-1]:
        if len(here) == 0 or (seen - seconds[here[0]] > _MISSED).any():
            break
        motion = kalman.predict(motion, seconds[here[0]] - at, options.acceleration)
        at = float(seconds[here[0]])
        share = _shared(xy[here], motion)
        count = np.bincount(share, minlength=2)
        sums = np.array([xy[here[share == i]].sum(axis=0) for i in (0, 1)])
        means = sums / np.maximum(count, 1)[:, None]
        motion = kalman.update(motion, count > 0, means, options.sigma)
        seen[count > 0] = at
        for i in (0, 1):
            shares[i].append(here[share == i])
    before = [np.concatenate(share) for share in shares]
    if seen[1] < seen[0]:
        return TrackSplit(other, before[1], one, before[0])
    return TrackSplit(one, before[0], other, before[1])


def _shared(xy: Float, motion: kalman.TrackStates) -> Index:
    """(n,) to which of two each point is nearer; neither gets any where none is near to it."""
    distance = np.linalg.norm(xy[:, None] - motion.x, axis=-1)
    share: Index = distance.argmin(axis=1)
    for i in (0, 1):
        mine = share == i
        if mine.any() and distance[mine, i].min() > _REACH + 2.0 * motion.sigma[i]:
            share[mine] = 1 - i
    return share


def estimate_velocity(points: DynamicPoints, before: Index, now: float) -> Float:
    """(2,) m/s of the points of a thing in the last second; 0 where there are too few."""
    seconds = points.seconds[points.scan[before]]
    before, seconds = before[seconds > now - _HORIZON], seconds[seconds > now - _HORIZON]
    if len(before) < 2:
        return np.zeros(2)
    off = seconds - seconds.mean()
    xy = points.xy[before] - points.xy[before].mean(axis=0)
    return np.asarray((off[:, None] * xy).sum(axis=0) / ((off**2).sum() + _STANDING**2))


NO_TRACK = -1

_SHAPE = 100  # points that a shape has at most: more of them say no more

_PAIRS = 1 << 16  # distances that are looked at together: as many as a cache holds


def assign_tracks(points: DynamicPoints, options: ObjectOptions) -> Index:
    """(N,) numbers of things, from 0 in the order in which they were first seen.

    What a thing looked like of late, moved to where it is expected, claims the end points nearest
    to it; what nothing claims begins a new thing, one for each cluster.

    Args:
        points: what moves.
        options: see ObjectOptions.
    """
    following = _Following(points, options)
    scans = np.flatnonzero(np.diff(points.first)).tolist()
    for scan in arrays.release_periodically(scans, lambda: points.release(following.owner)):
        following.take(scan)
    return following.owner


class _Following:
    """Things as they are followed: their motion, and what was seen of them of late."""

    def __init__(self, points: DynamicPoints, options: ObjectOptions) -> None:
        self.owner = arrays.empty((len(points.scan),), np.intp, points.scratch)
        self._points, self._options = points, options
        self._now, self._count = 0.0, 0
        self._motion = kalman.initialize(np.zeros((0, 2)), 1.0, 1.0)
        self._id, self._last = np.zeros(0, np.intp), np.zeros(0)
        # what was seen of them: offsets from where they were, of which thing, when
        self._offset, self._of, self._when = np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0)

    def take(self, scan: int) -> None:
        """Goes on to a scan, and says whose its points are."""
        points, options = self._points, self._options
        here = np.arange(points.first[scan], points.first[scan + 1])
        dt, self._now = points.seconds[scan] - self._now, float(points.seconds[scan])
        self._forget(self._now - self._last <= options.gap)
        self._motion = kalman.predict(self._motion, dt, options.acceleration)
        claims = self._claims(here)
        for thing, kept, gone in find_splits(points, here, claims, options):
            claims[gone] = NO_TRACK
            self._tear(here, claims, thing, here[kept], here[gone])
        self._update(here, claims)
        self._begin(here, claims)
        self.owner[here] = self._id[claims]

    def _claims(self, here: Index) -> Index:
        """Which thing claims each point."""
        claims = np.full(len(here), NO_TRACK)
        if len(self._motion) == 0:
            return claims
        options, xy = self._options, self._points.xy[here]
        cluster = self._points.cluster[here] - self._points.cluster[here[0]]
        squared = self._squared_distances(xy)
        variance = options.sigma**2 + self._motion.P[:, 0]
        # a Gaussian on two axes has twice the logarithm: who was hidden would get too little back
        cost = squared / variance + np.log(variance)
        sigma = self._motion.sigma
        near = np.minimum(options.near + options.near_sigmas * sigma, options.farthest)
        claims = _cheapest(cost, squared < near**2)
        if (claims == NO_TRACK).any():
            found = np.bincount(claims[claims >= 0], minlength=len(sigma)) > 0
            taken = np.bincount(cluster[claims >= 0], minlength=cluster[-1] + 1) > 0
            far = np.minimum(options.far + options.near_sigmas * sigma, options.farthest)
            allowed = (squared < far**2) & ~found & ~taken[cluster][:, None]
            claims = np.where(claims == NO_TRACK, _cheapest(cost, allowed), claims)
            claims = _whole_clusters(claims, cluster, len(sigma))
        return claims

    def _squared_distances(self, xy: Float) -> Float:
        """(n, K) of points to what was seen of each thing, where that is expected now."""
        expected_x, expected_y = (self._motion.x[self._of] + self._offset).T
        begin = np.searchsorted(self._of, np.arange(len(self._motion)))
        out = np.empty((len(xy), len(begin)))
        step = max(1, _PAIRS // len(expected_x))
        for first in range(0, len(xy), step):  # a crowd right before the laser is large
            x, y = xy[first : first + step].T[:, :, None]
            squared = np.square(x - expected_x)
            squared += np.square(y - expected_y)
            out[first : first + step] = np.minimum.reduceat(squared, begin, axis=1)
        return out

    def _tear(self, here: Index, claims: Index, thing: int, kept: Index, gone: Index) -> None:
        """One thing turns out to be two: since when, and who of them was there before."""
        points = self._points
        first = points.first[np.searchsorted(points.seconds, self._now - BACK)]
        owned = first + np.flatnonzero(self.owner[first : here[0]] == self._id[thing])
        torn = split_track(points, owned, kept, gone, self._options)
        new = len(self._motion)
        for k, now, before in (
            (thing, torn.older_current, torn.older_past),
            (new, torn.newer_current, torn.newer_past),
        ):
            claims[np.isin(here, now)] = k
            self._set(k, now, estimate_velocity(points, before, self._now))
        self.owner[torn.newer_past] = self._id[new]

    def _set(self, k: int, now: Index, velocity: Float) -> None:
        """Thing k is where these points are; a new one if there is none of that number."""
        xy = self._points.xy[now]
        begun = kalman.initialize(
            xy.mean(axis=0)[None], self._options.sigma, self._options.sigma_speed
        )
        begun = TrackStates(begun.x, velocity[None], begun.P)
        if k == len(self._motion):
            self._append(begun)
        else:
            for ours, theirs in zip(_arrays(self._motion), _arrays(begun), strict=True):
                ours[k] = theirs[0]
        self._forget_shape(self._of != k)
        self._see(xy, np.full(len(now), k))

    def _update(self, here: Index, claims: Index) -> None:
        """Things are where their points are."""
        got = claims >= 0
        count = np.bincount(claims[got], minlength=len(self._motion))
        seen, xy = count > 0, self._points.xy[here][got]
        at = _means(xy, claims[got], count)
        self._motion = kalman.update(self._motion, seen, at, self._options.sigma)
        self._last[seen] = self._now
        # who is hidden keeps its shape
        self._forget_shape((self._now - self._when < self._options.shape) | ~seen[self._of])
        self._see(xy, claims[got])

    def _begin(self, here: Index, claims: Index) -> None:
        """What nobody claims: a new thing for each cluster."""
        free = claims == NO_TRACK
        if not free.any():
            return
        _, which = np.unique(self._points.cluster[here[free]], return_inverse=True)
        xy, first = self._points.xy[here[free]], len(self._motion)
        at = _means(xy, which, np.bincount(which))
        self._append(kalman.initialize(at, self._options.sigma, self._options.sigma_speed))
        claims[free] = first + which
        self._see(xy, claims[free])

    def _append(self, begun: TrackStates) -> None:
        self._motion = kalman.concatenate(self._motion, begun)
        numbers = self._count + np.arange(len(begun))
        self._id, self._count = np.concatenate([self._id, numbers]), self._count + len(begun)
        self._last = np.concatenate([self._last, np.full(len(begun), self._now)])

    def _see(self, xy: Float, of: Index) -> None:
        """Adds to the shapes; they lie in the order of things."""
        of_all = np.concatenate([self._of, of])
        order = np.argsort(of_all, kind="stable")
        self._offset = np.concatenate([self._offset, xy - self._motion.x[of]])[order]
        self._when = np.concatenate([self._when, np.full(len(of), self._now)])[order]
        self._of = of_all[order]
        count = np.bincount(self._of, minlength=len(self._motion))
        if count.max(initial=0) > _SHAPE:
            first = np.cumsum(count) - count
            every = -(-count // _SHAPE)
            self._forget_shape((np.arange(len(self._of)) - first[self._of]) % every[self._of] == 0)

    def _forget(self, kept: NDArray[np.bool_]) -> None:
        """Things that are gone."""
        if kept.all():
            return
        self._forget_shape(kept[self._of])
        self._of = (np.cumsum(kept) - 1)[self._of]
        self._motion, self._id = self._motion.of(kept), self._id[kept]
        self._last = self._last[kept]

    def _forget_shape(self, kept: NDArray[np.bool_]) -> None:
        self._offset, self._of, self._when = (
            self._offset[kept],
            self._of[kept],
            self._when[kept],
        )


def find_splits(
    points: DynamicPoints, here: Index, claims: Index, options: ObjectOptions
) -> list[tuple[int, Index, Index]]:
    """Things of which parts lie too far from one another to be one.

    Args:
        points: what moves.
        here: (n,) the points of a scan.
        claims: (n,) whose they are.
        options: see ObjectOptions.

    Returns:
        The thing, and indices into `here` of the parts that hold together around its largest
        cluster, and of those that do not, of which only the largest cluster.
    """
    cluster = points.cluster[here]
    pairs = np.unique(np.column_stack([claims, cluster])[claims >= 0], axis=0)
    repeated = np.unique(pairs[1:, 0][np.diff(pairs[:, 0]) == 0])
    out = []
    for thing in repeated.tolist():
        own = np.flatnonzero(claims == thing)
        parts = [own[cluster[own] == c] for c in np.unique(cluster[own])]
        far = options.apart + options.link_slope * points.range[here[own]].min()
        kept, gone = _held_together([points.xy[here[part]] for part in parts], far)
        if gone:
            largest = max(gone, key=lambda i: len(parts[i]))
            out.append((thing, np.concatenate([parts[i] for i in kept]), parts[largest]))
    return out


def _held_together(parts: list[Float], far: float) -> tuple[list[int], list[int]]:
    """Parts within `far` of the largest one, or of others that are; and the others."""
    from scipy.spatial import KDTree  # takes long to load

    kept = [max(range(len(parts)), key=lambda i: len(parts[i]))]
    gone = [i for i in range(len(parts)) if i not in kept]
    for i in kept:  # grows as it goes
        for j in list(gone):
            if np.min(KDTree(parts[i]).query(parts[j])[0]) < far:
                kept.append(j)
                gone.remove(j)
    return kept, gone


def _cheapest(cost: Float, allowed: NDArray[np.bool_]) -> Index:
    """(n,) columns with the least cost of those allowed; NOBODY where none is."""
    cost = np.where(allowed, cost, np.inf)
    best = cost.argmin(axis=1)
    return np.where(np.isfinite(cost[np.arange(len(cost)), best]), best, NO_TRACK)


def _whole_clusters(claims: Index, cluster: Index, things: int) -> Index:
    """What nobody claims goes with who claims most of its cluster."""
    votes = np.zeros((cluster[-1] + 1, things), np.intp)
    got = claims >= 0
    np.add.at(votes, (cluster[got], claims[got]), 1)
    best = np.where(votes.max(axis=1) > 0, votes.argmax(axis=1), NO_TRACK)
    return np.where(got, claims, best[cluster])


def _means(xy: Float, of: Index, count: Index) -> Float:
    """(K, 2) means of points by their numbers; 0 where there are none."""
    sums = [np.bincount(of, xy[:, d], minlength=len(count)) for d in (0, 1)]
    return np.asarray(np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None])


def _arrays(motion: TrackStates) -> tuple[Float, Float, Float]:
    return motion.x, motion.v, motion.P
