"""Returns of a recording on moving objects, which of them each object has, and track merging.

Parts of a car are often tracked separately. Tracks are merged by how often their returns are
connected in scans that saw both. A track that jumps from one car to the next is connected with
both, so a chain of tracks is not enough: the tracks of one group must be connected with those of
the other, all in all, to become one.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from scipy.sparse import coo_array, csr_array, triu

from stillmap.core import arrays
from stillmap.core.array_types import Bool, Float, Index, Int32
from stillmap.core.square_box import component_labels, group_indices, neighbor_pairs
from stillmap.em.types import DYNAMIC_BELOW
from stillmap.mapping.labelled_recording import iter_hits
from stillmap.mesh.inputs import MeshInputs, ObjectFrame, TrackedBox
from stillmap.tracking import MovingObject

NO_OWNER = -1
LINK = 0.5  # m between connected parts of a vehicle, near the sensor
SPACING = 0.025  # rad between beams, at most
HALF_CAR = 3.0  # m, from the center of a car to its ends
_BOX_MARGIN = 0.15  # m around an object's box within which returns are its own
_GROUND_CLEARANCE = 0.03  # m above the ground: lower returns are the ground's
_CAR_LENGTH = 6.0  # m
_CELLS_PER_LINK = 3.0  # in a cell one point is enough


class DynamicReturns(NamedTuple):
    """The K returns of a recording on moving objects.

    Attributes:
        inputs: the recording.
        beam: (K,) beam numbers, rising.
        seconds: (K,) times, by the clock of boxes.
        ends: (K, 3) metres in the map frame.
        owner: (K,) id of the object; -1: none.
        is_dynamic: (K,) whether P(static) is below one half; not all returns with an owner are.
    """

    inputs: MeshInputs
    beam: Index
    seconds: Float
    ends: Float
    owner: Int32
    is_dynamic: Bool

    @classmethod
    def collect(cls, inputs: MeshInputs) -> "DynamicReturns":
        """All returns that are dynamic or belong to an object."""
        deskewed, objects = inputs.deskewed, inputs.objects
        owned = np.concatenate([np.zeros(0, np.intp), *(one.beams for one in objects)])
        whose = np.repeat([one.id for one in objects], [len(one.beams) for one in objects])
        moving = iter_hits(deskewed.hit, inputs.p_static, dynamic=True)
        beam = np.unique(np.concatenate([owned, *moving])).astype(np.intp)
        owner = np.full(len(beam), NO_OWNER, np.int32)
        owner[np.searchsorted(beam, owned)] = whose
        dynamic = deskewed.hit[beam] & (inputs.p_static[beam] < DYNAMIC_BELOW)
        seconds, ends = inputs.seconds_of(beam), deskewed.end_points(beam, inputs.poses)
        return cls(inputs, beam, seconds, ends, owner, dynamic)

    def take(self, numbers: Index | slice) -> "DynamicReturns":
        """Some of the returns."""
        parts = {name: getattr(self, name)[numbers] for name in self._fields[1:]}
        return self._replace(**parts)

    def tracked(self) -> "DynamicReturns":
        """Dynamic returns on objects that have a box, sorted by time."""
        boxed = np.isin(self.owner, [one.box.object_id for one in self.inputs.boxes])
        kept = np.flatnonzero(self.is_dynamic & boxed)
        return self.take(kept[np.argsort(self.seconds[kept], kind="stable")])

    def in_beam_range(self, first: int, last: int) -> slice:
        """Returns of beams first:last."""
        a, b = np.searchsorted(self.beam, [first, last])
        return slice(int(a), int(b))


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


def segment_object(one: MovingObject, tracked: TrackedBox, returns: DynamicReturns) -> Index:
    """(n,) returns of an object: rising numbers within `returns`.

    Dynamic returns in the box around it that belong to no other object, and its own not far beside.
    """
    box, inputs, offset = tracked.box, returns.inputs, returns.inputs.deskewed.offset
    stamps = 1e-9 * (inputs.deskewed.stamp_ns - inputs.start_ns)
    a = int(np.searchsorted(stamps, box.seconds[0] - box.hold))
    b = max(int(np.searchsorted(stamps, box.seconds[-1] + box.hold, side="right")), a)
    some = returns.in_beam_range(int(offset[a]), int(offset[b]))
    half = np.array(box.half_size) + _BOX_MARGIN
    # returns far from the whole track need no test against the box
    reach = max(float(np.linalg.norm(half)) + _BOX_MARGIN, HALF_CAR)
    way = box.center_at(np.concatenate([box.seconds, box.seconds[[0, -1]] + [-box.hold, box.hold]]))
    low, high = way.min(axis=0) - reach, way.max(axis=0) + reach
    x, y = returns.ends[some, 0], returns.ends[some, 1]
    near = (x >= low[0]) & (x <= high[0]) & (y >= low[1]) & (y <= high[1])
    near &= (returns.owner[some] == one.id) | (returns.owner[some] == NO_OWNER)
    number = some.start + np.flatnonzero(near)
    frame = ObjectFrame.from_track(tracked)
    at = frame.to_object(returns.seconds[number], returns.ends[number])
    inside = (np.abs(at[:, :2]) <= half).all(axis=1)
    inside &= (at[:, 2] > _GROUND_CLEARANCE) & (at[:, 2] <= tracked.height + _BOX_MARGIN)
    # the track of one person may capture another beside
    mine = (np.abs(at[:, :2]) <= half + _BOX_MARGIN).all(axis=1)
    if tracked.is_large and not tracked.is_fast:
        # the center of the visible part moves about on a large object
        mine = np.linalg.norm(at[:, :2], axis=1) <= HALF_CAR
    kept = np.where(returns.owner[number] == one.id, mine, inside)
    return np.asarray(number[kept], np.intp)


def grow_segment(
    own: Index, within: Index, frame: ObjectFrame, sensor: Float, returns: DynamicReturns
) -> Index:
    """(n,) the returns of a fast object and all dynamic returns connected with them.

    Parts of a car are often tracked separately.

    Args:
        own: numbers within `returns` that are known to be of the object, rising.
        within: rising numbers of all that may be.
        frame: of the object.
        sensor: (3,) metres, sensor position in that frame.
        returns: all dynamic returns.
    """
    within = within[returns.is_dynamic[within]]
    at = frame.to_object(returns.seconds[within], returns.ends[within])
    some = (at[:, 2] > _GROUND_CLEARANCE) & (np.linalg.norm(at[:, :2], axis=1) <= _CAR_LENGTH)
    within, at = within[some], at[some]
    there = frame.to_object(returns.seconds[own], returns.ends[own])
    own = own[np.linalg.norm(there[:, :2], axis=1) <= _CAR_LENGTH]
    if not len(within):
        return own
    cluster = cluster_points(at, sensor)
    mine = np.isin(within, own)
    return np.union1d(own, within[np.isin(cluster, cluster[mine])])


def cluster_points(points: Float, sensor: Float) -> Index:
    """(n,) clusters of points (n, 3), linked up to `LINK` plus the beam spacing at their range.

    Along the line of sight links are longer, and the more so the farther away: sides of cars are
    seen at grazing incidence.

    Args:
        points: metres.
        sensor: (3,) metres.
    """
    off = points - sensor
    # shrunk towards the sensor, so that all links are equally long
    off *= LINK / (LINK + SPACING * np.linalg.norm(off, axis=1, keepdims=True))
    cells, of = arrays.unique_cells(np.floor(off * (_CELLS_PER_LINK / LINK)).astype(np.int64))
    return component_labels(neighbor_pairs(cells, _CELLS_PER_LINK), len(cells))[of]


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
    for rows in group_indices(seen.cluster):
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
