"""Track merging: parts of a car are often tracked separately.

Tracks are merged by how often their returns are connected in scans that saw both. A track that
jumps from one car to the next is connected with both, so a chain of tracks is not enough: the
tracks of one group must be connected with those of the other, all in all, to become one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array, triu

from stillmap.core.array_types import Bool, Index
from stillmap.mesh.returns import DynamicReturns, ObjectTrack, cluster_points

_MAJORITY = 0.5
_VELOCITY_SAMPLES = 9  # times at which velocities are compared
_REMNANT_RATIO = 2.0  # returns on an object over those on its remnant, at least
_MAX_SPEED_SHARE = 0.5  # of the faster one's speed by which velocities may differ
_MAX_SPEED_DIFFERENCE = 1.0  # m/s, or by that


class Sightings(NamedTuple):
    """n times that a scan saw an object.

    Attributes:
        object: (n,) number.
        scan: (n,).
        cluster: (n,) of the scan's returns, the one with most of the object's; no scans share any.
        beams: (n,) the object's returns in it.
    """

    object: Index
    scan: Index
    cluster: Index
    beams: Index


def merge_tracks(tracks: Sequence[ObjectTrack], returns: DynamicReturns) -> list[list[ObjectTrack]]:
    """Groups of tracks that belong to one object each.

    Two tracks, one of them faster than people, are one object if they have one velocity and are
    mostly connected in scans that saw both; `_group_tracks` decides on more than two. Tracks of
    another velocity that are mostly connected with more returns of something fast are remnants of
    objects that passed, and are dropped.
    """
    n = len(tracks)
    fast = np.array([one.box.is_fast for one in tracks], np.bool_)
    if returns.inputs.is_planar or not fast.any():
        return [[one] for one in tracks]
    seen = _sightings(tracks, fast, returns)
    # of two objects, the geometric mean of the returns on them, over all scans
    weight = np.sqrt(seen.beams)
    by_cluster, by_scan = (
        coo_array((weight, (seen.object, where)), shape=(n, int(where.max(initial=-1)) + 1)).tocsr()
        for where in (seen.cluster, seen.scan)
    )
    connected, observed = by_cluster @ by_cluster.T, by_scan @ by_scan.T
    pairs = np.stack(triu(connected, 1).nonzero(), axis=1)
    pairs = pairs[fast[pairs].any(axis=1)]
    alike = np.array([_same_velocity(tracks[a], tracks[b]) for a, b in pairs.tolist()], np.bool_)
    pairs = pairs[alike]
    group = _group_tracks(pairs, connected, observed)
    groups: dict[int, list[ObjectTrack]] = {}
    for k in np.flatnonzero(~_is_remnant(seen, group, fast, pairs)).tolist():
        groups.setdefault(int(group[k]), []).append(tracks[k])
    return list(groups.values())


def _sightings(tracks: Sequence[ObjectTrack], fast: Bool, returns: DynamicReturns) -> Sightings:
    """Of all scans that saw something fast (n,)."""
    n, offset, clusters = len(tracks), returns.inputs.deskewed.offset, 0
    ids = [one.object.id for one in tracks]
    number = np.full(max(ids) + 2, n, np.intp)  # last: NO_OWNER
    number[ids] = np.arange(n)
    rows = [np.zeros((4, 0), np.intp)]
    for scan, sensor in enumerate(returns.inputs.T_map_sensor[:, :3, 3]):
        some = returns.in_beam_range(int(offset[scan]), int(offset[scan + 1]))
        whose = number[returns.owner[some]]
        if not fast[whose[whose < n]].any():
            continue
        cluster = cluster_points(returns.ends[some], sensor)
        count = np.zeros((n + 1, int(cluster.max()) + 1), np.intp)
        np.add.at(count, (whose, cluster), 1)
        seen = np.flatnonzero(count[:n].any(axis=1))
        count = count[seen]
        main = clusters + count.argmax(axis=1)
        rows.append(np.stack([seen, np.full(len(seen), scan), main, count.max(axis=1)]))
        clusters += count.shape[1]
    return Sightings(*np.concatenate(rows, axis=1))


def _group_tracks(
    pairs: Index, connected: "csr_array[np.float64]", observed: "csr_array[np.float64]"
) -> Index:
    """(n,) group of each of n objects.

    Pairs (m, 2) that can be one object are visited once, those most connected first. Two groups are
    merged where such a pair, and all their pairs together, are mostly connected.
    """
    group = np.arange(connected.shape[0])
    if not len(pairs):
        return group
    together, seen = (np.asarray(counts[*pairs.T]) for counts in (connected, observed))
    may = np.flatnonzero(together >= _MAJORITY * seen)
    for a, b in pairs[may[np.argsort(-together[may], kind="stable")]].tolist():
        one, other = (np.flatnonzero(group == group[k]) for k in (a, b))
        between = (one[:, None], other[None])
        if connected[between].sum() >= _MAJORITY * observed[between].sum():
            group[other] = group[a]
    return group


def _is_remnant(seen: Sightings, group: Index, fast: Bool, alike: Index) -> Bool:
    """(n,) objects mostly connected with more returns of another group that is fast.

    Args:
        seen: by scans that saw something fast.
        group: (n,) of each object.
        fast: (n,) whether it is fast.
        alike: (m, 2) pairs of one velocity: cars in a row, which are no remnants of each other.
    """
    beside = {(a, b) for pair in alike.tolist() for a, b in (pair, pair[::-1])}
    less = np.zeros(len(group), np.intp)
    order = np.argsort(seen.cluster, kind="stable")
    for rows in np.split(order, np.flatnonzero(np.diff(seen.cluster[order])) + 1):
        objects = seen.object[rows]
        mine = np.bincount(group[objects], seen.beams[rows])[group[objects]]
        for k, beams in zip(objects.tolist(), mine.tolist(), strict=True):
            more = fast[objects] & (mine > _REMNANT_RATIO * beams) & (group[objects] != group[k])
            less[k] += any((k, other) not in beside for other in objects[more].tolist())
    times = np.bincount(seen.object, minlength=len(group))
    return (less >= _MAJORITY * times) & (times > 0)


def _same_velocity(one: ObjectTrack, other: ObjectTrack) -> bool:
    """True if two objects have one velocity while both are seen."""
    a, b = one.box.box, other.box.box
    first, last = max(a.seconds[0], b.seconds[0]), min(a.seconds[-1], b.seconds[-1])
    if first > last:
        first = last = 0.5 * (first + last)
    at = np.linspace(first, last, _VELOCITY_SAMPLES)
    u, v = (
        np.stack([np.interp(at, box.seconds, column) for column in box.velocity.T], axis=1)
        for box in (a, b)
    )
    difference = np.linalg.norm(u - v, axis=1)
    speed = np.maximum(np.linalg.norm(u, axis=1), np.linalg.norm(v, axis=1))
    allowed = np.maximum(_MAX_SPEED_SHARE * speed, _MAX_SPEED_DIFFERENCE)
    return bool(np.median(difference - allowed) <= 0.0)
