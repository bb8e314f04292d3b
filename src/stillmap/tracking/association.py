"""Data association: assign dynamic end points to tracks, scan by scan.

A track is a constant-velocity Kalman filter and the shape seen lately: its recent end points
relative to its position. A point goes to the track whose predicted shape is nearest. Where two
objects that were tracked as one separate, the past points are split between them as well.
"""

import math

import numpy as np

from stillmap.core import arrays, kalman
from stillmap.core.array_types import Bool, Float, Index
from stillmap.core.kalman import TrackStates
from stillmap.tracking.clustering import LINK_PER_METRE, DynamicPoints

NO_TRACK = -1
MAX_GAP = 2.0  # s without points after which a track ends: a person is hidden for about as long
HORIZON = 1.0  # s: points that determine a velocity
SPLIT_WINDOW = 6.0  # s: how far back in time a track is split
ACCELERATION = 1.0  # m2/s3: spectral density of the random acceleration

_POSITION_STD = 0.12  # m: of the mean of an object's end points
_GATE = 0.2  # m: association distance
_WIDE_GATE = 0.35  # m: the same for a track without any nearer point
_GATE_SIGMAS = 2.0  # standard deviations of the prediction in addition
_MAX_GATE = 1.2  # m
_SPLIT_DISTANCE = 0.7  # m: distance between parts of two objects
_SHAPE_WINDOW = 0.6  # s
_MAX_SHAPE_POINTS = 100  # more of them add nothing
_MAX_PAIRS = 1 << 16  # distances computed at once: they fit into the cache
_MAX_COSTS = 1 << 22  # of points and tracks that are held at once
_MAX_UNSEEN = 1.0  # s without points after which one of two split tracks had not begun
_REST_TIME = 0.3  # s: shrinks the speed of few points towards 0
_MAX_RADIUS = 0.45  # m from the center of an object to its points


def split_track(
    points: DynamicPoints, owned: Index, first: Index, second: Index
) -> list[tuple[Index, Index]]:
    """Divide the past points of a track between the two objects that it turned out to be.

    Both are tracked backwards in time from where they are seen apart.

    Args:
        points: dynamic end points.
        owned: past points of the track, rising.
        first, second: points of either object in the current scan.

    Returns:
        Points in the current scan and past points of the older object, and of the newer one.
    """
    xy, seconds = points.xy, points.seconds[points.scan]
    now = float(seconds[first[0]])
    centroids = np.array([xy[first].mean(axis=0), xy[second].mean(axis=0)])
    states = kalman.initialize(centroids, _POSITION_STD)
    seen = np.array([now, now])
    shares: tuple[list[Index], list[Index]] = ([owned[:0]], [owned[:0]])
    owned = owned[seconds[owned] > now - SPLIT_WINDOW]
    for here in np.split(owned, np.flatnonzero(np.diff(points.scan[owned])) + 1)[::-1]:
        if len(here) == 0 or (seen - seconds[here[0]] > _MAX_UNSEEN).any():
            break
        states = kalman.predict(states, seconds[here[0]] - now, ACCELERATION)
        now = float(seconds[here[0]])
        nearest = _assign_to_nearest(xy[here], states)
        count = np.bincount(nearest, minlength=2)
        sums = np.array([xy[here[nearest == i]].sum(axis=0) for i in (0, 1)])
        means = sums / np.maximum(count, 1)[:, None]
        states = kalman.update(states, count > 0, means, _POSITION_STD)
        seen[count > 0] = now
        for i in (0, 1):
            shares[i].append(here[nearest == i])
    parts = [(first, np.concatenate(shares[0])), (second, np.concatenate(shares[1]))]
    return parts[::-1] if seen[1] < seen[0] else parts


def _assign_to_nearest(xy: Float, states: TrackStates) -> Index:
    """(n,) the nearer of two tracks; one without a point near it gets none."""
    distance = np.linalg.norm(xy[:, None] - states.x, axis=-1)
    nearest: Index = distance.argmin(axis=1)
    for i in (0, 1):
        mine = nearest == i
        if mine.any() and distance[mine, i].min() > _MAX_RADIUS + 2.0 * states.position_std[i]:
            nearest[mine] = 1 - i
    return nearest


def estimate_velocity(points: DynamicPoints, past: Index, now: float) -> Float:
    """(2,) m/s of a track's points of the last `HORIZON` seconds; 0 of fewer than two."""
    seconds = points.seconds[points.scan[past]]
    past, seconds = past[seconds > now - HORIZON], seconds[seconds > now - HORIZON]
    if len(past) < 2:
        return np.zeros(2)
    return regress_velocity(seconds, points.xy[past], _REST_TIME)


def regress_velocity(seconds: Float, xy: Float, rest_time: float) -> Float:
    """(2,) slope of the line through positions (n, 2) over times (n,), shrunk towards 0.

    `rest_time` is the spread of times, in seconds, of equally weighted evidence of rest.
    """
    offset = seconds - seconds.mean()
    moment = (offset[:, None] * (xy - xy.mean(axis=0))).sum(axis=0)
    return np.asarray(moment / ((offset**2).sum() + rest_time**2))


def assign_tracks(points: DynamicPoints, max_gap: float) -> Index:
    """(N,) track number of each point, from 0 in the order of first detections.

    A track claims the end points nearest to its predicted shape; each unclaimed cluster begins a
    new track. A track without points for `max_gap` seconds is terminated.
    """
    tracker = _Tracker(points, max_gap)
    scans = np.flatnonzero(np.diff(points.first)).tolist()
    for scan in arrays.release_periodically(scans, lambda: points.release(tracker.owner)):
        tracker.process(scan)
    return tracker.owner


class _Tracker:
    """The active tracks: filter states and shapes, and the track of every point."""

    def __init__(self, points: DynamicPoints, max_gap: float) -> None:
        self.owner = arrays.empty((len(points.scan),), np.intp, points.scratch)
        self._points, self._max_gap = points, max_gap
        self._now, self._count = 0.0, 0
        self._states = kalman.initialize(np.zeros((0, 2)), _POSITION_STD)
        self._id, self._last = np.zeros(0, np.intp), np.zeros(0)
        # shape points: offset from the track's position, track (rising), time
        self._offset, self._of, self._when = np.zeros((0, 2)), np.zeros(0, np.intp), np.zeros(0)

    def process(self, scan: int) -> None:
        """Predict, associate, split, update and begin tracks with the points of a scan."""
        points = self._points
        here = np.arange(points.first[scan], points.first[scan + 1])
        dt, self._now = points.seconds[scan] - self._now, float(points.seconds[scan])
        self._keep(self._now - self._last <= self._max_gap)
        self._states = kalman.predict(self._states, dt, ACCELERATION)
        claims = self._associate(here)
        for track, kept, gone in find_splits(points, here, claims):
            claims[gone] = NO_TRACK
            self._split(here, claims, track, here[kept], here[gone])
        self._update(here, claims)
        self._begin(here, claims)
        self.owner[here] = self._id[claims]

    def _associate(self, here: Index) -> Index:
        """The track that claims each point."""
        claims = np.full(len(here), NO_TRACK)
        if len(self._states) == 0:
            return claims
        xy = self._points.xy[here]
        cluster = self._points.cluster[here] - self._points.cluster[here[0]]
        sigma = self._states.position_std
        every = np.ones(len(sigma), bool)
        claims = self._nearest(xy, _GATE, every)
        if (claims == NO_TRACK).any():
            claiming = np.bincount(claims[claims >= 0], minlength=len(sigma)) > 0
            taken = np.bincount(cluster[claims >= 0], minlength=cluster[-1] + 1) > 0
            open_to = np.flatnonzero((claims == NO_TRACK) & ~taken[cluster])
            claims[open_to] = self._nearest(xy[open_to], _WIDE_GATE, ~claiming)
            claims = _complete_clusters(claims, cluster, len(sigma))
        return claims

    def _nearest(self, xy: Float, gate: float, among: Bool) -> Index:
        """(n,) the most likely of some tracks (K,) within `gate` metres and the uncertainty."""
        out = np.full(len(xy), NO_TRACK)
        left, right = self._extents()
        # strips along y, each compared with the tracks that reach into it
        strips = math.ceil(math.sqrt(len(xy) * len(self._of) / _MAX_PAIRS))
        for part in np.array_split(np.argsort(xy[:, 0], kind="stable"), max(strips, 1)):
            low, high = xy[part[[0, -1]], 0] if len(part) else (0.0, 0.0)
            near = among & (left < high + _MAX_GATE) & (right > low - _MAX_GATE)
            rows = max(1, _MAX_COSTS // max(int(near.sum()), 1))
            for first in range(0, len(part), rows):
                some = part[first : first + rows]
                out[some] = self._nearest_of(np.flatnonzero(near), xy[some], gate)
        return out

    def _extents(self) -> tuple[Float, Float]:
        """(K,) lowest and highest x of the predicted shape points of each track."""
        x = self._states.x[self._of, 0] + self._offset[:, 0]
        begin = np.searchsorted(self._of, np.arange(len(self._states)))
        return np.minimum.reduceat(x, begin), np.maximum.reduceat(x, begin)

    def _nearest_of(self, tracks: Index, xy: Float, gate: float) -> Index:
        """(n,) the same, of these tracks, rising."""
        if not len(tracks):
            return np.full(len(xy), NO_TRACK)
        states = self._states.select(tracks)
        gates = np.minimum(gate + _GATE_SIGMAS * states.position_std, _MAX_GATE)
        variance = _POSITION_STD**2 + states.P[:, 0]
        squared = self._squared_distances(tracks, xy)
        # a 2D Gaussian has twice the logarithm, which would favor long occluded tracks too little
        cost = squared / variance + np.log(variance)
        best = _argmin_allowed(cost, squared < gates**2)
        return np.where(best == NO_TRACK, NO_TRACK, tracks[best])

    def _squared_distances(self, tracks: Index, xy: Float) -> Float:
        """(n, K) from points to the nearest predicted shape point of each of K tracks."""
        number = np.full(len(self._states), NO_TRACK)
        number[tracks] = np.arange(len(tracks))
        shape = np.flatnonzero(number[self._of] != NO_TRACK)
        of = self._of[shape]
        expected_x, expected_y = (self._states.x[of] + self._offset[shape]).T
        begin = np.searchsorted(of, tracks)
        out = np.empty((len(xy), len(begin)))
        step = max(1, _MAX_PAIRS // len(expected_x))
        for first in range(0, len(xy), step):  # a crowd close to the laser is large
            x, y = xy[first : first + step].T[:, :, None]
            squared = np.square(x - expected_x)
            squared += np.square(y - expected_y)
            out[first : first + step] = np.minimum.reduceat(squared, begin, axis=1)
        return out

    def _split(self, here: Index, claims: Index, track: int, kept: Index, gone: Index) -> None:
        """Split a track in two; the newer one gets a new number, in the past as well."""
        points = self._points
        first = points.first[np.searchsorted(points.seconds, self._now - SPLIT_WINDOW)]
        owned = first + np.flatnonzero(self.owner[first : here[0]] == self._id[track])
        new = len(self._states)
        parts = split_track(points, owned, kept, gone)
        for k, (current, past) in zip((track, new), parts, strict=True):
            claims[np.isin(here, current)] = k
            self._set(k, current, estimate_velocity(points, past, self._now))
        self.owner[parts[1][1]] = self._id[new]

    def _set(self, k: int, current: Index, velocity: Float) -> None:
        """Reset track k to these points and this velocity; append it where it is new."""
        xy = self._points.xy[current]
        begun = kalman.initialize(xy.mean(axis=0)[None], _POSITION_STD)
        if k == len(self._states):
            self._append(begun)
        self._states.x[k], self._states.v[k] = begun.x[0], velocity
        self._states.P[k] = begun.P[0]
        self._keep_shapes(self._of != k)
        self._add_to_shapes(xy, np.full(len(current), k))

    def _update(self, here: Index, claims: Index) -> None:
        """Update the tracks with the means of their points."""
        claimed = claims >= 0
        count = np.bincount(claims[claimed], minlength=len(self._states))
        seen, xy = count > 0, self._points.xy[here][claimed]
        means = _means(xy, claims[claimed], count)
        self._states = kalman.update(self._states, seen, means, _POSITION_STD)
        self._last[seen] = self._now
        # an occluded track keeps its shape
        self._keep_shapes((self._now - self._when < _SHAPE_WINDOW) | ~seen[self._of])
        self._add_to_shapes(xy, claims[claimed])

    def _begin(self, here: Index, claims: Index) -> None:
        """Begin a track for each unclaimed cluster."""
        free = claims == NO_TRACK
        if not free.any():
            return
        _, which = np.unique(self._points.cluster[here[free]], return_inverse=True)
        xy, first = self._points.xy[here[free]], len(self._states)
        means = _means(xy, which, np.bincount(which))
        self._append(kalman.initialize(means, _POSITION_STD))
        claims[free] = first + which
        self._add_to_shapes(xy, claims[free])

    def _append(self, begun: TrackStates) -> None:
        self._states = kalman.concatenate(self._states, begun)
        numbers = self._count + np.arange(len(begun))
        self._id, self._count = np.concatenate([self._id, numbers]), self._count + len(begun)
        self._last = np.concatenate([self._last, np.full(len(begun), self._now)])

    def _add_to_shapes(self, xy: Float, of: Index) -> None:
        """Add points of tracks `of` to their shapes, and thin shapes that grew too large."""
        of_all = np.concatenate([self._of, of])
        order = np.argsort(of_all, kind="stable")
        self._offset = np.concatenate([self._offset, xy - self._states.x[of]])[order]
        self._when = np.concatenate([self._when, np.full(len(of), self._now)])[order]
        self._of = of_all[order]
        count = np.bincount(self._of, minlength=len(self._states))
        if count.max(initial=0) > _MAX_SHAPE_POINTS:
            first = np.cumsum(count) - count
            every = -(-count // _MAX_SHAPE_POINTS)
            self._keep_shapes((np.arange(len(self._of)) - first[self._of]) % every[self._of] == 0)

    def _keep(self, kept: Bool) -> None:
        """Terminate all other tracks."""
        if kept.all():
            return
        self._keep_shapes(kept[self._of])
        self._of = (np.cumsum(kept) - 1)[self._of]
        self._states, self._id = self._states.select(kept), self._id[kept]
        self._last = self._last[kept]

    def _keep_shapes(self, kept: Bool) -> None:
        self._offset, self._of = self._offset[kept], self._of[kept]
        self._when = self._when[kept]


def find_splits(
    points: DynamicPoints, here: Index, claims: Index
) -> list[tuple[int, Index, Index]]:
    """Find tracks whose points lie too far apart to be of one object.

    Args:
        points: dynamic end points.
        here: (n,) the points of a scan.
        claims: (n,) their tracks.

    Returns:
        For each such track its number, and indices into `here` of the parts connected with its
        largest cluster, and of the largest one of the others.
    """
    cluster = points.cluster[here]
    within_scan = cluster - cluster.min()
    n_clusters = int(within_scan.max()) + 1
    tracks = np.unique((claims * n_clusters + within_scan)[claims >= 0]) // n_clusters
    repeated = np.unique(tracks[1:][np.diff(tracks) == 0])
    out = []
    for track in repeated.tolist():
        own = np.flatnonzero(claims == track)
        parts = [own[cluster[own] == c] for c in np.unique(cluster[own])]
        max_distance = _SPLIT_DISTANCE + LINK_PER_METRE * points.range[here[own]].min()
        kept, gone = _connect([points.xy[here[part]] for part in parts], max_distance)
        if gone:
            largest = max(gone, key=lambda i: len(parts[i]))
            out.append((track, np.concatenate([parts[i] for i in kept]), parts[largest]))
    return out


def _connect(parts: list[Float], max_distance: float) -> tuple[list[int], list[int]]:
    """Parts connected with the largest one by gaps below `max_distance`, and the others."""
    kept = [max(range(len(parts)), key=lambda i: len(parts[i]))]
    gone = [i for i in range(len(parts)) if i not in kept]
    for i in kept:  # grows as it goes
        for j in list(gone):
            if _distance(parts[i], parts[j]) < max_distance:
                kept.append(j)
                gone.remove(j)
    return kept, gone


def _distance(first: Float, second: Float) -> float:
    """Between the nearest points of two sets (n, 2) and (m, 2): few, as of one cluster."""
    squared = sum((first[:, None, d] - second[None, :, d]) ** 2 for d in (0, 1))
    return float(np.sqrt(np.min(squared)))


def _argmin_allowed(cost: Float, allowed: Bool) -> Index:
    """(n,) columns of least cost among those allowed; NO_TRACK where none is."""
    cost = np.where(allowed, cost, np.inf)
    best = cost.argmin(axis=1)
    return np.where(np.isfinite(cost[np.arange(len(cost)), best]), best, NO_TRACK)


def _complete_clusters(claims: Index, cluster: Index, tracks: int) -> Index:
    """Give unclaimed points to the track that claims most of their cluster."""
    claimed = claims >= 0
    pairs, votes = np.unique(cluster[claimed] * tracks + claims[claimed], return_counts=True)
    order = np.lexsort((pairs, -votes, pairs // tracks))  # of equal votes, the lowest track
    which, first = np.unique(pairs[order] // tracks, return_index=True)
    best = np.full(cluster[-1] + 1, NO_TRACK)
    best[which] = pairs[order[first]] % tracks
    return np.where(claimed, claims, best[cluster])


def _means(xy: Float, of: Index, count: Index) -> Float:
    """(K, 2) mean of the points of each of K groups; 0 of an empty one."""
    sums = [np.bincount(of, xy[:, d], minlength=len(count)) for d in (0, 1)]
    return np.asarray(np.stack(sums, axis=-1) / np.maximum(count, 1)[:, None])
