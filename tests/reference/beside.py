"""What the elements beside one say about it: mean field of a random field over elements."""

from collections.abc import Iterator
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from reference.surface import Surface

Float = NDArray[np.float64]


def settled(
    surface: Surface,
    log_odds: ArrayLike,
    *,
    radius: float,
    coplanar: float,
    for_static: float,
    for_dynamic: float,
    least: float,
    most: float,
    moved: float,
    rounds: int,
    threads: int = 1,  # noqa: ARG001  the core's signature
) -> Float:
    """(E,) P(static), from log odds (E,) by the looks at each element and from those beside it.

    Lengths are in cells. In each round all elements beside whom somebody changed by more than
    `moved` in the round before (all of them, in the first) think again:

        log odds = clip(own, least, most) + (for_static S - for_dynamic M) / (1 + W)

    S and M are sums of w |2 p - 1| over the static and the moving ones beside it, W that of w.
    """
    own = np.asarray(log_odds, float)
    beside = [
        [(j, together(surface, i, j, coplanar)) for j in near(surface, i, radius)]
        for i in range(surface.size)
    ]
    p, asked = _probability(own), set(range(surface.size))
    for _ in range(rounds):
        before = p.copy()
        for i in asked:
            odds = np.clip(own[i], least, most)
            p[i] = _probability(
                odds + _pull(surface, i, beside[i], before, for_static, for_dynamic)
            )
        told = np.flatnonzero(np.abs(p - before) > moved)
        asked = {j for i in told for j, _ in beside[i]}
    return p


def near(surface: Surface, i: int, radius: float) -> Iterator[int]:
    """The elements whose cells lie within a radius in cells of that of another."""
    number, reach = surface.numbers(), int(radius)
    for off in product(range(-reach, reach + 1), repeat=surface.dimension):
        cell = tuple(np.add(surface.list[i].cell, off).tolist())
        if 0 < np.sum(np.square(off)) <= radius**2 and cell in number:
            yield number[cell]


def together(surface: Surface, i: int, j: int, coplanar: float) -> float:
    """How far two elements can be of one surface."""
    one, other = surface.list[i], surface.list[j]
    apart = (other.mean - one.mean) / surface.resolution
    off = max(abs(e.patch.normal @ apart) if e.patch else 0.0 for e in (one, other))
    return float(np.exp(-0.5 * (off / coplanar) ** 2))


def _pull(
    surface: Surface,
    i: int,
    beside: list[tuple[int, float]],
    p: Float,
    for_static: float,
    for_dynamic: float,
) -> float:
    """Log odds that those beside an element are worth to it."""
    static = moving = 0.0
    weight = 1.0
    first, last = surface.spans[i].tolist()
    for j, one_surface in beside:
        others_first, others_last = surface.spans[j].tolist()
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
    return (for_static * static - for_dynamic * moving) / weight


def _probability(log_odds: Float) -> Float:
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))
