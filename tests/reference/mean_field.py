"""Mean-field inference of P(static) in a Markov random field over surfels."""

# ruff: noqa: ARG001  (threads: as the kernels have it)

from itertools import product

import numpy as np


def smooth_mean_field(
    surfel_map,
    log_odds,
    *,
    radius,
    coplanar_std,
    static_coupling,
    dynamic_coupling,
    min_log_odds,
    max_log_odds,
    tolerance,
    max_iterations,
    threads=1,
):
    """(E,) P(static) from the log odds (E,) of each surfel alone and from its neighbours.

    Lengths are in cells. Each iteration updates the surfels with a neighbour whose probability
    changed by more than `tolerance` in the iteration before (at first: all of them):

        log odds = clip(own, min_log_odds, max_log_odds)
            + (static_coupling S - dynamic_coupling M) / (1 + W)

    S and M are sums of w |2 p - 1| over static and dynamic neighbours, W is the sum of w.
    """
    own = np.asarray(log_odds, float)
    adjacent = [
        [
            (j, coplanarity(surfel_map, i, j, coplanar_std))
            for j in neighbours(surfel_map, i, radius)
        ]
        for i in range(surfel_map.size)
    ]
    p, active = _probability(own), set(range(surfel_map.size))
    hit_spans = surfel_map.hit_spans.tolist()
    for _ in range(max_iterations):
        before = p.copy()
        for i in active:
            odds = np.clip(own[i], min_log_odds, max_log_odds)
            p[i] = _probability(
                odds
                + _neighbour_log_odds(
                    hit_spans, i, adjacent[i], before, static_coupling, dynamic_coupling
                )
            )
        changed = np.flatnonzero(np.abs(p - before) > tolerance)
        active = {j for i in changed for j, _ in adjacent[i]}
    return p


def neighbours(surfel_map, i, radius):
    """Surfels within a radius, in cells."""
    number, reach = surfel_map.index_of_cell(), int(radius)
    for off in product(range(-reach, reach + 1), repeat=surfel_map.dimension):
        cell = tuple(np.add(surfel_map.fitted[i].cell, off).tolist())
        if 0 < np.sum(np.square(off)) <= radius**2 and cell in number:
            yield number[cell]


def coplanarity(surfel_map, i, j, coplanar_std):
    """Weight of a pair by the distance of each mean from the plane of the other."""
    one, other = surfel_map.fitted[i], surfel_map.fitted[j]
    offset = (other.mean - one.mean) / surfel_map.resolution
    distance = max(abs(e.plane.normal @ offset) if e.plane else 0.0 for e in (one, other))
    return float(np.exp(-0.5 * (distance / coplanar_std) ** 2))


def _neighbour_log_odds(hit_spans, i, adjacent, p, static_coupling, dynamic_coupling):
    """Log odds contributed by the neighbours of a surfel."""
    static = dynamic = 0.0
    weight = 1.0
    first, last = hit_spans[i]
    for j, w_coplanar in adjacent:
        others_first, others_last = hit_spans[j]
        overlap = min(last, others_last) - max(first, others_first) + 1
        if overlap <= 0:
            continue
        union = max(last, others_last) - min(first, others_first) + 1
        w = w_coplanar * overlap / (union if p[j] > 0.5 else last - first + 1)
        weight += w
        if p[j] > 0.5:
            static += w * (2 * p[j] - 1)
        else:
            dynamic += w * (1 - 2 * p[j])
    return (static_coupling * static - dynamic_coupling * dynamic) / weight


def _probability(log_odds):
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))
