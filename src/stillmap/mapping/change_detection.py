"""Cells that changed near each other at the same time are one place."""

from dataclasses import dataclass
from typing import Literal, NamedTuple, Protocol

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

from stillmap.core.arrays import ArrayBuilder, iter_blocks
from stillmap.core.recording import Recording
from stillmap.em import ChangeOptions, time_bin_index
from stillmap.em.changepoints import MIN_RECURRING_CHANGES
from stillmap.em.spatial_prior import connected_components, neighbor_pairs
from stillmap.mapping.doors import compute_swept_cells

Float = NDArray[np.float64]
Index = NDArray[np.intp]
Kind = Literal["came", "left", "comes and goes"]

_NOISE = 2.0  # cells
_SURE = 0.5  # probability above which a cell counts as one that changed


@dataclass(frozen=True, eq=False)
class Change:
    """A place that changed.

    Attributes:
        kind: something came, left, or comes and goes.
        x, y: metres, the middle of its cells in the map frame.
        size: metres, along x and y, and in space z.
        cells: (K, 2) int64, those that changed.
        resolution: metres, of a cell.
        before_ns: stamp of the last scan that saw it as it was.
        stamp_ns: of the first that saw it otherwise: the change lies between these two. For what
            comes and goes, of the first change that was seen.
        last_ns: the same of the last change that was seen; `stamp_ns` where there was one only.
        times: how often it changed.
        z: metres, the middle in space; None in the plane.
    """

    kind: Kind
    x: float
    y: float
    size: tuple[float, ...]
    cells: NDArray[np.int64]
    resolution: float
    before_ns: int
    stamp_ns: int
    last_ns: int
    times: int
    z: float | None = None

    @property
    def swept_cells(self) -> NDArray[np.int64]:
        """(S, 2) cells of the whole place: of a door all that it sweeps."""
        if self.kind != "comes and goes":
            return self.cells
        return compute_swept_cells(self.cells, self.resolution)

    @property
    def appeared(self) -> bool:
        """Whether something is there now that was not there before."""
        return self.kind == "came"


class CoursesLike(Protocol):
    """What is asked of `em.Courses`."""

    @property
    def cells(self) -> NDArray[np.int64]: ...
    @property
    def p_changing(self) -> NDArray[np.float32]: ...
    @property
    def p_object(self) -> NDArray[np.float32]: ...
    @property
    def p_unchanged(self) -> NDArray[np.float32]: ...
    @property
    def n_changes(self) -> NDArray[np.int32]: ...
    @property
    def change_bins(self) -> NDArray[np.int32]: ...


def find_changed_object_beams(
    recording: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    changes: list[Change],
    resolution: float,
) -> Index:
    """(n,) the dynamic beams, rising, that ended where something stood that came or left.

    What comes and goes may be people who wait there, unless it is a door.
    """
    things = [
        _Thing.of(one, changes)
        for one in changes
        if one.kind != "comes and goes" or len(one.swept_cells) != len(one.cells)
    ]
    found = ArrayBuilder(np.intp, (), recording.scratch)
    for block in iter_blocks(recording.hit, p_static) if things else ():
        beam = block.start + np.flatnonzero(recording.hit[block] & (p_static[block] < 0.5))
        ends, scan = recording.end_points(beam, poses), recording.scans_of(beam)
        at, stamp = np.floor(ends / resolution).astype(np.int64), recording.stamp_ns[scan]
        stood = np.zeros(len(beam), bool)
        for thing in things:
            inside = np.flatnonzero(thing.holds(at, stamp))
            stood[inside] |= thing.near[tuple((at[inside] - thing.low).T)]
        found.append(beam[stood])
    return found.finish()


class _Thing(NamedTuple):
    """What stood somewhere: after which stamp and until which; lowest cell, and cells near it."""

    since: int
    until: int
    low: NDArray[np.int64]
    near: NDArray[np.bool_]

    @classmethod
    def of(cls, change: Change, changes: list[Change]) -> "_Thing":
        low, high = change.cells.min(axis=0) - 1, change.cells.max(axis=0) + 2
        near = np.zeros(tuple((high - low).tolist()), bool)
        near[tuple((change.cells - low).T)] = True
        grown = scipy.ndimage.binary_dilation(near, np.ones((3, 3), bool))
        return cls(*_stood(change, changes), low, grown)

    def holds(self, at: NDArray[np.int64], stamp: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(n,) whether cells (n, 2) lie in its box while it stood there."""
        inside = ((at >= self.low) & (at < self.low + self.near.shape)).all(axis=1)
        return np.asarray(inside & (stamp > self.since) & (stamp <= self.until))


def _stood(change: Change, changes: list[Change]) -> tuple[int, int]:
    """The stamps after which and until which something stood in a place, as far as is known."""
    ever = np.iinfo(np.int64)
    since, until = ever.min, ever.max
    if change.kind == "came":
        since = change.before_ns
        left = [one.before_ns for one in changes if one.kind == "left" and _same(one, change)]
        until = min((stamp for stamp in left if stamp > since), default=until)
    elif change.kind == "left":
        until = change.before_ns
        came = [one.before_ns for one in changes if one.kind == "came" and _same(one, change)]
        since = max((stamp for stamp in came if stamp < until), default=since)
    return since, until


def _same(one: Change, other: Change) -> bool:
    """Whether the larger of two places holds more than half of the smaller."""
    apart = np.abs([one.x - other.x, one.y - other.y])
    if np.any(apart > np.array(one.size) + np.array(other.size)):
        return False
    smaller, larger = sorted((one.cells, other.cells), key=len)
    distances, _ = scipy.spatial.cKDTree(larger).query(smaller)
    return bool(np.mean(distances < 0.5) > 0.5)


class _Events(NamedTuple):
    """N changes of single cells: which cell, came or left, and between which stamps in ns."""

    cell: Index
    came: NDArray[np.bool_]
    before: NDArray[np.int64]
    after: NDArray[np.int64]

    def of(self, chosen: Index) -> "_Events":
        return _Events(
            self.cell[chosen], self.came[chosen], self.before[chosen], self.after[chosen]
        )


def detect_changes(
    courses: CoursesLike,
    recording: Recording,
    resolution: float,
    look: float,
    options: ChangeOptions,
) -> list[Change]:
    """Cells near each other that changed at the same time, in the order of time.

    Args:
        courses: of all cells in which beams ended.
        recording: it knows when each look was.
        resolution: m, edge of a cell.
        look: s, length of a look.
        options: see ChangeOptions.
    """
    changed = np.flatnonzero((courses.p_changing > _SURE) & (courses.n_changes > 0))
    often = courses.n_changes[changed] >= MIN_RECURRING_CHANGES
    stamps = _Stamps(recording, look)
    events = _events(courses, changed[~often], stamps)
    out = []
    for group in _groups(events, courses, resolution, options):
        out += _told_apart(group, courses, resolution, options)
    out += _coming_and_going(courses, changed[often], stamps, resolution, options)
    out = _without_noise(_merged(out, resolution, options.near / resolution), courses, options)
    return sorted(out, key=lambda change: (change.stamp_ns, change.x, change.y))


def _without_noise(
    changes: list[Change], courses: CoursesLike, options: ChangeOptions
) -> list[Change]:
    """The places that are more than noise: that of poses and ranges moves surfaces to and fro."""
    stays = courses.cells[courses.p_unchanged > _SURE]
    if not len(stays):
        return changes
    tree = scipy.spatial.cKDTree(stays)
    out = []
    for one in changes:
        distance, _ = tree.query(one.cells, distance_upper_bound=_NOISE + 1.0)
        if np.count_nonzero(distance > _NOISE) >= options.least:
            out.append(one)
    return out


class _Stamps:
    """When looks were: their first and last scans."""

    def __init__(self, recording: Recording, look: float) -> None:
        number = time_bin_index(recording, look)
        begins = np.flatnonzero(np.diff(number, prepend=number[:1] - 1))
        ends = np.append(begins[1:], len(number)) - 1
        self._number = number[begins]
        self._first, self._last = recording.stamp_ns[begins], recording.stamp_ns[ends]

    def first(self, looks: NDArray[np.int32]) -> NDArray[np.int64]:
        return np.asarray(self._first[np.searchsorted(self._number, looks)], np.int64)

    def last(self, looks: NDArray[np.int32]) -> NDArray[np.int64]:
        return np.asarray(self._last[np.searchsorted(self._number, looks)], np.int64)


def _events(courses: CoursesLike, cells: Index, stamps: _Stamps) -> _Events:
    """The one or two changes of each of these cells."""
    twice = np.flatnonzero(courses.n_changes[cells] == 2)
    cell = np.concatenate([cells, cells[twice]])
    which = np.concatenate([np.ones(len(cells), np.intp), np.zeros(len(twice), np.intp)])
    # the last change made it what it is, the first of two what it no longer is
    came = (courses.p_object[cell] > 0.5) == (which == 1)
    looks = courses.change_bins[cell, which]
    return _Events(cell, came, stamps.last(looks[:, 0]), stamps.first(looks[:, 1]))


def _groups(
    events: _Events, courses: CoursesLike, resolution: float, options: ChangeOptions
) -> list[_Events]:
    """Events of the same kind near each other, at times that may be the same."""
    slack = round(options.together * 1e9)
    pairs = neighbor_pairs(courses.cells[events.cell], options.near / resolution)
    i, j = pairs.T
    begin = np.maximum(events.before[i], events.before[j])
    end = np.minimum(events.after[i], events.after[j])
    fits = (events.came[i] == events.came[j]) & (begin < end + slack)
    return [events.of(one) for one in connected_components(pairs[fits], len(events.cell))]


def _told_apart(
    events: _Events, courses: CoursesLike, resolution: float, options: ChangeOptions
) -> list[Change]:
    """One change after the other, each at the time that fits most of the cells that are left."""
    out = []
    slack = round(options.together * 1e9)
    while len(events.cell) >= options.least:
        # the number of intervals over an instant only grows where one begins
        starts, ends = np.sort(events.before), np.sort(events.after)
        over = np.arange(1, len(starts) + 1) - np.searchsorted(ends, starts, side="right")
        at = starts[np.argmax(over)]
        fits = (events.before <= at) & (events.after > at)
        before, stamp = int(events.before[fits].max()), int(events.after[fits].min())
        mine = (events.before < stamp + slack) & (events.after > before - slack)
        if np.count_nonzero(mine) >= options.least:
            cells = courses.cells[np.unique(events.cell[mine])]
            kind: Kind = "came" if events.came[0] else "left"
            out.append(_change(kind, cells, resolution, before, stamp, stamp, 1))
        events = events.of(np.flatnonzero(~mine))
    return out


def _coming_and_going(
    courses: CoursesLike,
    often: Index,
    stamps: _Stamps,
    resolution: float,
    options: ChangeOptions,
) -> list[Change]:
    """Places that changed again and again: doors, gates, bays that are filled and emptied."""
    out = []
    pairs = neighbor_pairs(courses.cells[often], options.near / resolution)
    for one in connected_components(pairs, len(often)):
        if len(one) < options.least:
            continue
        chosen = often[one]
        between = courses.change_bins[chosen]
        before, stamp = stamps.last(between[:, 0, 0]).max(), stamps.first(between[:, 0, 1]).min()
        last = stamps.first(between[:, 1, 1]).max()
        times = int(np.median(courses.n_changes[chosen]))
        cells = courses.cells[chosen]
        out.append(
            _change(
                "comes and goes",
                cells,
                resolution,
                min(int(before), int(stamp)),
                int(stamp),
                int(last),
                times,
            )
        )
    return out


def _merged(changes: list[Change], resolution: float, near: float) -> list[Change]:
    """Small parts beside a larger place of the same kind belong to it, and changed when it did.

    Somebody may have stood where something came a little later, or where it had left.
    """
    out: list[Change] = []
    for one in sorted(changes, key=lambda change: -len(change.cells)):
        for k, larger in enumerate(out):
            small = one.kind == larger.kind and 2 * len(one.cells) <= len(larger.cells)
            if small and _apart(larger.cells, one.cells) <= near:
                cells = np.unique(np.concatenate([larger.cells, one.cells]), axis=0)
                out[k] = _change(
                    one.kind,
                    cells,
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


def _apart(cells: NDArray[np.int64], others: NDArray[np.int64]) -> float:
    distances, _ = scipy.spatial.cKDTree(cells).query(others)
    return float(np.min(distances))


def _change(
    kind: Kind,
    cells: NDArray[np.int64],
    resolution: float,
    before: int,
    stamp: int,
    last: int,
    times: int,
) -> Change:
    low, high = cells.min(axis=0) * resolution, (cells.max(axis=0) + 1) * resolution
    x, y, *z = ((cells.mean(axis=0) + 0.5) * resolution).tolist()
    size = tuple((high - low).tolist())
    return Change(kind, x, y, size, cells, resolution, before, stamp, last, times, *z)
