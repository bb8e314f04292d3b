"""Changed places: cells near each other that changed at the same time."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal, NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Cells, Float, Index, Int32, Int64
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import connected_components, neighbor_pairs
from stillmap.em import CellHistories, ChangedCells, time_bin_index
from stillmap.em.change_hmm import MIN_RECURRING_CHANGES
from stillmap.mapping.doors import Door
from stillmap.mapping.mover_points import MoverPoints, is_explained

Kind = Literal["came", "left", "comes and goes", "door"]

_MIN_PROBABILITY = 0.5  # that a cell changed
_LINK_DISTANCE = 0.5  # m within which changed cells form one place
_MAX_TIME_GAP = 2.0  # s between the changes of cells of one place
_MIN_CELLS = 4  # of a listed change
_NOISE = 2.0  # cells by which noise of poses and ranges moves surfaces


@dataclass(frozen=True, eq=False)
class Change(ShortRepr):
    """A changed place.

    Attributes:
        kind: an object came, left, or comes and goes; or a door swings.
        x, y: metres, mean of the cells in the map frame.
        size: metres, along x and y, and in 3D z.
        cells: (K, 2) int64, the changed cells.
        resolution: metres, of a cell.
        before_ns: stamp of the last scan that observed the state before.
        stamp_ns: of the first scan that observed the new state: the change lies between the two.
            Of recurring changes, the first one.
        last_ns: the same of the last change; `stamp_ns` where there was one only.
        times: number of changes.
        z: metres, mean height in 3D; None in 2D.
        door: of kind `door`, its leaf.
    """

    kind: Kind
    x: float
    y: float
    size: tuple[float, ...]
    cells: Cells
    resolution: float
    before_ns: int
    stamp_ns: int
    last_ns: int
    times: int
    z: float | None = None
    door: Door | None = None

    @property
    def swept_cells(self) -> Cells:
        """(S, 2) cells of the whole place; of a door all that it sweeps."""
        return self.cells if self.door is None else self.door.swept_cells

    @property
    def appeared(self) -> bool:
        """True if an object is there now that was not there before."""
        return self.kind == "came"


def detect_changes(
    histories: CellHistories,
    recording: Recording,
    resolution: float,
    time_bin: float,
    movers: MoverPoints | None = None,
) -> list[Change]:
    """The changed places, in the order of time.

    Args:
        histories: of all cells with hits.
        recording: with the stamps of the time bins.
        resolution: m, edge of a cell.
        time_bin: s, width of a time bin.
        movers: end points on movers; of the changes in view only those near one are kept. None:
            all are.
    """
    changed = histories.select(
        (histories.p_changing > _MIN_PROBABILITY) & (histories.n_changes > 0)
    )
    unchanged = histories.unchanged_cells
    return group_changes(changed, unchanged, recording, resolution, time_bin, movers)


def group_changes(
    changed: ChangedCells,
    unchanged: Cells,
    recording: Recording,
    resolution: float,
    time_bin: float,
    movers: MoverPoints | None = None,
) -> list[Change]:
    """Group changed cells to places, in the order of time.

    Args:
        changed: the changed cells, in D dimensions.
        unchanged: (U, D) cells that never changed; changes beside them are noise.
        recording: with the stamps of the time bins.
        resolution: m, edge of a cell.
        time_bin: s, width of a time bin.
        movers: see `detect_changes`.
    """
    radius = _LINK_DISTANCE / resolution
    stamps = _BinStamps(recording, time_bin)
    recurring = changed.n_changes >= MIN_RECURRING_CHANGES
    if movers is not None:
        recurring &= _explained_recurring(changed, stamps, resolution, movers)
    single = changed.n_changes < MIN_RECURRING_CHANGES
    events = _make_events(changed, np.flatnonzero(single), stamps)
    if movers is not None:
        xy = np.asarray((changed.cells[events.cell] + 0.5) * resolution, np.float64)
        kept = is_explained(xy, events.before, events.after, movers)
        events = events.select(np.flatnonzero(kept))
    out = []
    for group in _group_events(events, changed.cells, radius):
        out += _split_by_time(group, changed.cells, resolution)
    out += _recurring_changes(changed, np.flatnonzero(recurring), stamps, resolution)
    out = _remove_noise(_absorb_small_parts(out, resolution, radius), unchanged)
    return sorted(out, key=lambda change: (change.stamp_ns, change.x, change.y))


class _BinStamps:
    """First and last stamps of the scans of each time bin, in ns."""

    def __init__(self, recording: Recording, time_bin: float) -> None:
        self._number = time_bin_index(recording, time_bin)
        self._stamp_ns = recording.stamp_ns

    def first(self, bins: Int32) -> Int64:
        return self._stamp_ns[np.searchsorted(self._number, bins)]

    def last(self, bins: Int32) -> Int64:
        return self._stamp_ns[np.searchsorted(self._number, bins, side="right") - 1]


class _Events(NamedTuple):
    """N changes of single cells: which cell, came or left, and between which stamps in ns."""

    cell: Index
    came: Bool
    before: Int64
    after: Int64

    def select(self, chosen: Index) -> "_Events":
        return _Events._make(column[chosen] for column in self)


def _make_events(changed: ChangedCells, cells: Index, stamps: _BinStamps) -> _Events:
    """The one or two changes of each of these cells."""
    twice = np.flatnonzero(changed.n_changes[cells] == 2)
    cell = np.concatenate([cells, cells[twice]])
    which = np.concatenate([np.ones(len(cells), np.intp), np.zeros(len(twice), np.intp)])
    # the last change led to the final state, the first of two changes away from it
    came = (changed.p_object[cell] > 0.5) == (which == 1)
    bins = changed.change_bins[cell, which]
    return _Events(cell, came, stamps.last(bins[:, 0]), stamps.first(bins[:, 1]))


def _explained_recurring(
    changed: ChangedCells, stamps: _BinStamps, resolution: float, movers: MoverPoints
) -> Bool:
    """(K,) whether the first or the last change of a cell is explained."""
    xy = np.asarray((changed.cells + 0.5) * resolution, np.float64)
    bins = np.maximum(changed.change_bins, 0)
    first, last = (
        is_explained(xy, stamps.last(bins[:, k, 0]), stamps.first(bins[:, k, 1]), movers)
        for k in (0, 1)
    )
    return np.asarray(first | last)


def _group_events(events: _Events, cells: Cells, radius: float) -> list[_Events]:
    """Connected events of one kind, within `radius` cells and with overlapping time spans."""
    slack = round(_MAX_TIME_GAP * 1e9)
    pairs = neighbor_pairs(cells[events.cell], radius)
    i, j = pairs.T
    begin = np.maximum(events.before[i], events.before[j])
    end = np.minimum(events.after[i], events.after[j])
    fits = (events.came[i] == events.came[j]) & (begin < end + slack)
    return [events.select(one) for one in connected_components(pairs[fits], len(events.cell))]


def _split_by_time(events: _Events, cells: Cells, resolution: float) -> list[Change]:
    """Changes of a group, one after the other: each at the time that fits most cells left."""
    out = []
    slack = round(_MAX_TIME_GAP * 1e9)
    while len(events.cell) >= _MIN_CELLS:
        # the number of time spans over an instant only grows where one begins
        starts, ends = np.sort(events.before), np.sort(events.after)
        over = np.arange(1, len(starts) + 1) - np.searchsorted(ends, starts, side="right")
        at = starts[np.argmax(over)]
        fits = (events.before <= at) & (events.after > at)
        before, stamp = int(events.before[fits].max()), int(events.after[fits].min())
        mine = (events.before < stamp + slack) & (events.after > before - slack)
        if np.count_nonzero(mine) >= _MIN_CELLS:
            kind: Kind = "came" if events.came[0] else "left"
            its = cells[np.unique(events.cell[mine])]
            out.append(_make_change(kind, its, resolution, before, stamp, stamp, 1))
        events = events.select(np.flatnonzero(~mine))
    return out


def _recurring_changes(
    changed: ChangedCells, recurring: Index, stamps: _BinStamps, resolution: float
) -> list[Change]:
    """Places that changed again and again: doors, gates, parking bays."""
    out = []
    pairs = neighbor_pairs(changed.cells[recurring], _LINK_DISTANCE / resolution)
    for one in connected_components(pairs, len(recurring)):
        if len(one) < _MIN_CELLS:
            continue
        chosen = recurring[one]
        bins = changed.change_bins[chosen]
        stamp = int(stamps.first(bins[:, 0, 1]).min())
        before = min(int(stamps.last(bins[:, 0, 0]).max()), stamp)
        last = int(stamps.first(bins[:, 1, 1]).max())
        times = int(np.median(changed.n_changes[chosen]))
        cells = changed.cells[chosen]
        out.append(_make_change("comes and goes", cells, resolution, before, stamp, last, times))
    return out


def _absorb_small_parts(changes: list[Change], resolution: float, radius: float) -> list[Change]:
    """Merge small changes into a larger one of the same kind beside them, at its time.

    A person may have stood where an object came a little later, or where it had left.
    """
    out: list[Change] = []
    for one in sorted(changes, key=lambda change: -len(change.cells)):
        for k, larger in enumerate(out):
            small = one.kind == larger.kind and 2 * len(one.cells) <= len(larger.cells)
            if small and _within(larger.cells, one.cells, radius):
                out[k] = _make_change(
                    one.kind,
                    np.unique(np.concatenate([larger.cells, one.cells]), axis=0),
                    resolution,
                    larger.before_ns,
                    larger.stamp_ns,
                    larger.last_ns,
                    larger.times,
                )
                break
        else:
            out.append(one)
    return out


def _within(cells: Cells, others: Cells, radius: float) -> bool:
    """True if any two cells of two sets are within a radius of each other."""
    gap = np.maximum(cells.min(axis=0) - others.max(axis=0), others.min(axis=0) - cells.max(axis=0))
    if np.linalg.norm(np.maximum(gap, 0)) > radius:  # of the boxes around them
        return False
    from scipy.spatial import cKDTree  # slow to load

    distances, _ = cKDTree(cells).query(others)
    return bool(np.min(distances) <= radius)


def _remove_noise(changes: list[Change], unchanged: Cells) -> list[Change]:
    """Drop changes too near to unchanged cells: noise of poses and ranges moves surfaces."""
    if not changes or not len(unchanged):
        return changes
    from scipy.spatial import cKDTree

    tree = cKDTree(unchanged)
    out = []
    for one in changes:
        distance, _ = tree.query(one.cells, distance_upper_bound=_NOISE + 1.0)
        if np.count_nonzero(distance > _NOISE) >= _MIN_CELLS:
            out.append(one)
    return out


def _make_change(
    kind: Kind, cells: Cells, resolution: float, before: int, stamp: int, last: int, times: int
) -> Change:
    low, high = cells.min(axis=0) * resolution, (cells.max(axis=0) + 1) * resolution
    x, y, *z = ((cells.mean(axis=0) + 0.5) * resolution).tolist()
    size = tuple((high - low).tolist())
    return Change(kind, x, y, size, cells, resolution, before, stamp, last, times, *z)


_MIN_STAY = 12.0  # s: a shorter stay is a wait, a shorter absence an occlusion
_MIN_HEIGHT = 0.4  # m: anything lower is ground observed along other beams
_MIN_AREA = 0.7  # m2 of visible surface
_DWELL_QUANTILE = 0.25  # of the observed times of an object's voxels


def detect_changes_3d(
    changed: ChangedCells, recording: Recording, poses: Float, resolution: float, time_bin: float
) -> list[Change]:
    """Changed places that are objects at rest: high, large and present for long enough.

    `cells` of each are those of the plane (K, 2), `size` has three lengths, and `z` is known.

    Args:
        changed: candidate voxels.
        recording: 3D, deskewed.
        poses: (T, 4, 4) T_map_base.
        resolution: m, edge of a voxel.
        time_bin: s, width of a time bin.
    """
    first, last = recording.stamp_ns[[0, -1]].tolist()
    lasting = _select_lasting(changed, _MIN_STAY / time_bin, 1e-9 * (last - first) / time_bin)
    unchanged = np.zeros((0, 3), np.int64)  # large objects need no test against noise
    objects = [
        one
        for one in group_changes(lasting, unchanged, recording, resolution, time_bin)
        if one.size[2] >= _MIN_HEIGHT
        and len(one.cells) * resolution**2 >= _MIN_AREA
        and 1e-9 * min(one.stamp_ns - first, last - one.before_ns) >= _MIN_STAY
    ]
    dwell_times = measure_dwell_times(objects, recording, poses, resolution)
    return [
        replace(one, cells=np.unique(one.cells[:, :2], axis=0))
        for one, seconds in zip(objects, dwell_times, strict=True)
        if seconds >= _MIN_STAY
    ]


def _select_lasting(changed: ChangedCells, min_bins: float, bins: float) -> ChangedCells:
    """The cells that kept each state for at least `min_bins` of all `bins` time bins."""
    before, after = changed.change_bins[..., 0], changed.change_bins[..., 1]
    once = (after[:, 1] >= min_bins) & (bins - before[:, 1] >= min_bins)
    twice = before[:, 1] - after[:, 0] >= min_bins
    return changed.select(np.where(changed.n_changes == 1, once, twice))


def measure_dwell_times(
    places: Sequence[Change], recording: Recording, poses: Float, resolution: float
) -> list[float]:
    """Seconds for which three quarters of each object's voxels were hit while it stood there.

    A passing vehicle, or an object occluded soon after, arrives as well; but each of its voxels is
    hit for a moment only.

    Args:
        places: changed places; `cells` are (K, 3) voxels.
        recording: 3D, M beams, deskewed.
        poses: (T, 4, 4) T_map_base.
        resolution: metres, edge of a voxel.
    """
    if not places:
        return []
    # the N voxels of all places; one of several places is there several times
    voxels = np.concatenate([one.cells for one in places])
    place = np.repeat(np.arange(len(places)), [len(one.cells) for one in places])
    low, high = voxels.min(axis=0), voxels.max(axis=0)
    shape = tuple((high - low + 1).tolist())
    key = np.ravel_multi_index(tuple((voxels - low).T), shape)
    limits = np.iinfo(np.int64)
    first, last = np.full(len(place), limits.max), np.full(len(place), limits.min)
    since = np.array([one.stamp_ns if one.appeared else limits.min for one in places])[place]
    until = np.array([limits.max if one.appeared else one.before_ns for one in places])[place]
    T_map_sensor = recording.T_map_sensor(poses)
    for t in recording.iter_scans(range(recording.n_scans)):
        stamp, beams, T = int(recording.stamp_ns[t]), recording.beams_of(t), T_map_sensor[t]
        points = recording.points[beams][recording.hit[beams]].astype(np.float64)
        cells = np.floor((points @ T[:3, :3].T + T[:3, 3]) / resolution).astype(np.int64)
        inside = cells[((cells >= low) & (cells <= high)).all(axis=1)] - low
        was_hit = np.isin(key, np.ravel_multi_index(tuple(inside.T), shape))
        was_hit &= (since <= stamp) & (stamp <= until)
        first[was_hit] = np.minimum(first[was_hit], stamp)
        last[was_hit] = np.maximum(last[was_hit], stamp)
    out = []
    for number, one in enumerate(places):
        its = place == number
        shown = last[its] - one.stamp_ns if one.appeared else one.before_ns - first[its]
        seconds = 1e-9 * np.where(last[its] >= first[its], shown, 0)
        out.append(float(np.quantile(seconds, _DWELL_QUANTILE, method="lower")))
    return out
