"""Likelihood of what the surroundings of a surfel show while beams pass it.

Where something moved away, its whole place is empty. A hedge, the inside of a parked car behind its
windows, a post thinner than a voxel, or what pose errors shift by decimetres, is passed by some
beams while others end beside it, whenever one looks. See `docs/estimator.md`.
"""

import functools
import math

import numpy as np
from numpy.typing import NDArray

EDGE = 0.3  # m, of the cells that surroundings are made of: they reach 0.3 to 0.6 m
_LASTING = 9.0  # Beta(9, 1): share of the misses during which lasting surroundings are hit
_MAX_MISSES = 20  # that count; more of one surfel are not independent


def likelihood_of_misses(counts: NDArray[np.float32]) -> NDArray[np.float32]:
    """Likelihood (K, 2) of the misses of surfels if their surroundings last, and if they empty.

    Args:
        counts: (K, 2) misses, and those during which something was hit in the surroundings.

    Both are beta-binomial: the share of the latter is distributed as Beta(9, 1) and Beta(1, 9).
    They are relative to the larger one.
    """
    misses, surrounded = counts.astype(np.float64).T
    scale = np.minimum(1.0, _MAX_MISSES / np.maximum(misses, 1.0))
    n = np.rint(misses * scale).astype(np.intp)
    k = np.minimum(np.rint(surrounded * scale).astype(np.intp), n)
    return np.asarray(_table()[n, k])


@functools.cache
def _table() -> NDArray[np.float32]:
    """(N, N, 2) by the numbers of misses and of those with hits in the surroundings."""
    size = _MAX_MISSES + 1
    logs = np.zeros((size, size, 2))
    for n in range(size):
        for k in range(n + 1):
            logs[n, k] = _log_beta(k + _LASTING, n - k + 1.0), _log_beta(k + 1.0, n - k + _LASTING)
    table = np.asarray(np.exp(logs - logs.max(axis=2, keepdims=True)), np.float32)
    table.setflags(write=False)
    return table


def _log_beta(a: float, b: float) -> float:
    return math.lgamma(a) + math.lgamma(b) - math.lgamma(a + b)
