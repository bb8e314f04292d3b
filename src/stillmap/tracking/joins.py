"""Which pieces of tracks are of one mover: hypotheses over occlusions, weighed against each other.

A piece that ends may go on in any piece that begins within seconds. Each such join has a likelihood
ratio to the hypothesis that the later piece is of somebody else; a piece goes on in at most one
other. Belief propagation (Williams and Lau, IEEE Trans. Aerosp. Electron. Syst. 50, 2014) finds
the probability of each join among its rivals. Certain joins are made first: longer pieces have
better known velocities.
"""

from typing import NamedTuple

import numpy as np

from stillmap.core import kalman
from stillmap.core.array_types import Bool, Float, Index
from stillmap.core.arrays import expand_ranges
from stillmap.core.kalman import TrackStates

_MIN_P = (0.97, 0.95, 0.9, 0.8, 0.6, 0.4, 0.05)  # of joins, round by round
_MAX_GAP = 4.0  # s
_MAX_SPEED = 2.5  # m/s from one end to the other, besides
_MAX_STEP = 1.0  # m
_MAX_ENDS = 1 << 12  # ends compared at once
_MIN_LOG_RATIO = -3.0  # below it, joins are no rivals

_HORIZON = 2.0  # s of a piece that determine its state at an end
_POSITION_STD, _PERSISTENCE = 0.15, 0.3  # m; s for which gait and visible side displace a centroid
_SIDE_STD = 0.12  # m: of another side, or leg, after the gap
_SPEED_STD, _FAST_SPEED_STD = kalman.SPEED_STD, 10.0  # m/s, of walkers and vehicles
# m2/s3: spectral density of the acceleration of who walks on, and of who turns or stops; share
_STEADY, _UNSTEADY, _UNSTEADY_SHARE = 0.2, 3.0, 0.2
_WIDTH_STD = 0.15  # m: change of the width of one mover (legs, turns, partly hidden)
_SEEN_AGAIN = 0.5  # P that who is no longer seen is seen again
_HIDDEN = 1.5  # s, mean duration of occlusions
_BIRTHS = 0.002  # pieces of others that begin per m2 and s
_ROUNDS = 50  # of belief propagation
_MAX_EXPONENT = 50.0


class Detections(NamedTuple):
    """L detections of pieces.

    Attributes:
        piece: (L,) numbers from 0 to K - 1; pieces have no scan in common with their successors.
        seconds: (L,) times.
        xy: (L, 2) centroids, m.
        width: (L,) metres across the line of sight.
    """

    piece: Index
    seconds: Float
    xy: Float
    width: Float


class _Ends(NamedTuple):
    """First and last times (K,) and states of K pieces; their widths, and variances of these.

    `speed_std` (K,) m/s is the spread of speeds of their kind.
    """

    first: Float
    last: Float
    at_first: TrackStates
    at_last: TrackStates
    width: Float
    width_variance: Float
    speed_std: Float


def join_pieces(detections: Detections, is_fast: Bool, period: float) -> tuple[Index, Float]:
    """Join the pieces of each mover.

    Args:
        detections: the detections.
        is_fast: (K,) pieces of vehicles.
        period: s from scan to scan.

    Returns:
        (K,) first piece of the mover that each is of; (K,) the probability that all pieces of the
        mover that begins with it are of one, 1 of a piece alone.
    """
    label, log_p = np.arange(len(is_fast)), np.zeros(len(is_fast))
    if not len(label):
        return label, log_p
    for min_p in _MIN_P:
        node, of_label = np.unique(label, return_inverse=True)
        ends = _describe_ends(detections, of_label[detections.piece], is_fast[node], period)
        before, after, log_ratio = _find_candidates(ends)
        p = compute_marginals(before, after, log_ratio, len(node))
        root = np.arange(len(node))
        following, cost = _choose(before, after, p, min_p, len(node))
        for k in np.argsort(ends.first, kind="stable").tolist():
            if following[k] >= 0:
                root[following[k]] = root[k]
                log_p[node[root[k]]] += cost[k] + log_p[node[following[k]]]
        label = node[root[of_label]]
    return label, np.exp(log_p)


def compute_marginals(before: Index, after: Index, log_ratio: Float, n: int) -> Float:
    """(P,) probability of each join (before, after) of n pieces, one successor at most each.

    Args:
        before, after: (P,) pieces.
        log_ratio: (P,) of the join to none of the two with any other.
    """
    ratio = np.exp(np.clip(log_ratio, -_MAX_EXPONENT, _MAX_EXPONENT))
    free = np.ones(len(ratio))  # how far the later piece is left by its other rivals
    for _ in range(_ROUNDS):
        pull = ratio * free
        # a sum less one of its terms can be negative by rounding
        others = np.maximum(np.bincount(before, pull, minlength=n)[before] - pull, 0.0)
        pull = ratio / (1.0 + others)
        free = 1.0 / (1.0 + np.maximum(np.bincount(after, pull, minlength=n)[after] - pull, 0.0))
    pull = ratio * free
    return np.asarray(pull / (1.0 + np.bincount(before, pull, minlength=n)[before]))


def _choose(
    before: Index, after: Index, p: Float, min_p: float, n: int
) -> tuple[Index, list[float]]:
    """(n,) the successor of each piece, -1: none, and ln P of it; the most probable joins first."""
    following, cost, taken = np.full(n, -1), [0.0] * n, np.zeros(n, bool)
    order = np.argsort(-p, kind="stable")
    for k in order[: np.searchsorted(-p[order], -min_p, side="right")].tolist():
        if following[before[k]] < 0 and not taken[after[k]]:
            following[before[k]], taken[after[k]] = after[k], True
            cost[before[k]] = float(np.log(min(p[k], 1.0)))
    return following, cost


def _describe_ends(detections: Detections, node: Index, is_fast: Bool, period: float) -> _Ends:
    """Ends of nodes, of which each detection (L,) has one."""
    order = np.lexsort((detections.seconds, node))
    node, t, xy = node[order], detections.seconds[order], detections.xy[order]
    first = np.flatnonzero(np.diff(node, prepend=-1))
    count = np.diff(first, append=len(node))
    last = first + count - 1
    std = _POSITION_STD * np.sqrt(max(1.0, _PERSISTENCE / max(period, 1e-3)))
    speed_std = np.where(is_fast, _FAST_SPEED_STD, _SPEED_STD)
    since, until = t - t[first][node], t[last][node] - t
    early = np.bincount(node[since <= _HORIZON], minlength=len(first))
    late = np.bincount(node[until <= _HORIZON], minlength=len(first))
    width = np.bincount(node, detections.width[order]) / count
    spread = np.bincount(node, (detections.width[order] - width[node]) ** 2) / count
    return _Ends(
        t[first],
        t[last],
        _filter(t, xy, first, early, -1, std, speed_std),
        _filter(t, xy, last, late, 1, std, speed_std),
        width,
        # widths of scans in a row are alike
        (spread + _WIDTH_STD**2 / 4.0) * np.minimum(4.0 / count, 1.0),
        speed_std,
    )


def _filter(
    t: Float, xy: Float, end: Index, count: Index, step: int, std: float, speed_std: Float
) -> TrackStates:
    """States at the detections `end` (K,) given the `count` (K,) ones up to there.

    These are end, end - step, end - 2 step, ...; backwards in time for step = -1.
    """
    longest = int(count.max(initial=1))
    rank = np.minimum(np.arange(longest)[::-1], count[:, None] - 1)
    which = end[:, None] - step * rank
    states = kalman.initialize(xy[which[:, 0]], std)
    states.P[:, 2] = speed_std**2
    for c in range(1, longest):
        observed = which[:, c] != which[:, c - 1]
        dt = t[which[:, c]] - t[which[:, c - 1]]
        states = kalman.predict(states, dt, _STEADY)
        states = kalman.update(states, observed, xy[which[:, c]], std)
    states.P[:, 0] += _SIDE_STD**2
    return states


def _find_candidates(ends: _Ends) -> tuple[Index, Index, Float]:
    """Pairs (P,) of pieces that may be of one mover, and their log likelihood ratios."""
    order = np.argsort(ends.first, kind="stable")
    begins, parts = ends.first[order], []
    for some in range(0, len(order), _MAX_ENDS):
        k = np.arange(some, min(some + _MAX_ENDS, len(order)))
        low = np.searchsorted(begins, ends.last[k], side="right")
        count = np.searchsorted(begins, ends.last[k] + _MAX_GAP, side="right") - low
        of, at = expand_ranges(low, count)
        before, after = k[of], order[at]
        gap = ends.first[after] - ends.last[before]
        step = np.linalg.norm(ends.at_first.x[after] - ends.at_last.x[before], axis=1)
        speed = np.where(ends.speed_std[before] > _SPEED_STD, 3.0 * _FAST_SPEED_STD, _MAX_SPEED)
        near = step < _MAX_STEP + speed * gap
        before, after = before[near], after[near]
        log_ratio = _compare(ends, before, after)
        rivals = log_ratio > _MIN_LOG_RATIO
        parts.append((before[rivals], after[rivals], log_ratio[rivals]))
    before, after, log_ratio = (np.concatenate(column) for column in zip(*parts, strict=True))
    return before, after, log_ratio


def _compare(ends: _Ends, before: Index, after: Index) -> Float:
    """(P,) log likelihood ratio of pairs: that one goes on as the other, against another mover."""
    gap = ends.first[after] - ends.last[before]
    start, end = ends.at_last.select(before), ends.at_first.select(after)
    motion = np.logaddexp(
        _log_density(kalman.predict(start, gap, _STEADY), end) + np.log(1.0 - _UNSTEADY_SHARE),
        _log_density(kalman.predict(start, gap, _UNSTEADY), end) + np.log(_UNSTEADY_SHARE),
    )
    duration = np.log(_SEEN_AGAIN / _HIDDEN) - gap / _HIDDEN
    variance = ends.speed_std[after] ** 2 + end.P[:, 2]
    unrelated = np.log(_BIRTHS / (2.0 * np.pi * variance)) - 0.5 * (end.v**2).sum(axis=1) / variance
    return np.asarray(motion + duration + _compare_widths(ends, before, after) - unrelated)


def _log_density(predicted: TrackStates, detected: TrackStates) -> Float:
    """(P,) ln of the density of the difference of two states, of position and velocity."""
    xx, xv, vv = (predicted.P + detected.P).T
    dx, dv = detected.x - predicted.x, detected.v - predicted.v
    determinant = xx * vv - xv**2
    squares = vv * (dx**2).sum(axis=1) - 2.0 * xv * (dx * dv).sum(axis=1)
    squares += xx * (dv**2).sum(axis=1)
    return np.asarray(-0.5 * squares / determinant - np.log(4.0 * np.pi**2 * determinant))


def _compare_widths(ends: _Ends, before: Index, after: Index) -> Float:
    """(P,) log likelihood ratio of the later width, given the earlier one or nothing."""
    mean, spread = float(ends.width.mean()), float(ends.width.var())
    own = ends.width_variance[after] + _WIDTH_STD**2
    same, unrelated = own + ends.width_variance[before], own + spread
    off, apart = ends.width[after] - mean, ends.width[after] - ends.width[before]
    return np.asarray(0.5 * (off**2 / unrelated - apart**2 / same + np.log(unrelated / same)))
