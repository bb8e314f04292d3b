"""Scores of tracked objects against the movers of a simulation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.tracking import MovingObject, compute_flow_map
from stillmap.tracking.flow_map import FlowMap

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_MAX_GAP = 2.0  # s without a beam within a sighting
_MAX_FOREIGN = 0.2  # share of beams with another object, or on another mover


@dataclass(frozen=True, eq=False)
class Sighting:
    """A mover observed without a long gap.

    Attributes:
        mover: its number.
        beams: (n,) beams on it, rising.
        scans: (L,) scans with these beams, rising.
    """

    mover: int
    beams: Index
    scans: Index


@dataclass(frozen=True)
class ObjectScores:
    """Scores of tracked objects against the true movers.

    Attributes:
        sightings: number of sightings of movers.
        whole: sightings that are one object: it has more than half of the beams, other objects have
            at most a fifth of them, and at most a fifth of its beams then is not on the mover.
        lost, split, merged: sightings that fail the first, second, third condition; some fail two.
        switches: changes, from scan to scan, of the object with most beams of a sighting.
        objects: number of tracked objects.
        false: those with most beams on static objects.
        speed_error: m/s, median over all detections of the chosen movers.
    """

    sightings: int
    whole: int
    lost: int
    split: int
    merged: int
    switches: int
    objects: int
    false: int
    speed_error: float


def find_sightings(
    mover: NDArray[np.int32],
    offset: NDArray[np.int64],
    seconds: Float,
    chosen: Sequence[int],
    min_seconds: float = 3.0,
) -> list[Sighting]:
    """Find the sightings of movers that last for more than `min_seconds` seconds of scans.

    Args:
        mover: (M,) number of the mover that reflected each beam, -1: none.
        offset: (T + 1,) scan t has the beams offset[t]:offset[t + 1].
        seconds: (T,) times of the scans.
        chosen: numbers of movers.
        min_seconds: minimum duration.
    """
    times = np.unique(seconds)  # lasers may scan at once
    period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    out = []
    for number in chosen:
        beams = np.flatnonzero(mover == number)
        scan = np.searchsorted(offset, beams, side="right") - 1
        gaps = np.flatnonzero(np.diff(seconds[scan]) > _MAX_GAP) + 1
        for some in np.split(np.arange(len(beams)), gaps):
            scans = np.unique(scan[some])
            if len(np.unique(seconds[scans])) * period > min_seconds:
                out.append(Sighting(int(number), beams[some], scans))
    return out


def score_objects(
    objects: Sequence[MovingObject],
    mover: NDArray[np.int32],
    movers: Float,
    offset: NDArray[np.int64],
    seconds: Float,
    chosen: Sequence[int],
) -> ObjectScores:
    """Score tracked objects.

    Args:
        objects: tracked objects.
        mover: (M,) number of the mover that reflected each beam, -1: none.
        movers: (T, P, 3) pose of each mover at each scan; x, y in metres.
        offset, seconds: of the recording, see `find_sightings`.
        chosen: numbers of the movers that are scored: people.
    """
    owner = np.full(len(mover), -1)
    for number, one in enumerate(objects):
        owner[one.beams] = number
    seen = find_sightings(mover, offset, seconds, chosen)
    failed = np.array([_failures(one, owner, mover, offset) for one in seen]).reshape(-1, 3)
    main = [_most_frequent(mover[one.beams]) for one in objects]
    return ObjectScores(
        sightings=len(seen),
        whole=int(np.sum(~failed.any(axis=1))),
        lost=int(failed[:, 0].sum()),
        split=int(failed[:, 1].sum()),
        merged=int(failed[:, 2].sum()),
        switches=sum(_switches(one, owner, offset) for one in seen),
        objects=len(objects),
        false=sum(number < 0 for number in main),
        speed_error=_speed_error(objects, main, movers, seconds, set(chosen)),
    )


def _most_frequent(numbers: NDArray[np.int32]) -> int:
    values, count = np.unique(numbers, return_counts=True)
    return int(values[count.argmax()])


def _failures(
    one: Sighting, owner: Index, mover: NDArray[np.int32], offset: NDArray[np.int64]
) -> tuple[bool, bool, bool]:
    """Whether a sighting is lost, split, merged."""
    with_objects = owner[one.beams][owner[one.beams] >= 0]
    if len(with_objects) == 0:
        return True, False, False
    count = np.bincount(with_objects)
    main, n = int(count.argmax()), len(one.beams)
    first, last = offset[one.scans[0]], offset[one.scans[-1] + 1]
    of_main = mover[first:last][owner[first:last] == main]
    return (
        bool(count[main] <= 0.5 * n),
        bool(len(with_objects) - count[main] > _MAX_FOREIGN * n),
        bool(np.mean(of_main != one.mover) > _MAX_FOREIGN),
    )


def _switches(one: Sighting, owner: Index, offset: NDArray[np.int64]) -> int:
    """Number of changes, from scan to scan, of the object with most beams on a mover."""
    scan = np.searchsorted(offset, one.beams, side="right") - 1
    found = owner[one.beams] >= 0
    pairs, count = np.unique(
        np.column_stack([scan, owner[one.beams]])[found], axis=0, return_counts=True
    )
    order = np.lexsort((-count, pairs[:, 0]))
    _, first = np.unique(pairs[order, 0], return_index=True)
    return int(np.count_nonzero(np.diff(pairs[order][first, 1])))


def _speed_error(
    objects: Sequence[MovingObject],
    main: list[int],
    movers: Float,
    seconds: Float,
    chosen: set[int],
) -> float:
    times, first, which = np.unique(seconds, return_index=True, return_inverse=True)
    if len(times) < 2:
        return float("nan")
    velocity = np.gradient(movers[first][:, :, :2], times, axis=0)[which]
    off = [
        np.abs(
            np.linalg.norm(one.velocity, axis=1)
            - np.linalg.norm(velocity[one.scan, number], axis=1)
        )
        for one, number in zip(objects, main, strict=True)
        if number in chosen
    ]
    return float(np.median(np.concatenate(off))) if off else float("nan")


def compute_true_flow_map(
    seen: Sequence[Sighting],
    movers: Float,
    stamp_ns: NDArray[np.int64],
    T_map_world: Float,
    resolution: float,
) -> FlowMap:
    """Flow map of the true movers during their sightings, in the map frame.

    Args:
        seen: from `find_sightings`.
        movers: (T, P, 3) x, y, heading in the world.
        stamp_ns: (T,) of the scans.
        T_map_world: (3, 3).
        resolution: metres.
    """
    none = np.zeros(0, np.intp)
    objects = []
    for one in seen:
        x, y, _ = movers[one.scans, one.mover].T
        xy = se2.parameters(T_map_world @ se2.matrix(x, y, np.zeros_like(x)))[:, :2]
        velocity = np.zeros_like(xy)
        objects.append(
            MovingObject(0, one.scans, stamp_ns[one.scans], xy, velocity, (0.0, 0.0), none, 1.0)
        )
    return compute_flow_map(objects, resolution)


def compute_rank_correlation(found: FlowMap, true: FlowMap, points: Float) -> float:
    """Spearman's rank correlation of the crossings of squares; NaN where all are equal.

    Args:
        found, true: flow maps of one resolution.
        points: (n, 2) metres, points of the observed floor: their squares are compared.
    """
    from scipy.stats import spearmanr  # takes long to load

    if found.resolution != true.resolution:
        raise ValueError(f"resolution: expected {true.resolution}, got {found.resolution}")
    squares = np.unique(np.floor(points / true.resolution).astype(np.int64), axis=0)
    a, b = _crossings(found, squares), _crossings(true, squares)
    if len(squares) < 2 or np.ptp(a) == 0 or np.ptp(b) == 0:
        return float("nan")
    return float(spearmanr(a, b).statistic)


def _crossings(one: FlowMap, squares: NDArray[np.int64]) -> NDArray[np.int64]:
    """(K,) crossings of squares, column and row from the origin of the map; 0 outside."""
    first = np.round(np.array(one.origin[:2]) / one.resolution).astype(np.int64)
    column, row = (squares - first).T
    height, width = one.crossings.shape
    inside = (row >= 0) & (row < height) & (column >= 0) & (column < width)
    out = np.zeros(len(squares), np.int64)
    out[inside] = one.crossings[row[inside], column[inside]]
    return out
