"""Mixture weights of the HMM classes, fitted by expectation maximisation."""

import math

import numpy as np

from stillmap.core.array_types import Bool, Float, Float32

MAX_FIT_ROWS = 100_000  # maximum number of rows used in the fit; more make no relevant difference
_PSEUDO_COUNT = 1.0  # per class, so that none becomes impossible
_MAX_STATIC_WEIGHT = 0.998  # upper bound: no recording proves that nothing moves


def fit_weights(
    likelihood: Float32,
    n_static: int,
    initial_static: float,
    max_iterations: int = 100,
    tolerance: float = 1e-6,
    rare: Bool | None = None,
) -> Float:
    """(C,) weights w, which sum to one: EM maximises sum_k ln sum_c w_c L_kc, up to a pseudo-count.

    Args:
        likelihood: (K, C) L, each row relative to its best class.
        n_static: number of static classes, which come first.
        initial_static: total weight of the static classes to start from.
        max_iterations: of EM.
        tolerance: nats per row; stops when an iteration gains less.
        rare: (C,) dynamic classes with a total weight of at most 1 - initial_static; None: none.

    Sums use NumPy's own loops, not a linear algebra library that would split them among threads:
    the result does not depend on the number of processors.
    """
    K, C = likelihood.shape
    rows = likelihood[:: max(-(-K // MAX_FIT_ROWS), 1)].astype(np.float64)
    weights = np.empty(C)
    weights[:n_static] = initial_static / n_static
    weights[n_static:] = (1.0 - initial_static) / (C - n_static)
    last = -np.inf
    for _ in range(max_iterations):
        evidence = np.einsum("kc,c->k", rows, weights)  # sum_c w_c L_kc
        log_likelihood = float(np.sum(np.log(evidence))) / max(len(rows), 1)
        counts = weights * np.einsum("kc,k->c", rows, 1.0 / evidence)  # expected rows per class
        weights = _normalize(counts, n_static, initial_static)
        if rare is not None:
            weights = _limit(weights, rare, 1.0 - initial_static)
        if log_likelihood - last < tolerance:
            break
        last = log_likelihood
    return weights


def _normalize(counts: Float, n_static: int, initial_static: float) -> Float:
    static, dynamic = counts[:n_static] + _PSEUDO_COUNT, counts[n_static:] + _PSEUDO_COUNT
    total = counts.sum()
    weight = counts[:n_static].sum() / total if total > 0.0 else initial_static
    weight = float(np.clip(weight, 1.0 - _MAX_STATIC_WEIGHT, _MAX_STATIC_WEIGHT))
    parts = [weight * static / static.sum(), (1.0 - weight) * dynamic / dynamic.sum()]
    return np.concatenate(parts)


def _limit(weights: Float, rare: Bool, max_weight: float) -> Float:
    """The weights nearest to the expected counts under an upper bound of some classes' total."""
    total = float(weights[rare].sum())
    if total <= max_weight:
        return weights
    return weights * np.where(rare, max_weight / total, (1.0 - max_weight) / (1.0 - total))


def posterior_static(likelihood: Float32, weights: Float, n_static: int) -> Float32:
    """(K,) responsibility of the static classes for each row (K, C)."""
    w = weights.astype(np.float32)
    static = np.einsum("kc,c->k", likelihood[:, :n_static], w[:n_static])
    dynamic = np.einsum("kc,c->k", likelihood[:, n_static:], w[n_static:])
    return np.asarray(static / (static + dynamic), dtype=np.float32)


def posterior(likelihood: Float32, weights: Float, among: Bool) -> Float32:
    """(K,) responsibility of some classes (C,) for each row (K, C)."""
    w = weights.astype(np.float32)
    inside, outside = (
        np.einsum("kc,c->k", likelihood, np.where(some, w, np.float32(0.0)))
        for some in (among, ~among)
    )
    return np.asarray(inside / (inside + outside), np.float32)


def log_beta(a: Float | float, b: Float | float) -> Float:
    """ln B(a, b) of the beta function, of positive numbers."""
    log_gamma = np.frompyfunc(math.lgamma, 1, 1)  # scipy.special takes 0.1 s and 13 MB to load
    return np.asarray(log_gamma(a) + log_gamma(b) - log_gamma(a + b), np.float64)
