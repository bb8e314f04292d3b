"""The share of one of two classes, learned from all of their members by EM."""

import numpy as np
from numpy.typing import NDArray

Float = NDArray[np.float64]

_ROUNDS = 100  # of EM at most
_TOLERANCE = 1e-6  # of the share, at which EM ends
_MIN_SHARE = 1e-4  # of either class
_MAX_LOG_ODDS = 50.0


def fit_share(log_ratio: Float, weight: Float) -> Float:
    """(K,) probability of the first class, its share fitted by EM.

    Args:
        log_ratio: (K,) nats, log likelihood ratio of the first class to the second.
        weight: (K,) of each member in the share.
    """
    share, p = 0.5, np.full(len(log_ratio), 0.5)
    for _ in range(_ROUNDS):
        p = compute_probability(log_ratio + np.log(share / (1.0 - share)))
        last, share = share, float((np.sum(weight * p) + 1.0) / (np.sum(weight) + 2.0))
        share = min(max(share, _MIN_SHARE), 1.0 - _MIN_SHARE)
        if abs(share - last) < _TOLERANCE:
            break
    return p


def compute_probability(log_odds: Float) -> Float:
    """(K,) 1 / (1 + e^-x)."""
    return np.asarray(1.0 / (1.0 + np.exp(-np.clip(log_odds, -_MAX_LOG_ODDS, _MAX_LOG_ODDS))))
