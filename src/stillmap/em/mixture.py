"""Shares of the classes of a mixture, by expectation maximisation."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

LEARN_FROM = 100_000  # members that shares are learned from: more change no digit that matters
_PSEUDO = 1.0  # members that each class starts with, so that none is ever impossible
_MOST_STATIC = 0.998  # a recording cannot show that nothing ever moves


@dataclass(frozen=True, eq=False)
class MixtureWeights:
    """What a mixture is made of.

    Attributes:
        static: share of the static classes taken together.
        classes: (C,) shares of all classes, static ones first; they sum to one.
        log_likelihood: mean over the members, in nats.
    """

    static: float
    classes: Float
    log_likelihood: float


def fit_weights(
    likelihood: NDArray[np.float32],
    n_static: int,
    start: float,
    iterations: int = 100,
    tolerance: float = 1e-6,
) -> MixtureWeights:
    """Maximise sum_k ln sum_c share_c likelihood_kc over the shares.

    Args:
        likelihood: (K, C), each row relative to its best class.
        n_static: the first so many classes are static.
        start: share of the static classes to begin with.
        iterations: at most.
        tolerance: nats per member: stops when an iteration gains less.

    Sums are those of NumPy's own loops, not of a linear algebra library that would split them
    among threads: the result does not depend on the machine's number of processors.
    """
    K, C = likelihood.shape
    rows = likelihood[:: max(-(-K // LEARN_FROM), 1)].astype(np.float64)
    shares = np.empty(C)
    shares[:n_static] = start / n_static
    shares[n_static:] = (1.0 - start) / (C - n_static)
    last = -np.inf
    for _ in range(iterations):
        evidence = np.einsum("kc,c->k", rows, shares)
        now = float(np.sum(np.log(evidence))) / max(len(rows), 1)
        counts = shares * np.einsum("kc,k->c", rows, 1.0 / evidence)  # expected members per class
        shares = _normalised(counts, n_static, start)
        if now - last < tolerance:
            break
        last = now
    return MixtureWeights(float(shares[:n_static].sum()), shares, now)


def _normalised(counts: Float, n_static: int, start: float) -> Float:
    static, movers = counts[:n_static] + _PSEUDO, counts[n_static:] + _PSEUDO
    total = counts.sum()
    share = counts[:n_static].sum() / total if total > 0.0 else start
    share = float(np.clip(share, 1.0 - _MOST_STATIC, _MOST_STATIC))
    return np.concatenate([share * static / static.sum(), (1.0 - share) * movers / movers.sum()])


def posterior_static(
    likelihood: NDArray[np.float32], shares: Float, n_static: int
) -> NDArray[np.float32]:
    """(K,) probability that each member belongs to one of the static classes."""
    weights = shares.astype(np.float32)
    static = np.einsum("kc,c->k", likelihood[:, :n_static], weights[:n_static])
    movers = np.einsum("kc,c->k", likelihood[:, n_static:], weights[n_static:])
    return np.asarray(static / (static + movers), dtype=np.float32)
