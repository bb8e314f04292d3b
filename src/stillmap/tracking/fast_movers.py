"""Fast movers: clusters of several scans that one velocity explains, followed as one object.

A new track starts with velocity zero, give or take the speed of a walker, and so loses a car whose
next detection is a metre away. Here the first detections determine the velocity: five clusters that
lie on a line at constant speed begin a track, which is followed in both directions. Its reference
point is the edge of the object that faces the sensor along the motion (the front of an approaching
car, the rear of a receding one), not the mean of the visible points, which stands still while a car
comes into view.
"""

from typing import NamedTuple

import numpy as np

from stillmap.core import arrays, se2
from stillmap.core.array_types import Bool, Float, Index
from stillmap.tracking.clustering import DynamicPoints
from stillmap.tracking.detections import count_tracks
from stillmap.tracking.mover_path import MAX_SPEED, MIN_SPEED, MoverPath, fit_path, follow

_MAX_FRAGMENT = 0.6  # s: tracks of walkers that last for longer are none
_MAX_STEP = 0.45  # s between two detections of a seed
_MAX_SCANS = 2  # from one to the next
_DIRECTIONS = 16  # of motion, in which the edges of a cluster are known
_GATE_ALONG, _GATE_ACROSS, _ACROSS_PER_METRE = 0.5, 0.4, 0.02  # m; beams lie apart across
_EXTENSIONS = 3  # of a pair of clusters: five detections are a seed
_MAX_PAIRS = 1 << 20  # at once
_MIN_DENSITY = 0.4  # of the scans of a lasting track that detect it
_WIDE = 1.2  # m: clusters of nobody who walks alone
_CLAIM = 0.3  # m around a fast mover, within which points are its own
_MIN_SHARE = 0.7  # of a track of walkers within a fast mover, from which on it is part of it


class _Clusters(NamedTuple):
    """C clusters that no lasting track explains, in the order of time.

    Attributes:
        cluster: (C,) their numbers.
        scan: (C,) their scans.
        seconds: (C,) their times.
        range: (C,) metres from the sensor.
        sensor: (C, 2) its position.
        edge: (C, 16, 2) the outermost point in each direction.
    """

    cluster: Index
    scan: Index
    seconds: Float
    range: Float
    sensor: Float
    edge: Float


class _Seeds(NamedTuple):
    """H hypotheses: detections (H, n), their times, the edges (H, n, 2) that one velocity explains.

    `side` is the direction (H,) in which the edge lies, `cost` the sum of squared residuals in
    units of the gates.
    """

    member: Index
    xy: Float
    side: Index
    cost: Float


def find_fast_movers(points: DynamicPoints, owner: Index) -> tuple[Index, list[MoverPath]]:
    """Track numbers (N,) after fast movers have taken their points, and the paths of these.

    The k-th path has the number max(owner) + 1 + k.

    Args:
        points: dynamic end points.
        owner: (N,) track numbers from `assign_tracks`.
    """
    lasting = _find_lasting(points, owner)
    clusters = _select_clusters(points, owner, lasting)
    if not len(clusters.cluster):
        return owner, []
    paths = _follow_seeds(points, clusters, _find_seeds(clusters))
    owner, first = arrays.copy(owner, points.scratch), len(lasting)
    for number, path in enumerate(paths, start=first):
        owner[_claim(points, owner, path, lasting, first)] = number
    return owner, paths


def tracks_of_paths(points: DynamicPoints, owner: Index, paths: list[MoverPath]) -> list[int]:
    """Number of the track that each path is of now, after tracks were joined; -1: of none."""
    out = []
    for path in paths:
        tracks = owner[path.find_points(points, _CLAIM)]
        tracks = tracks[tracks >= 0]
        out.append(int(np.bincount(tracks).argmax()) if len(tracks) else -1)
    return out


def _find_lasting(points: DynamicPoints, owner: Index) -> Bool:
    """(K,) tracks that are seen for longer than in passing, and in most scans."""
    n = count_tracks(owner)
    scans, last = np.zeros((2, n), np.intp)
    first = np.full(n, len(points.seconds) - 1)
    for block in arrays.iter_blocks(owner, points.scan):
        pairs = np.unique(np.column_stack([owner[block], points.scan[block]]), axis=0)
        scans += np.bincount(pairs[:, 0], minlength=n)
        np.minimum.at(first, pairs[:, 0], pairs[:, 1])
        np.maximum.at(last, pairs[:, 0], pairs[:, 1])
    lasts = points.seconds[last] - points.seconds[first] >= _MAX_FRAGMENT
    return np.asarray(lasts & (scans >= _MIN_DENSITY * (last - first + 1)))


def _select_clusters(points: DynamicPoints, owner: Index, lasting: Bool) -> _Clusters:
    """The clusters whose first point is of no lasting track, and wide ones."""
    begins = _cluster_begins(points)
    ends = np.append(begins[1:], len(points.cluster))
    wide = np.linalg.norm(points.xy[ends - 1] - points.xy[begins], axis=1) > _WIDE
    chosen = wide | ~lasting[owner[begins]]
    begins, size = begins[chosen], (ends - begins)[chosen]
    of, own = arrays.expand_ranges(begins, size)
    xy, first = points.xy[own], np.cumsum(size) - size
    edge = np.empty((len(begins), _DIRECTIONS, 2))
    for k, u in enumerate(_unit_vectors() if len(begins) else ()):
        order = np.lexsort((xy @ u, of))  # the last one of each cluster lies farthest
        edge[:, k] = xy[order[first + size - 1]]
    scan = points.scan[begins]
    nearest = np.minimum.reduceat(points.range[own], first) if len(begins) else np.zeros(0)
    seconds, sensor = points.seconds[scan], points.sensor[scan]
    return _Clusters(points.cluster[begins], scan, seconds, nearest, sensor, edge)


def _cluster_begins(points: DynamicPoints) -> Index:
    """(C,) the first point of each cluster."""
    parts, last = [np.zeros(0, np.intp)], -1
    for block in arrays.iter_blocks(points.cluster):
        cluster = points.cluster[block]
        parts.append(block.start + np.flatnonzero(np.diff(cluster, prepend=last)))
        last = int(cluster[-1])
    return np.concatenate(parts)


def _unit_vectors() -> Float:
    angle = 2.0 * np.pi * np.arange(_DIRECTIONS) / _DIRECTIONS
    return np.column_stack([np.cos(angle), np.sin(angle)])


def _find_seeds(clusters: _Clusters) -> _Seeds:
    """Hypotheses of five detections, the best ones first."""
    parts = []
    for block in _blocks_of_pairs(clusters, np.arange(len(clusters.scan))):
        seeds = _pair(clusters, block)
        for _ in range(_EXTENSIONS):
            blocks = _blocks_of_pairs(clusters, seeds.member[:, -1])
            seeds = _join([_extend(clusters, _select(seeds, some)) for some in blocks])
        parts.append(seeds)
    seeds = _join(parts)
    return _select(seeds, np.argsort(seeds.cost, kind="stable"))


def _blocks_of_pairs(clusters: _Clusters, of: Index) -> list[Index]:
    """Rows of `of` (n,) in order, so many at once that they and their later detections are few."""
    low, high = _later_range(clusters, of)
    ends = np.flatnonzero(np.diff(np.cumsum(high - low) // _MAX_PAIRS)) + 1
    return np.split(np.arange(len(of)), ends)


def _select(seeds: _Seeds, rows: Index | Bool) -> _Seeds:
    return _Seeds._make(column[rows] for column in seeds)


def _join(parts: list[_Seeds]) -> _Seeds:
    return _Seeds._make(np.concatenate(column) for column in zip(*parts, strict=True))


def _later_range(clusters: _Clusters, of: Index) -> tuple[Index, Index]:
    """First cluster of the next scans, and the one after the last of them, of clusters (n,)."""
    low = np.searchsorted(clusters.scan, clusters.scan[of], side="right")
    high = np.searchsorted(clusters.scan, clusters.scan[of] + _MAX_SCANS, side="right")
    until = np.searchsorted(clusters.seconds, clusters.seconds[of] + _MAX_STEP, side="right")
    return low, np.maximum(np.minimum(high, until), low)


def _pairs_of(clusters: _Clusters, of: Index) -> tuple[Index, Index]:
    """Which of `of` (n,), and each of its later detections."""
    low, high = _later_range(clusters, of)
    return arrays.expand_ranges(low, high - low)


def _pair(clusters: _Clusters, of: Index) -> _Seeds:
    """Pairs of detections that something fast explains, by the edges that face the sensor."""
    which, later = _pairs_of(clusters, of)
    first = of[which]
    dt = (clusters.seconds[later] - clusters.seconds[first])[:, None]
    middle = clusters.edge.mean(axis=1)
    step = middle[later] - middle[first]
    near = np.linalg.norm(step, axis=1) < 1.5 * MAX_SPEED * dt[:, 0] + 1.0
    first, later, step, dt = first[near], later[near], step[near], dt[near]
    facing = ((clusters.sensor[first] - middle[first]) * step).sum(axis=1) > 0.0
    turn = np.arctan2(step[:, 1], step[:, 0]) + np.where(facing, 0.0, np.pi)
    side = np.round(turn * _DIRECTIONS / (2.0 * np.pi)).astype(np.intp) % _DIRECTIONS
    xy = np.stack([clusters.edge[first, side], clusters.edge[later, side]], axis=1)
    speed = np.linalg.norm(xy[:, 1] - xy[:, 0], axis=1) / np.maximum(dt[:, 0], 1e-6)
    fast = (speed >= MIN_SPEED) & (speed <= MAX_SPEED)
    seeds = _Seeds(np.column_stack([first, later]), xy, side, np.zeros(len(first)))
    return _select(seeds, fast)


def _extend(clusters: _Clusters, seeds: _Seeds) -> _Seeds:
    """Hypotheses with one more cluster, the nearest to where their velocity leads."""
    which, later = _pairs_of(clusters, seeds.member[:, -1])
    t = clusters.seconds[seeds.member]
    span = np.maximum(t[:, -1] - t[:, 0], 1e-6)[:, None]
    velocity = (seeds.xy[:, -1] - seeds.xy[:, 0]) / span
    speed = np.linalg.norm(velocity, axis=1)
    u = velocity / np.maximum(speed, 1e-9)[:, None]
    dt = clusters.seconds[later] - t[which, -1]
    xy = clusters.edge[later, seeds.side[which]]
    off = xy - seeds.xy[which, -1] - dt[:, None] * velocity[which]
    along, across = se2.along_and_across(off, u[which])
    gate = _GATE_ACROSS + _ACROSS_PER_METRE * clusters.range[later]
    cost = (along / _GATE_ALONG) ** 2 + (across / gate) ** 2
    near = np.flatnonzero(cost < 1.0)
    order = near[np.lexsort((cost[near], which[near]))]
    best = order[np.flatnonzero(np.diff(which[order], prepend=-1))]
    of = which[best]
    return _Seeds(
        np.column_stack([seeds.member[of], later[best]]),
        np.concatenate([seeds.xy[of], xy[best][:, None]], axis=1),
        seeds.side[of],
        seeds.cost[of] + cost[best],
    )


def _follow_seeds(points: DynamicPoints, clusters: _Clusters, seeds: _Seeds) -> list[MoverPath]:
    """Paths that begin with a seed, the longest first; no other has most of its points.

    A seed may mistake what comes into view for motion, but cannot be followed for long.
    """
    used = np.zeros(int(points.cluster[-1]) + 1, bool)
    followed = list[tuple[MoverPath, Index]]()
    for k in range(len(seeds.cost)):
        cluster = clusters.cluster[seeds.member[k]]
        if used[cluster].any():
            continue
        used[cluster] = True
        t = clusters.seconds[seeds.member[k]]
        track = follow(points, clusters.scan[seeds.member[k]], t, seeds.xy[k])
        if track is not None:
            path = fit_path(track, points.seconds)
            mine = path.find_points(points, _CLAIM)
            followed.append((path, mine))
            used[points.cluster[mine]] = True
    followed.sort(key=lambda track: -len(track[0].seconds))
    taken, out = np.zeros(len(points.scan), bool), []
    for path, mine in followed:
        if 2 * np.count_nonzero(taken[mine]) <= len(mine):
            out.append(path)
            taken[mine] = True
    return out


def _claim(
    points: DynamicPoints, owner: Index, path: MoverPath, lasting: Bool, first: int
) -> Index:
    """The points of a fast mover without those of people whom it passes.

    A lasting track that lies within it most of the time is one of its sides. Tracks from `first`
    on are other fast movers.
    """
    mine = path.find_points(points, _CLAIM)
    mine = mine[owner[mine] < first]
    if not len(mine):
        return mine
    low, high = points.first[[points.scan[mine[0]], points.scan[mine[-1]] + 1]]
    here = owner[low:high]
    total = np.bincount(here[here < first], minlength=first)
    inside = np.bincount(owner[mine], minlength=first)
    passed = lasting & (inside < _MIN_SHARE * total)
    return mine[~passed[owner[mine]]]
