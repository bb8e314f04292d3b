"""Scores of what moved against the truth of a simulation."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.tracking import MovingObject, compute_flow_map
from stillmap.tracking.flow_map import FlowMap

Float = NDArray[np.float64]
Index = NDArray[np.intp]

_GAP = 2.0  # s without a beam on somebody, after which he is seen anew
_TOO_MUCH = 0.2  # share of beams with another object, or of something else


@dataclass(frozen=True, eq=False)
class Sighting:
    """A mover while it is seen without a long gap.

    Attributes:
        mover: its number.
        beams: (n,) beams on it, rising.
        scans: (L,) scans that saw it, rising.
    """

    mover: int
    beams: Index
    scans: Index


@dataclass(frozen=True)
class ObjectScores:
    """How well objects agree with movers.

    Attributes:
        sightings: of movers that were seen for long enough.
        whole: how many of them are one object: it has more than half of their beams, no more than
            a fifth of them is with other objects, and no more than a fifth of its beams then is of
            anything else.
        lost, split, merged: how many fail in the first, second, third of these; some in two.
        switches: times that the object with most beams of a sighting changed from scan to scan.
        objects: how many were found.
        false: those with most beams on what is static.
        speed_error: m/s, median over all scans that saw a mover of the sightings' kind.
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
    """When movers were seen, for more than `least` seconds: as many scans as that.

    Args:
        mover: (M,) number of what reflected each beam, -1: nothing that moves.
        offset: (T + 1,) scan t has the beams offset[t]:offset[t + 1].
        seconds: (T,) when.
        chosen: numbers of movers.
        least: seconds that a mover must be seen for.
    """
    times = np.unique(seconds)  # lasers may scan at once
    period = float(np.median(np.diff(times))) if len(times) > 1 else 0.0
    out = []
    for number in chosen:
        beams = np.flatnonzero(mover == number)
        scan = np.searchsorted(offset, beams, side="right") - 1
        gaps = np.flatnonzero(np.diff(seconds[scan]) > _GAP) + 1
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
    """Scores of objects.

    Args:
        objects: what was found.
        mover: (M,) number of what reflected each beam, -1: nothing that moves.
        movers: (T, P, 3) where each mover is at each scan; x, y in metres.
        offset, seconds: of the recording, as `sightings` has them.
        chosen: numbers of the movers that are scored: people.
    """
    owner = np.full(len(mover), -1)
    for number, one in enumerate(objects):
        owner[one.beams] = number
    seen = find_sightings(mover, offset, seconds, chosen)
    failed = np.array([_failures(one, owner, mover, offset) for one in seen]).reshape(-1, 3)
    most = [_most(mover[one.beams]) for one in objects]
    return ObjectScores(
        sightings=len(seen),
        whole=int(np.sum(~failed.any(axis=1))),
        lost=int(failed[:, 0].sum()),
        split=int(failed[:, 1].sum()),
        merged=int(failed[:, 2].sum()),
        switches=sum(_switches(one, owner, offset) for one in seen),
        objects=len(objects),
        false=sum(number < 0 for number in most),
        speed_error=_speed_error(objects, most, movers, seconds, set(chosen)),
    )


def _most(numbers: NDArray[np.int32]) -> int:
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
        bool(len(with_objects) - count[main] > _TOO_MUCH * n),
        bool(np.mean(of_main != one.mover) > _TOO_MUCH),
    )


def _switches(one: Sighting, owner: Index, offset: NDArray[np.int64]) -> int:
    """How often the object with most beams on a mover changes."""
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
    most: list[int],
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
        for one, number in zip(objects, most, strict=True)
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
    """How often squares were crossed by movers while they were seen, in the map frame.

    Args:
        seen: from `sightings`.
        movers: (T, P, 3) x, y, heading in the world.
        stamp_ns: (T,) of the scans.
        T_map_world: (3, 3).
        resolution: metres.
    """
    none = np.zeros(0, np.intp)
    ways = []
    for one in seen:
        x, y, _ = movers[one.scans, one.mover].T
        xy = se2.parameters(T_map_world @ se2.matrix(x, y, np.zeros_like(x)))[:, :2]
        velocity = np.zeros_like(xy)
        ways.append(
            MovingObject(0, one.scans, stamp_ns[one.scans], xy, velocity, (0.0, 0.0), none, 1.0)
        )
    return compute_flow_map(ways, resolution)


def compute_rank_correlation(found: FlowMap, true: FlowMap, points: Float) -> float:
    """Spearman's correlation of how often squares were crossed; NaN where nothing ever was.

    Args:
        found, true: with squares of the same size.
        points: (n, 2) metres, points of the floor that was looked at: their squares are compared.
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
