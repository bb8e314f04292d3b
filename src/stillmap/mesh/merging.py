"""Track merging: parts of a car are often tracked separately.

Tracks are merged by how often their returns are connected in scans that saw both. A track that
jumps from one car to the next is connected with both, so a chain of tracks is not enough: the
tracks of one group must be connected with those of the other, all in all, to become one.
"""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from stillmap.core.square_box import component_labels
from stillmap.mesh.segmentation import LINK, SPACING, DynamicReturns, cluster_cells, segment_object
from stillmap.mesh.tracked_boxes import TrackedBox
from stillmap.mesh.types import Bool, Float, Index
from stillmap.tracking import MovingObject

MAJORITY = 0.5
_VELOCITY_SAMPLES = 9  # times at which velocities are compared
_REMNANT_RATIO = 2.0  # returns on an object over those on its remnant, at least
_MAX_SPEED_SHARE = 0.5  # of the faster one's speed by which velocities may differ
_MAX_SPEED_DIFFERENCE = 1.0  # m/s, or by that
_FIRST_SHELL = 10.0  # m, range up to which one link length holds; then twice that, and so on
_DEPTH_STRETCH = 2.0  # of links along the line of sight: sides of cars, at grazing incidence
_CELLS_PER_LINK = 3.0


class ScanClusters(NamedTuple):
    """Objects that a scan saw: (n,) numbers, the cluster with most of each, and its returns."""

    objects: Index
    cluster: Index
    beams: Index


class PairCounts(NamedTuple):
    """Pairs of objects seen by the same scans, counted by returns on the smaller one.

    Attributes:
        pairs: (m, 2) numbers, the lower first; sorted.
        connected: (m,) count while they were connected.
        observed: (m,) count while both were seen.
    """

    pairs: Index
    connected: Index
    observed: Index


class ObjectTrack(NamedTuple):
    """A moving object with its returns.

    Attributes:
        object: as it was tracked.
        box: box along its track.
        returns: numbers within `DynamicReturns` of its returns, rising.
    """

    object: MovingObject
    box: TrackedBox
    returns: Index


def collect_tracks(returns: DynamicReturns) -> list[ObjectTrack]:
    """The objects that have a box, each with its returns."""
    boxes = {one.box.object_id: one for one in returns.inputs.boxes}
    return [
        ObjectTrack(one, boxes[one.id], segment_object(one, boxes[one.id], returns))
        for one in returns.inputs.objects
        if one.id in boxes
    ]


def merge_tracks(tracks: Sequence[ObjectTrack], returns: DynamicReturns) -> list[list[ObjectTrack]]:
    """Groups of tracks that belong to one object each.

    Two tracks, one of them faster than people, are one object if they have one velocity and are
    mostly connected in scans that saw both; `group_tracks` decides on more than two. Tracks of
    another velocity that are mostly connected with more returns of something fast are remnants of
    objects that passed, and are dropped.
    """
    n = len(tracks)
    fast = np.array([one.box.is_fast for one in tracks], np.bool_)
    if returns.inputs.is_planar or not fast.any():
        return [[one] for one in tracks]
    scans = list(_cluster_scans(tracks, fast, returns))
    counts = count_pairs(scans, n)
    alike = fast[counts.pairs].any(axis=1) & (counts.connected > 0)
    some = np.flatnonzero(alike)
    alike[some] = [_same_velocity(tracks[a], tracks[b]) for a, b in counts.pairs[some].tolist()]
    group = group_tracks(counts, alike & (counts.connected >= MAJORITY * counts.observed), n)
    groups: dict[int, list[ObjectTrack]] = {}
    for k in np.flatnonzero(~_is_remnant(scans, group, fast, counts.pairs[alike])).tolist():
        groups.setdefault(int(group[k]), []).append(tracks[k])
    return list(groups.values())


def count_pairs(scans: Sequence[ScanClusters], n: int) -> PairCounts:
    """All pairs of n objects that some scan saw together."""
    # of many objects most never meet: a list of pairs, no matrix
    keys, together, seen = ([np.zeros(0, np.intp)] for _ in range(3))
    for objects, cluster, beams in scans:
        a, b = np.triu_indices(len(objects), 1)
        fewer = np.minimum(beams[a], beams[b])
        keys.append(objects[a] * n + objects[b])
        together.append(np.where(cluster[a] == cluster[b], fewer, 0))
        seen.append(fewer)
    key, number = np.unique(np.concatenate(keys), return_inverse=True)
    connected, observed = (
        np.bincount(number, np.concatenate(counts), len(key)).astype(np.intp)
        for counts in (together, seen)
    )
    return PairCounts(np.stack([key // n, key % n], axis=1), connected, observed)


def group_tracks(counts: PairCounts, may: Bool, n: int) -> Index:
    """(n,) group of each of n objects.

    Pairs are visited once, those with the highest count first. Two groups are merged where a pair
    of them may be, and all their pairs together are mostly connected by then.

    Args:
        counts: of all pairs.
        may: (m,) which pairs can be one object.
        n: number of objects.
    """
    group = np.arange(n)
    candidates = np.flatnonzero(may & (counts.connected > 0))
    for k in candidates[np.argsort(-counts.connected[candidates], kind="stable")].tolist():
        groups = np.sort(group[counts.pairs], axis=1)
        a, b = groups[k].tolist()
        between = (groups == (a, b)).all(axis=1)
        connected, observed = counts.connected[between].sum(), counts.observed[between].sum()
        if a != b and connected >= MAJORITY * observed:
            group[group == b] = a
    return group


def _cluster_scans(
    tracks: Sequence[ObjectTrack], fast: Bool, returns: DynamicReturns
) -> Iterator[ScanClusters]:
    """Clusters the dynamic returns of each scan that saw something fast (n,)."""
    n, offset = len(tracks), returns.inputs.deskewed.offset
    ids = [one.object.id for one in tracks]
    number = np.full(max(ids) + 2, n, np.intp)  # last: NO_OWNER
    number[ids] = np.arange(n)
    for scan, sensor in enumerate(returns.inputs.T_map_sensor[:, :3, 3]):
        some = returns.in_beam_range(int(offset[scan]), int(offset[scan + 1]))
        whose = number[returns.owner[some]]
        if not fast[whose[whose < n]].any():
            continue
        cluster = cluster_points(returns.ends[some], sensor, LINK)
        count = np.zeros((n + 1, int(cluster.max()) + 1), np.intp)
        np.add.at(count, (whose, cluster), 1)
        seen = np.flatnonzero(count[:n].any(axis=1))
        yield ScanClusters(seen, count[seen].argmax(axis=1), count[seen].max(axis=1))


def _is_remnant(scans: Sequence[ScanClusters], group: Index, fast: Bool, alike: Index) -> Bool:
    """(n,) objects mostly connected with more returns of another group that is fast.

    Args:
        scans: that saw something fast.
        group: (n,) of each object.
        fast: (n,) whether it is fast.
        alike: (m, 2) pairs of one velocity: cars in a row, which are no remnants of each other.
    """
    n = len(group)
    both_ways = np.concatenate([alike, alike[:, ::-1]])
    beside = np.unique(both_ways[:, 0] * n + both_ways[:, 1])
    less, times = np.zeros(n, np.intp), np.zeros(n, np.intp)
    for objects, cluster, beams in scans:
        mine = np.bincount(group[objects], beams)[group[objects]]
        more = (cluster[:, None] == cluster) & fast[objects]
        more &= mine > _REMNANT_RATIO * mine[:, None]
        more &= group[objects][:, None] != group[objects]
        more &= ~np.isin(objects[:, None] * n + objects, beside)
        less[objects] += more.any(axis=1)
        times[objects] += 1
    return (less >= MAJORITY * times) & (times > 0)


def cluster_points(points: Float, sensor: Float, link: float) -> Index:
    """(n,) cluster of points (n, 3), linked up to the beam spacing at their range plus `link`.

    Args:
        points: metres.
        sensor: (3,) metres.
        link: metres.
    """
    n, away = len(points), np.linalg.norm(points - sensor, axis=1)
    links, first = [np.zeros((0, 2), np.intp)], n
    near, far = 0.0, _FIRST_SHELL
    while near <= away.max(initial=0.0):
        length = link + SPACING * far
        some = np.flatnonzero((away >= near - length) & (away <= far + length))
        if len(some):
            # distances across the line of sight stay as they are halfway between two ranges
            halfway = 0.5 * (near + far)
            factor = halfway + (away[some] - halfway) / _DEPTH_STRETCH
            factor /= np.maximum(away[some], 1e-9)
            squeezed = sensor + (points[some] - sensor) * factor[:, None]
            cluster = cluster_cells(squeezed, length / _CELLS_PER_LINK, length)
            links.append(np.column_stack([some, first + cluster]))
            first += int(cluster.max()) + 1
        near, far = far, 2.0 * far
    return component_labels(np.concatenate(links), first)[:n]


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
