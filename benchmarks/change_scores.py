"""Scores of a map with objects that were moved, brought or taken away during the recording."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from stillmap.core.se2 import inverse
from stillmap.results.eval.labels import Scores
from stillmap.results.eval.map import GHOST_DISTANCE, MIN_HITS, distance_to_walls, is_near_occupied
from stillmap.results.reader import Grid, moved

Float = NDArray[np.float64]
Index = NDArray[np.intp]

MIN_BEAMS = 3  # of a scan on an object, or through its place: an observation
MIN_PASSES = 3  # scans with a beam through a cell that show it to be free
MAX_DISTANCE = 0.5  # m between a detected change and its object
MIN_CELLS = 8  # of a thing, hit and off walls, for its state to count
ONE_STATE = 0.1  # share of its cells that may be shown in the other state


@dataclass(frozen=True, eq=False)
class Stay:
    """An object at rest at one place, in the world.

    Attributes:
        mover: its number.
        center: (2,) metres.
        faces: (K, 4) segments x0, y0, x1, y1 in metres.
        since_ns: arrival; None: before the recording.
        until_ns: departure; None: never.
    """

    mover: int
    center: Float
    faces: Float
    since_ns: int | None
    until_ns: int | None

    def contains(self, stamp_ns: NDArray[np.int64]) -> NDArray[np.bool_]:
        """(N,) whether the object is there at stamps (N,)."""
        since = -np.inf if self.since_ns is None else self.since_ns
        until = np.inf if self.until_ns is None else self.until_ns
        return np.asarray((stamp_ns >= since) & (stamp_ns < until))


@dataclass(frozen=True, eq=False)
class Beams:
    """M beams of T scans at true poses.

    Attributes:
        start, end: (M, 2) metres in the world.
        mover: (M,) number of the mover that reflected each, -1: none.
        scan: (M,) rising.
        stamp_ns: (T,) of the scans.
    """

    start: Float
    end: Float
    mover: NDArray[np.int32]
    scan: Index
    stamp_ns: NDArray[np.int64]

    def hits_on(self, stay: Stay) -> Index:
        """Beams that the object reflected during a stay."""
        return np.flatnonzero((self.mover == stay.mover) & stay.contains(self.stamp_ns)[self.scan])

    def near(self, point: Float, distance: float) -> Index:
        """Beams that pass a point (2,) within `distance` metres."""
        along = self.end - self.start
        length = np.maximum(np.sum(along**2, axis=1), np.finfo(float).tiny)
        share = np.clip(np.sum((point - self.start) * along, axis=1) / length, 0.0, 1.0)
        off = self.start + share[:, None] * along - point
        return np.flatnonzero(np.hypot(*off.T) <= distance)


@dataclass(frozen=True)
class ChangeScores(Scores):
    """NaN where there is no cell.

    Attributes:
        new_cells: cells with MIN_HITS hits on objects that were brought and are still there.
        new_kept: share of these that are occupied, or one of whose 8 neighbours is.
        old_cells: cells of objects taken away, far from walls and all objects still there, that
            beams of MIN_PASSES scans passed through afterwards.
        old_occupied: share of these that are occupied.
    """

    new_cells: int
    new_kept: float
    old_cells: int
    old_occupied: float


@dataclass(frozen=True)
class ThingScores(Scores):
    """How a map shows things that were brought or taken away.

    Attributes:
        things: stays that began or ended, with MIN_CELLS cells off walls, seen present and absent.
        one_state: those whose cells are all shown occupied, or all free, but for ONE_STATE.
        right: those that are shown so, in a state that fits all looks.
    """

    things: int
    one_state: int
    right: int


class DetectedChange(Protocol):
    """A detected change: position in the map frame in metres, kind and time."""

    @property
    def x(self) -> float: ...
    @property
    def y(self) -> float: ...
    @property
    def appeared(self) -> bool: ...
    @property
    def stamp_ns(self) -> int: ...


@dataclass(frozen=True, eq=False)
class TrueChange:
    """An arrival or departure.

    Attributes:
        stay: the stay that began or ended.
        appeared: it began.
        stamp_ns: when.
        observed_ns: the first scan afterwards that looked there; None: none did, or none before, so
            nobody could know of the change.
    """

    stay: Stay
    appeared: bool
    stamp_ns: int
    observed_ns: int | None


@dataclass(frozen=True)
class ChangeTimes(Scores):
    """Scores of detected changes.

    Attributes:
        seen: true changes whose place was observed before and after.
        found: those with a detected change of their kind within MAX_DISTANCE of the object.
        missed: all others.
        false: detected changes without a true one of their kind, seen or not, nearby.
        errors: s, one per `found`: distance of the stamp from the interval between the change and
            the first observation afterwards.
    """

    seen: int
    found: int
    missed: int
    false: int
    errors: tuple[float, ...]


def score_changes(
    grid: Grid, stays: Sequence[Stay], beams: Beams, walls: Float, T_world_map: Float
) -> ChangeScores:
    """Score a map that shows the last state.

    Args:
        grid: the map.
        stays: all stays of movable objects.
        beams: of the whole recording.
        walls: (W, 4) segments of the static world.
        T_world_map: (3, 3), see `trajectory.align`.
    """
    T_map_world = inverse(T_world_map)
    lasting = [stay for stay in stays if stay.contains(beams.stamp_ns[-1:])[0]]
    ended = [stay for stay in stays if not stay.contains(beams.stamp_ns[-1:])[0]]
    shown = [_cells(grid, beams.end[beams.hits_on(stay)], T_map_world) for stay in lasting]
    left = [_vacated_cells(grid, stay, beams, T_world_map) for stay in ended]
    new, old = _union(shown), _union(left)
    solid = np.concatenate([walls, *(stay.faces for stay in lasting)])
    centres = moved(T_world_map, grid.centres(old))
    old = old[distance_to_walls(centres, solid) > GHOST_DISTANCE * grid.resolution]
    return ChangeScores(
        new_cells=len(new),
        new_kept=_mean(is_near_occupied(grid, grid.centres(new))),
        old_cells=len(old),
        old_occupied=_mean(_occupied(grid, old)),
    )


def score_things(
    grid: Grid,
    stays: Sequence[Stay],
    beams: Beams,
    walls: Float,
    T_world_map: Float,
    majority: bool,
) -> ThingScores:
    """Whether the cells of each thing that was brought or taken away are shown in one state.

    A cell is shown occupied if it or a neighbour is. Other things at the same place at other times
    leave it out.

    Args:
        grid, stays, beams, walls, T_world_map: see `score_changes`.
        majority: whether the map shows the modal state, between the first and the last observation
            of the thing's place, or the last one.
    """
    T_map_world = inverse(T_world_map)
    things = one_state = right = 0
    for stay in stays:
        on = _observation_stamps(beams.hits_on(stay), beams)
        through = _observation_stamps(_beams_through(stay, beams), beams)
        center = stay.center[None]
        others = [o.faces for o in stays if o is not stay and _distance(center, o)[0] < 2.0]
        if not len(on) or not len(through):
            continue
        cells = _cells(grid, beams.end[beams.hits_on(stay)], T_map_world)
        centres = moved(T_world_map, grid.centres(cells))
        solid = np.concatenate([walls, *others])
        cells = cells[distance_to_walls(centres, solid) > GHOST_DISTANCE * grid.resolution]
        if len(cells) < MIN_CELLS:
            continue
        share = _mean(is_near_occupied(grid, grid.centres(cells)))
        things += 1
        if min(share, 1.0 - share) <= ONE_STATE:
            one_state += 1
            right += (share > 0.5) in _possible_states(on, through, majority)
    return ThingScores(things, one_state, right)


def _possible_states(
    on: NDArray[np.int64], through: NDArray[np.int64], majority: bool
) -> set[bool]:
    """Whether a thing was there at last, or most of the time between the first and the last look.

    Args:
        on, through: (n,) stamps in ns, rising, of looks at the thing, and through its place.
        majority: whether most of the time counts. Nobody knows when between two looks it changed.
    """
    first, last = min(on[0], through[0]), max(on[-1], through[-1])
    if not majority:
        return {bool(on[-1] > through[-1])}
    earlier, later = through[through < on[0]], through[through > on[-1]]
    shortest = on[-1] - on[0]
    longest = (later[0] if len(later) else last) - (earlier[-1] if len(earlier) else first)
    return {bool(2 * length > last - first) for length in (shortest, longest)}


def list_true_changes(stays: Iterable[Stay], beams: Beams) -> list[TrueChange]:
    """List every begin and end of a stay within the recording, in no order."""
    first, last = beams.stamp_ns[[0, -1]].tolist()
    changes = []
    for stay in stays:
        on, through = (
            _observation_stamps(beams.hits_on(stay), beams),
            _observation_stamps(_beams_through(stay, beams), beams),
        )
        for stamp, before, after in ((stay.since_ns, through, on), (stay.until_ns, on, through)):
            if stamp is not None and first < stamp <= last:
                later = after[after >= stamp]
                seen = bool(np.any(before < stamp)) and len(later) > 0
                observed = int(later[0]) if seen else None
                changes.append(TrueChange(stay, after is on, stamp, observed))
    return changes


def score_change_times(
    changes: Sequence[DetectedChange], true: Sequence[TrueChange], T_world_map: Float
) -> ChangeTimes:
    """Compare each true change with the nearest detected one of its kind.

    One detected change may match several objects side by side, and several one large object.

    Args:
        changes: detected changes.
        true: from `list_true_changes`.
        T_world_map: (3, 3), see `trajectory.align`.
    """
    xy = moved(T_world_map, np.array([(c.x, c.y) for c in changes], float).reshape(-1, 2))
    appeared = np.array([c.appeared for c in changes], bool)
    errors, known = [], np.zeros(len(changes), bool)
    for one in true:
        distance = np.where(appeared == one.appeared, _distance(xy, one.stay), np.inf)
        known |= distance <= MAX_DISTANCE
        if one.observed_ns is not None and distance.min(initial=np.inf) <= MAX_DISTANCE:
            stamp = changes[int(distance.argmin())].stamp_ns
            errors.append(1e-9 * max(one.stamp_ns - stamp, stamp - one.observed_ns, 0))
    seen = sum(one.observed_ns is not None for one in true)
    return ChangeTimes(
        seen=seen,
        found=len(errors),
        missed=seen - len(errors),
        false=int(np.count_nonzero(~known)),
        errors=tuple(errors),
    )


def _cells(grid: Grid, points: Float, T_map_world: Float) -> NDArray[np.int64]:
    """(N, 2) row and column of the cells with MIN_HITS of the points."""
    cells, count = np.unique(grid.cells(moved(T_map_world, points)), axis=0, return_counts=True)
    return np.asarray(cells[count >= MIN_HITS].reshape(-1, 2))


def _vacated_cells(grid: Grid, stay: Stay, beams: Beams, T_world_map: Float) -> NDArray[np.int64]:
    """Cells of a stay that ended that MIN_PASSES scans passed through afterwards."""
    cells = _cells(grid, beams.end[beams.hits_on(stay)], inverse(T_world_map))
    near = beams.near(stay.center, _radius(stay) + 2 * grid.resolution)
    near = near[beams.stamp_ns[beams.scan[near]] >= (stay.until_ns or 0)]
    start, along = beams.start[near], beams.end[near] - beams.start[near]
    length = np.maximum(np.hypot(*along.T), np.finfo(float).tiny)
    along = along / length[:, None]
    passed = np.zeros(len(cells), bool)
    for k, centre in enumerate(moved(T_world_map, grid.centres(cells))):
        delta = centre - start
        ahead = np.sum(delta * along, axis=1)
        off = np.abs(along[:, 0] * delta[:, 1] - along[:, 1] * delta[:, 0])
        through = (off < grid.resolution / 2) & (ahead > 0) & (ahead < length - grid.resolution)
        passed[k] = len(np.unique(beams.scan[near[through]])) >= MIN_PASSES
    return cells[passed]


def _union(cells: Sequence[NDArray[np.int64]]) -> NDArray[np.int64]:
    return np.unique(np.concatenate([np.empty((0, 2), np.int64), *cells]), axis=0)


def _occupied(grid: Grid, cells: NDArray[np.int64]) -> NDArray[np.bool_]:
    inside = np.all((cells >= 0) & (cells < grid.p_occupied.shape), axis=1)
    out = np.zeros(len(cells), bool)
    out[inside] = grid.occupied[tuple(cells[inside].T)]
    return out


def _beams_through(stay: Stay, beams: Beams) -> Index:
    """Beams that cross the faces of an object while it is not there."""
    near = beams.near(stay.center, _radius(stay))
    near = near[~stay.contains(beams.stamp_ns[beams.scan[near]])]
    a, b = beams.start[near], beams.end[near]
    crossed = np.zeros(len(near), bool)
    for face in stay.faces:
        c, d = face[:2], face[2:]
        crossed |= (_side(a, b, c) * _side(a, b, d) < 0) & (_side(c, d, a) * _side(c, d, b) < 0)
    return near[crossed]


def _side(a: Float, b: Float, c: Float) -> Float:
    """Positive where c lies to the left of the line from a to b."""
    along, across = b - a, c - a
    return np.asarray(along[..., 0] * across[..., 1] - along[..., 1] * across[..., 0])


def _observation_stamps(some: Index, beams: Beams) -> NDArray[np.int64]:
    """Stamps, rising, of the scans with MIN_BEAMS of the beams `some`."""
    scan, count = np.unique(beams.scan[some], return_counts=True)
    return np.asarray(np.sort(beams.stamp_ns[scan[count >= MIN_BEAMS]]))


def _radius(stay: Stay) -> float:
    """Metres from the center of an object to its farthest corner."""
    return float(np.hypot(*(stay.faces.reshape(-1, 2) - stay.center).T).max())


def _distance(xy: Float, stay: Stay) -> Float:
    """(N,) metres from points to an object's center or, if nearer, its faces."""
    return np.minimum(np.hypot(*(xy - stay.center).T), distance_to_walls(xy, stay.faces))


def _mean(values: NDArray[np.bool_]) -> float:
    return float(values.mean()) if len(values) else float("nan")
