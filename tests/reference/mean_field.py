"""What the elements beside one say about it: mean field of a random field over elements."""

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.surfel_map import SurfelMap

Float = NDArray[np.float64]


def smooth_mean_field(
    surfel_map: SurfelMap,
    log_odds: ArrayLike,
    *,
    radius: float,
    coplanar_std: float,
    static_coupling: float,
    dynamic_coupling: float,
    min_log_odds: float,
    max_log_odds: float,
    tolerance: float,
    max_iterations: int,
    threads: int = 1,  # noqa: ARG001  the core's signature
) -> Float:
    """(E,) P(static), from log odds (E,) by the looks at each element and from those beside it.

    Lengths are in cells. In each round all elements beside whom somebody changed by more than
    `tolerance` in the round before (all of them, in the first) think again:

        log odds = clip(own, min_log_odds, max_log_odds)
            + (static_coupling S - dynamic_coupling M) / (1 + W)

    S and M are sums of w |2 p - 1| over the static and the moving ones beside it, W that of w.
    """
    own = np.asarray(log_odds, float)
    beside = [
        [(j, together(surfel_map, i, j, coplanar_std)) for j in near(surfel_map, i, radius)]
        for i in range(surfel_map.size)
    ]
    p, asked = _probability(own), set(range(surfel_map.size))
    for _ in range(max_iterations):
        before = p.copy()
        for i in asked:
            odds = np.clip(own[i], min_log_odds, max_log_odds)
            p[i] = _probability(
                odds + _pull(surfel_map, i, beside[i], before, static_coupling, dynamic_coupling)
            )
        told = np.flatnonzero(np.abs(p - before) > tolerance)
        asked = {j for i in told for j, _ in beside[i]}
    return p


def near(surfel_map: SurfelMap, i: int, radius: float) -> Iterator[int]:
    """The elements whose cells lie within a radius in cells of that of another."""
    number, reach = surfel_map.numbers(), int(radius)
    for off in product(range(-reach, reach + 1), repeat=surfel_map.dimension):
        cell = tuple(np.add(surfel_map.list[i].cell, off).tolist())
        if 0 < np.sum(np.square(off)) <= radius**2 and cell in number:
            yield number[cell]


def together(surfel_map: SurfelMap, i: int, j: int, coplanar_std: float) -> float:
    """How far two elements can be of one surfel_map."""
    one, other = surfel_map.list[i], surfel_map.list[j]
    apart = (other.mean - one.mean) / surfel_map.resolution
    off = max(abs(e.patch.normal @ apart) if e.patch else 0.0 for e in (one, other))
    return float(np.exp(-0.5 * (off / coplanar_std) ** 2))


def _pull(
    surfel_map: SurfelMap,
    i: int,
    beside: list[tuple[int, float]],
    p: Float,
    static_coupling: float,
    dynamic_coupling: float,
) -> float:
    """Log odds that those beside an element are worth to it."""
    static = moving = 0.0
    weight = 1.0
    first, last = surfel_map.hit_spans[i].tolist()
    for j, one_surface in beside:
        others_first, others_last = surfel_map.hit_spans[j].tolist()
        both = min(last, others_last) - max(first, others_first) + 1
        if both <= 0:
            continue
        either = max(last, others_last) - min(first, others_first) + 1
        w = one_surface * both / (either if p[j] > 0.5 else last - first + 1)
        weight += w
        if p[j] > 0.5:
            static += w * (2 * p[j] - 1)
        else:
            moving += w * (1 - 2 * p[j])
    return (static_coupling * static - dynamic_coupling * moving) / weight


def _probability(log_odds: Float) -> Float:
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))
