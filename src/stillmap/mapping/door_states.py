"""When doors were open and shut, from the beams that ended on their leaves."""

import math
from collections.abc import Sequence

import numpy as np

from stillmap.core.array_types import Cells, Float, Index, Int64
from stillmap.core.arrays import expand_ranges
from stillmap.core.recording import Recording
from stillmap.core.square_box import cell_keys, group_indices
from stillmap.mapping.doors import Door, DoorState, Position
from stillmap.mapping.labelled_recording import LabelledRecording

_BIN_NS = 10**9  # in which the cells that were hit make one observation
# share of the cells of a leaf that are hit in an observation: who walks through hits fewer
_MIN_SHARE = 0.35
_MIN_OBSERVATIONS = 2  # observations of each position
_CROSSED = (0.3, 0.9)  # of the leaf, where beams pass if it is not there
INNER = (0.2, 0.8)  # the same where it is not known which end its hinge is at
_GOES_ON = 0.3  # m beyond it
_MIN_CROSSING, _MAX_SCANS = 3, 500  # scans that show it; scans that are tried
_MAX_DISTANCE = 10.0  # m from the sensor to a leaf: from farther off few beams cross it
_ASIDE = 0.3  # m to either side of a leaf, where surface is its own or goes across
_AROUND_NS = 5 * 10**8  # before and after an observation, in which the leaf is where it was seen
_RATIO = 2.0  # of that share to the one of the other position


def observe_states(doors: Sequence[Door], known: LabelledRecording) -> list[tuple[DoorState, ...]]:
    """The states of each door: its leaf is where beams end on much of one of its positions.

    None where one of the positions was hardly seen.

    Args:
        doors: with the cells of both positions.
        known: 2D, T scans.
    """
    leaves = [np.concatenate([door.shut_cells, door.open_cells]) for door in doors]
    hits, stamp_ns = _find_hits_on(leaves, known), known.recording.stamp_ns
    return [_list_states(door, rows, stamp_ns) for door, rows in zip(doors, hits, strict=True)]


def _find_hits_on(leaves: Sequence[Cells], known: LabelledRecording) -> list[Int64]:
    """(n, 2) scan of each beam that ended on a leaf, and number of the leaf's cell."""
    keys = [cell_keys(leaf) for leaf in leaves]
    orders = [np.argsort(own) for own in keys]
    hits: list[list[Int64]] = [[np.empty((0, 2), np.int64)] for _ in leaves]
    for beam in known.iter_hits() if leaves else ():
        scan, key = known.recording.scans_of(beam), cell_keys(known.end_cells(beam))
        for own, order, rows in zip(keys, orders, hits, strict=True):
            at = np.searchsorted(own, key, sorter=order)
            number = order[np.minimum(at, len(own) - 1)]
            on_leaf = np.flatnonzero(own[number] == key)
            rows.append(np.unique(np.column_stack([scan[on_leaf], number[on_leaf]]), axis=0))
    return [np.concatenate(rows) for rows in hits]


def observe_leaves(leaves: Sequence[Cells], known: LabelledRecording) -> list[Int64]:
    """(L, 2) stamps of the first and the last scan of each second that saw a leaf.

    Args:
        leaves: (K, 2) cells of each.
        known: see `observe_states`.
    """
    hits = _find_hits_on(leaves, known)
    return [
        _list_observations(rows, known.recording.stamp_ns, _MIN_SHARE * len(leaf))
        for leaf, rows in zip(leaves, hits, strict=True)
    ]


def _list_observations(hits: Int64, stamp_ns: Int64, least: float) -> Int64:
    """(L, 2) first and last stamp of the seconds in which that many cells were hit."""
    scan, cell = hits.T
    stamps = stamp_ns[scan]
    observations = [
        (stamps[second].min(), stamps[second].max())
        for second in group_indices((stamps - stamp_ns[0]) // _BIN_NS)
        if len(np.unique(cell[second])) >= least
    ]
    return np.array(observations, np.int64).reshape(-1, 2)


def _list_states(door: Door, hits: Int64, stamp_ns: Int64) -> tuple[DoorState, ...]:
    """Runs of observations (N, 2), of scan and cell, that saw the leaf in the same position."""
    seen: list[DoorState] = []
    counts, contradicted = {"shut": 0, "open": 0}, 0
    bins = (stamp_ns[hits[:, 0]] - stamp_ns[0]) // _BIN_NS
    for second in group_indices(bins):
        scans, number = hits[second].T
        number = np.unique(number)
        n_shut, n_open = len(door.shut_cells), len(door.open_cells)
        shut = int(np.count_nonzero(number < n_shut))
        shares = {"shut": shut / n_shut, "open": (len(number) - shut) / n_open}
        contradicted += min(shares.values()) >= _MIN_SHARE
        position: Position = "shut" if shares["shut"] >= shares["open"] else "open"
        if shares[position] < max(_MIN_SHARE, _RATIO * min(shares.values())):
            continue
        counts[position] += 1
        first, last = int(stamp_ns[scans.min()]), int(stamp_ns[scans.max()])
        seen.append(DoorState(position, first, last))
    # a single one may be of somebody who walks by; a leaf is not in two positions
    swings = min(counts.values()) >= max(_MIN_OBSERVATIONS, contradicted)
    return _join_runs(seen) if swings else ()


def is_passage_observed(door: Door, known: LabelledRecording) -> bool:
    """True if beams passed through one position of the leaf while it was in the other one.

    Two sides of a box that are seen in turn look like a leaf otherwise.
    """
    positions: tuple[tuple[Position, float], ...] = (("open", door.shut), ("shut", door.opened))
    for position, direction in positions:
        scans = _scans_during(door, position, known.recording.stamp_ns)
        along = np.array([np.cos(direction), np.sin(direction)])
        ends = np.array(door.hinge) + door.length * np.array(_CROSSED)[:, None] * along
        if len(_find_crossing(ends, scans, known)) >= _MIN_CROSSING:
            return True
    return False


def observe_passages(ends: Float, observations: Int64, known: LabelledRecording) -> Index:
    """(n,) scans whose beams passed through a leaf while nothing was seen there.

    None where fewer than three did, or where the leaf was never seen. At most 500 scans are looked
    at.

    Args:
        ends: (2, 2) m, of the leaf.
        observations: (L, 2) from `observe_leaves`.
        known: see `observe_states`.
    """
    stamp_ns = known.recording.stamp_ns
    seen = np.zeros(len(stamp_ns), bool)
    for first, last in observations:
        seen |= (stamp_ns >= first - _AROUND_NS) & (stamp_ns <= last + _AROUND_NS)
    sensor = known.recording.T_map_sensor(known.poses)[:, :2, 2]
    is_near = np.linalg.norm(sensor - ends.mean(axis=0), axis=1) <= _MAX_DISTANCE
    inner = ends[0] + np.array(INNER)[:, None] * (ends[1] - ends[0])
    scans = _find_crossing(inner, _thin(np.flatnonzero(is_near & ~seen)), known)
    return scans if len(scans) >= _MIN_CROSSING else scans[:0]


def measure_slope(ends: Float, observations: Int64, known: LabelledRecording) -> float:
    """Slope against a leaf of the surface that some observations hit along it; NaN: there is none.

    Args:
        ends, observations, known: see `observe_passages`.
    """
    recording = known.recording
    first, last = observations[:, :1], observations[:, 1:]
    seen = ((recording.stamp_ns >= first) & (recording.stamp_ns <= last)).any(axis=0)
    beam, _ = _list_hits(_thin(np.flatnonzero(seen)), recording)
    length = float(np.linalg.norm(ends[1] - ends[0]))
    u = (ends[1] - ends[0]) / length
    off = recording.end_points(beam, known.poses) - ends[0]
    along, across = off @ u, _cross(u, off)
    inner = (along > INNER[0] * length) & (along < INNER[1] * length) & (np.abs(across) < _ASIDE)
    if np.count_nonzero(inner) < 2:
        return math.nan
    x, y = (axis[inner] - axis[inner].mean() for axis in (along, across))
    return float((x @ y) / max(x @ x, np.finfo(np.float64).tiny))


def list_runs(position: Position, observations: Int64, passages: Int64) -> tuple[DoorState, ...]:
    """States of a leaf seen in one position at stamps (L, 2), and not there at stamps (n,)."""
    opposite: Position = "shut" if position == "open" else "open"
    seen = [DoorState(position, first, last) for first, last in observations.tolist()]
    seen += [DoorState(opposite, stamp, stamp) for stamp in passages.tolist()]
    return _join_runs(sorted(seen, key=lambda state: state.since_ns))


def _join_runs(seen: Sequence[DoorState]) -> tuple[DoorState, ...]:
    """States with those of one position that follow each other joined."""
    out: list[DoorState] = []
    for state in seen:
        same = bool(out) and out[-1].position == state.position
        out.append(state._replace(since_ns=out.pop().since_ns) if same else state)
    return tuple(out)


def _scans_during(door: Door, position: Position, stamp_ns: Int64) -> Index:
    """Scans in the states of that position, thinned evenly where there are many."""
    inside = np.zeros(len(stamp_ns), bool)
    for state in door.states:
        if state.position == position:
            inside |= (stamp_ns >= state.since_ns) & (stamp_ns <= state.until_ns)
    return _thin(np.flatnonzero(inside))


def _thin(scans: Index) -> Index:
    """At most `_MAX_SCANS` of them, evenly."""
    return scans[:: -(-len(scans) // _MAX_SCANS) or 1]


def find_hit_cells(scans: Index, known: LabelledRecording) -> Cells:
    """(n, 2) cells in which the beams of some scans ended."""
    return known.end_cells(_list_hits(scans, known.recording)[0])


def _list_hits(scans: Index, recording: Recording) -> tuple[Index, Index]:
    """(n,) beams of some scans that hit something, and which of these scans they are of."""
    of, beam = expand_ranges(recording.offset[scans], np.diff(recording.offset)[scans])
    hit = recording.hit[beam]
    return beam[hit], of[hit]


def _find_crossing(ends: Float, scans: Index, known: LabelledRecording) -> Index:
    """Those of some scans of which a beam crosses the segment between ends (2, 2) and goes on."""
    beam, of = _list_hits(scans, known.recording)
    T = known.recording.T_map_sensor(known.poses)[scans]
    start, end = T[of, :2, 2], known.recording.end_points(beam, known.poses)
    a, b = ends
    side = np.stack([_cross(end - start, post - start) for post in (a, b)])
    beyond = _cross(b - a, end - a) * np.sign(_cross(b - a, start - a))
    # by so far that noise does not reach back
    passes = (side.prod(axis=0) < 0.0) & (beyond < -_GOES_ON * np.linalg.norm(b - a))
    return np.asarray(scans[np.unique(of[passes])])


def _cross(a: Float, b: Float) -> Float:
    return np.asarray(a[..., 0] * b[..., 1] - a[..., 1] * b[..., 0])
