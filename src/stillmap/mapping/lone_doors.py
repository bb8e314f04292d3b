"""Doors whose leaf was seen in one position only: which there are, and whether they moved.

That a shut leaf moved is seen where beams passed through it at other times. Whether others moved
unseen follows from how often doors swing.
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np

import stillmap._core as _core
from stillmap import em
from stillmap.core.array_types import Cells, Float, Float32, Index, Int64
from stillmap.core.chunks import iter_beams
from stillmap.core.square_box import cell_keys
from stillmap.mapping import door_states, doorways
from stillmap.mapping.doors import Door, DoorState
from stillmap.mapping.doorways import LoneLeaf
from stillmap.mapping.labelled_recording import LabelledRecording
from stillmap.mapping.lone_leaves import find_open_leaf, is_doorway_free, is_thin

_RATES = np.geomspace(1e-5, 1.0, 61)  # per s, of swings, each as probable before any is seen
_WATCHED = 2.0  # s between two observations within which a swing would have been seen
_LEAST = 1e-3  # s that a swing takes


def compute_p_moved(
    doors: Sequence[Door], observations: Sequence[Int64], stamp_ns: Int64
) -> tuple[Float, Float]:
    """Probability that each of some doors was in the same position in all observations, (K,), and
    if it was, that it moved while nobody saw it, (K,).

    A door swings at a constant rate, the same for all of them. The two positions of a door that
    swung at the rate r differ after t with probability (1 - exp(-2 r t)) / 2.

    Args:
        doors: those that were seen to swing.
        observations: (L, 2) of each of the others, see `observe_leaves`.
        stamp_ns: (T,) of the recording.
    """
    spans = [_split_observations(stamps) for stamps in observations]
    log_same = [
        np.log(0.5 * (1.0 + np.exp(-2.0 * np.outer(_RATES, gaps)))).sum(axis=1) - _RATES * watched
        for watched, gaps in spans
    ]
    swings = [_log_likelihood_of_swings(door) for door in doors]
    log_likelihood = np.sum([np.zeros(len(_RATES)), *swings, *log_same], axis=0)
    posterior = _normalize(log_likelihood)
    # by the rate that all others tell
    same = [float(_normalize(log_likelihood - own) @ np.exp(own)) for own in log_same]
    moved = []
    for stamps, (_, gaps) in zip(observations, spans, strict=True):
        ends = 1e-9 * float((stamps[0, 0] - stamp_ns[0]) + (stamp_ns[-1] - stamps[-1, 1]))
        # it was in one position at both ends of a gap: an even number of swings, none with 1 / cosh
        expected = np.outer(_RATES, gaps)  # swings within each gap
        log_still = -_RATES * ends - np.logaddexp(expected, -expected).sum(axis=1)
        log_still += len(gaps) * math.log(2.0)
        moved.append(1.0 - float(posterior @ np.exp(log_still)))
    return np.array(same), np.array(moved)


def _normalize(log_likelihood: Float) -> Float:
    """(R,) probability of each rate."""
    weights = np.exp(log_likelihood - log_likelihood.max())
    return np.asarray(weights / weights.sum())


def _log_likelihood_of_swings(door: Door) -> Float:
    """(R,) of the states of a door, at each rate.

    Each state lasts from the first to the last time the leaf was seen so; it may have moved to and
    fro meanwhile.
    """
    spans = np.array([[state.since_ns, state.until_ns] for state in door.states], float)
    since, until = 1e-9 * spans.T
    between = np.maximum(since[1:] - until[:-1], _LEAST)
    differs = 0.5 * -np.expm1(-2.0 * np.outer(_RATES, between))
    same = 0.5 * (1.0 + np.exp(-2.0 * np.outer(_RATES, until - since)))
    return np.asarray(np.log(differs).sum(axis=1) + np.log(same).sum(axis=1))


def _split_observations(stamps: Int64) -> tuple[float, Float]:
    """Seconds in which a leaf was watched, and the gaps between them."""
    pauses = 1e-9 * (stamps[1:, 0] - stamps[:-1, 1]).astype(np.float64)
    observed = 1e-9 * float((stamps[:, 1] - stamps[:, 0]).sum())
    return observed + float(pauses[pauses <= _WATCHED].sum()), pauses[pauses > _WATCHED]


_P_LEAF = 36.0 / 37.0  # 35 of 35 open ones in four simulated offices were; rule of succession
_P_PASSED = 27.0 / 28.0  # the same of shut ones that beams passed: 26 of 26 in nine offices
_MIN_MOVED = 0.8  # share of the inner part of the leaf that must be gone meanwhile
_MAX_SLOPE = 0.1  # of the surface of a leaf against the doorway; .04 at most of these 26
_MIN_P_LISTED = 0.1  # that what fills a doorway is a door at all
_LOOK = 0.2  # s between scans whose beams show what is free
_THREADS = 2  # that count beams: every one has a heap of its own
_MAX_COMMON = 0.3  # share of the cells of a leaf that may be of another door


def find_lone_doors(surface: Cells, doors: Sequence[Door], known: LabelledRecording) -> list[Door]:
    """Doors whose leaf was in the same position whenever it was seen.

    Args:
        surface: (S, 2) cells that are occupied most of the time.
        doors: those that were seen to swing.
        known: 2D.
    """
    gaps = doorways.find_doorways(surface, known.resolution)
    if not gaps:
        return []
    counts = _count_beams(known)
    free = [gap for gap in gaps if is_doorway_free(gap, counts)]
    candidates = [
        find(gap, surface) for find in (find_open_leaf, doorways.find_shut_leaf) for gap in free
    ]
    taken, leaves = [door.swept_cells for door in doors], list[LoneLeaf]()
    for leaf in candidates:
        if leaf is None or not len(leaf.cells):  # of coarse cells, all may be at the wall
            continue
        is_leaf = not leaf.is_open or is_thin(leaf, counts)
        if is_leaf and not any(_is_part(leaf.cells, cells) for cells in taken):
            taken.append(leaf.cells)
            leaves.append(leaf)
    return _observe(leaves, doors, known)


def _count_beams(known: LabelledRecording) -> _core.OccupancyGrid2D:
    """Counts of the hits of some scans, as if all were static."""
    recording, threads = known.recording, min(known.threads, _THREADS)
    seconds = 1e-9 * float(recording.stamp_ns[-1] - recording.stamp_ns[0])
    every = max(1, int(_LOOK * recording.n_scans / max(seconds, _LOOK)))
    counts = _core.OccupancyGrid2D(known.resolution, moments=False)
    for scans, _, (points, hit, offset, T_map_sensor) in iter_beams(recording, known.poses):
        is_looked_at = np.arange(scans.start, scans.stop) % every == 0
        used = hit & np.repeat(is_looked_at, np.diff(offset))
        ends = np.where(used[:, None], points, np.float32(np.nan))
        weights = np.ones(len(used), np.float32)
        _core.add_beams(counts, ends, used, weights, offset, T_map_sensor, threads)
    return counts


def _observe(
    leaves: Sequence[LoneLeaf], doors: Sequence[Door], known: LabelledRecording
) -> list[Door]:
    """The doors with these leaves, when they were seen, and P(moved)."""
    stamp_ns = known.recording.stamp_ns
    observations = door_states.observe_leaves([leaf.cells for leaf in leaves], known)
    passed_doors, lone_doors, lone_observations = list[Door](), list[Door](), list[Int64]()
    for leaf, seen in zip(leaves, observations, strict=True):
        if not len(seen):
            continue
        passed = np.empty(0, np.intp)
        if not leaf.is_open:
            leaf, passed = _find_passages(leaf, seen, known)
        states = door_states.list_runs("open" if leaf.is_open else "shut", seen, stamp_ns[passed])
        door = _make_door(leaf, known.resolution, states)
        if len(passed):
            passed_doors.append(door)
        else:
            lone_doors.append(door)
            lone_observations.append(seen)
    rated = _rate_lone(lone_doors, lone_observations, [*doors, *passed_doors], stamp_ns)
    return [*passed_doors, *rated]


def _find_passages(
    leaf: LoneLeaf, observations: Int64, known: LabelledRecording
) -> tuple[LoneLeaf, Index]:
    """A shut leaf without what is hit while beams pass through it, and the scans of these.

    What is hit then is the edge of a wall; where little else is left, it is no leaf that moved. Nor
    is it one if the surface that was seen there does not lie along the doorway.
    """
    ends = known.resolution * (leaf.hinge + 0.5 + np.outer([0.0, leaf.length], leaf.shut))
    scans = door_states.observe_passages(ends, observations, known)
    hit = door_states.find_hit_cells(scans, known)
    moved = leaf._replace(cells=leaf.cells[~np.isin(cell_keys(leaf.cells), cell_keys(hit))])
    along = np.round((moved.cells - leaf.hinge) @ leaf.shut)
    first, last = (share * leaf.length for share in door_states.INNER)
    inner = np.arange(math.ceil(first), last)
    if np.isin(inner, along).mean() < _MIN_MOVED:
        return leaf, scans[:0]
    if not abs(door_states.measure_slope(ends, observations, known)) <= _MAX_SLOPE:
        return leaf, scans[:0]
    return moved, scans


def _rate_lone(
    lone: Sequence[Door], observations: Sequence[Int64], swung: Sequence[Door], stamp_ns: Int64
) -> list[Door]:
    """The doors seen in one position with P(moved), without those that hardly are doors."""
    is_open = np.array([len(door.open_cells) > 0 for door in lone], bool)
    same, moved = compute_p_moved(swung, observations, stamp_ns)
    p_door = np.full(len(lone), _P_LEAF)
    p_shut = doorways.estimate_shut_share(swung) * same[~is_open]
    p_door[~is_open] = doorways.estimate_p_door(p_shut, len(swung) + int(is_open.sum()))
    return [
        dataclasses.replace(lone[k], p_moved=float(moved[k] * p_door[k]))
        for k in np.flatnonzero(p_door >= _MIN_P_LISTED).tolist()
    ]


def _is_part(cells: Cells, others: Cells) -> bool:
    return bool(np.isin(cell_keys(cells), cell_keys(others)).mean() > _MAX_COMMON)


def _make_door(leaf: LoneLeaf, resolution: float, states: tuple[DoorState, ...]) -> Door:
    x, y = ((leaf.hinge + 0.5) * resolution).tolist()
    none = np.empty((0, 2), np.int64)
    return Door(
        hinge=(x, y),
        length=leaf.length * resolution,
        shut=math.atan2(leaf.shut[1], leaf.shut[0]),
        opened=math.atan2(leaf.leaf[1], leaf.leaf[0]) if leaf.is_open else math.nan,
        shut_cells=none if leaf.is_open else leaf.cells,
        open_cells=leaf.cells if leaf.is_open else none,
        swept_cells=leaf.cells,
        states=states,
        p_moved=_P_PASSED,
    )


def relabel_lone_doors(
    known: LabelledRecording,
    occupied: em.CellProbabilities,
    histories: em.CellHistories,
    doors: Sequence[Door],
    state: em.MapState,
) -> tuple[Float32, em.CellProbabilities]:
    """Labels (M,) and map cells with doors whose leaf was seen in one position only.

    P(static) of a beam on a leaf that stood open, or that beams passed, is less by the probability
    that the leaf moved. The map shows it where it was found, unless the door is to be, or was seen
    to be, in the other position. What else fills a doorway stays as it is: it may be the back of a
    niche.

    Args:
        known: M beams, with labels to be changed.
        occupied: to be changed.
        histories: with the surfels of the same cells.
        doors: from `find_lone_doors`.
        state: state of changed places that the map shows.
    """
    doors = [door for door in doors if len(door.open_cells) or len(door.states) > 1]
    if not doors:
        return known.p_static, occupied
    keys, p_moved = cell_keys(histories.cells), np.zeros(len(histories.cells), np.float32)
    p_occupied = occupied.p_occupied.copy()
    for door in doors:
        is_open = len(door.open_cells) > 0
        on_leaf = np.isin(keys, cell_keys(door.open_cells if is_open else door.shut_cells))
        p_moved[on_leaf] = np.maximum(p_moved[on_leaf], door.p_moved)
        if door.position_in(state) != ("open" if is_open else "shut"):
            p_occupied[on_leaf] = 0.0
        elif len(door.states) > 1:  # of what moved all cells are shown
            p_occupied[on_leaf] = histories.p_in_cell[on_leaf]
    out = known.copy_labels()
    for beams, surfel in known.iter_surfels(histories, out):
        ended = np.flatnonzero(surfel >= 0)
        out[beams][ended] *= 1.0 - p_moved[surfel[ended]]
    return out, dataclasses.replace(occupied, p_occupied=p_occupied)
