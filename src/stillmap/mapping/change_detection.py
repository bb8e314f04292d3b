"""Changed places: cells near each other that changed at the same time.

Nothing arrives or leaves in plain view by itself: there a mover must explain the change.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from stillmap.core.array_types import Bool, Cells, Float, Index, Int32, Int64
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import connected_components, neighbor_pairs
from stillmap.em import CellHistories, ChangedCells
from stillmap.em.change_hmm import MIN_RECURRING_CHANGES
from stillmap.em.observations import time_bin_index
from stillmap.mapping.doors import Door

Kind = Literal["came", "left", "comes and goes", "door"]

_MIN_PROBABILITY = 0.5  # that a cell changed
_LINK_DISTANCE = 0.5  # m within which changed cells form one place
_MAX_TIME_GAP = 2.0  # s between the changes of cells of one place
_MIN_CELLS = 4  # of a listed change
_NOISE = 2.0  # cells by which noise of poses and ranges moves surfaces

_UNSEEN = 2.0  # s between two observations, during which something may move unseen
_REACH = 1.0  # m between a mover and what it moves: half of a car that parks, an arm
_SLACK = 2.0  # s between the mover's end points and the change
_SQUARE = 0.25  # m, see MoverPoints.thin


class MoverPoints(NamedTuple):
    """N end points on movers.

    Attributes:
        xy: (N, 2) metres in the map frame.
        stamp_ns: (N,) stamps of their scans.
    """

    xy: Float
    stamp_ns: Int64

    @classmethod
    def none(cls) -> "MoverPoints":
        """Without a point."""
        return cls(np.zeros((0, 2)), np.zeros(0, np.int64))

    @classmethod
    def concatenate(cls, parts: Sequence["MoverPoints"]) -> "MoverPoints":
        """All points of several sets."""
        return cls(*(np.concatenate(column) for column in zip(*parts, strict=True)))

    def thin(self) -> "MoverPoints":
        """One point per square of 25 cm and second."""
        squares = np.floor(self.xy / _SQUARE).astype(np.int64)
        cells = np.column_stack([squares, self.stamp_ns // 1_000_000_000])
        some = np.unique(cells, axis=0, return_index=True)[1]
        return MoverPoints(self.xy[some], self.stamp_ns[some])


def is_explained(xy: Float, before_ns: Int64, after_ns: Int64, movers: MoverPoints) -> Bool:
    """(K,) whether a change may be one: it was not in view then, or a mover was there.

    Args:
        xy: (K, 2) metres, places.
        before_ns, after_ns: (K,) the observations before and after the change.
        movers: end points on movers.
    """
    unseen = after_ns - before_ns > _UNSEEN * 1e9
    if unseen.all() or not len(movers.xy):
        return np.asarray(unseen)
    from scipy.spatial import cKDTree  # slow to load

    origin = int(movers.stamp_ns.min())
    seconds = 1e-9 * (movers.stamp_ns - origin)
    scale = 0.5 * _UNSEEN + _SLACK  # from the middle between the observations
    tree = cKDTree(np.column_stack([movers.xy / _REACH, seconds / scale]))
    middle = 1e-9 * (before_ns - origin + (after_ns - before_ns) // 2)
    # all within 1 of each other in place and time
    places = np.column_stack([xy / _REACH, middle / scale])
    distance, _ = tree.query(places, p=np.inf, distance_upper_bound=1.0)
    return np.asarray(unseen | np.isfinite(distance))


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
    is_changed = (histories.p_changing > _MIN_PROBABILITY) & (histories.n_changes > 0)
    changed = histories.select(is_changed)
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
    for group in group_events(events, changed.cells, radius, round(_MAX_TIME_GAP * 1e9)):
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


class Events(NamedTuple):
    """N changes of single cells: the cell, came or left, the last time before and the first after.

    Times are stamps in ns, or numbers of sessions.
    """

    cell: Index
    came: Bool
    before: Int64
    after: Int64

    def select(self, chosen: Index) -> "Events":
        """Some of the changes (n,)."""
        return Events._make(column[chosen] for column in self)


def _make_events(changed: ChangedCells, cells: Index, stamps: _BinStamps) -> Events:
    """The one or two changes of each of these cells."""
    twice = np.flatnonzero(changed.n_changes[cells] == 2)
    cell = np.concatenate([cells, cells[twice]])
    which = np.concatenate([np.ones(len(cells), np.intp), np.zeros(len(twice), np.intp)])
    # the last change led to the final state, the first of two changes away from it
    came = (changed.p_object[cell] > 0.5) == (which == 1)
    bins = changed.change_bins[cell, which]
    return Events(cell, came, stamps.last(bins[:, 0]), stamps.first(bins[:, 1]))


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


def group_events(events: Events, cells: Cells, radius: float, slack: int = 0) -> list[Events]:
    """Connected events of one kind, within `radius` of cells (K, D), whose time spans overlap.

    slack: by which these may fail to.
    """
    pairs = neighbor_pairs(cells[events.cell], radius)
    i, j = pairs.T
    begin = np.maximum(events.before[i], events.before[j])
    end = np.minimum(events.after[i], events.after[j])
    fits = (events.came[i] == events.came[j]) & (begin < end + slack)
    groups = connected_components(pairs[fits], len(events.cell))
    return [events.select(members) for members in groups]


def _split_by_time(events: Events, cells: Cells, resolution: float) -> list[Change]:
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
            out.append(make_change(kind, its, resolution, before, stamp, stamp, 1))
        events = events.select(np.flatnonzero(~mine))
    return out


def _recurring_changes(
    changed: ChangedCells, recurring: Index, stamps: _BinStamps, resolution: float
) -> list[Change]:
    """Places that changed again and again: doors, gates, parking bays."""
    out = []
    pairs = neighbor_pairs(changed.cells[recurring], _LINK_DISTANCE / resolution)
    for members in connected_components(pairs, len(recurring)):
        if len(members) < _MIN_CELLS:
            continue
        chosen = recurring[members]
        bins = changed.change_bins[chosen]
        stamp = int(stamps.first(bins[:, 0, 1]).min())
        before = min(int(stamps.last(bins[:, 0, 0]).max()), stamp)
        last = int(stamps.first(bins[:, 1, 1]).max())
        times = int(np.median(changed.n_changes[chosen]))
        cells = changed.cells[chosen]
        out.append(make_change("comes and goes", cells, resolution, before, stamp, last, times))
    return out


def _absorb_small_parts(changes: list[Change], resolution: float, radius: float) -> list[Change]:
    """Merge small changes into a larger one of the same kind beside them, at its time.

    A person may have stood where an object came a little later, or where it had left.
    """
    out: list[Change] = []
    for change in sorted(changes, key=lambda change: -len(change.cells)):
        for k, larger in enumerate(out):
            small = change.kind == larger.kind and 2 * len(change.cells) <= len(larger.cells)
            if small and _within(larger.cells, change.cells, radius):
                cells = np.unique(np.concatenate([larger.cells, change.cells]), axis=0)
                times = (larger.before_ns, larger.stamp_ns, larger.last_ns, larger.times)
                out[k] = make_change(change.kind, cells, resolution, *times)
                break
        else:
            out.append(change)
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
    for change in changes:
        distance, _ = tree.query(change.cells, distance_upper_bound=_NOISE + 1.0)
        if np.count_nonzero(distance > _NOISE) >= _MIN_CELLS:
            out.append(change)
    return out


def make_change(
    kind: Kind, cells: Cells, resolution: float, before: int, stamp: int, last: int, times: int
) -> Change:
    """The change of cells (K, D) in the box around them; stamps in ns."""
    low, high = cells.min(axis=0) * resolution, (cells.max(axis=0) + 1) * resolution
    x, y, *z = ((cells.mean(axis=0) + 0.5) * resolution).tolist()
    size = tuple((high - low).tolist())
    return Change(kind, x, y, size, cells, resolution, before, stamp, last, times, *z)
