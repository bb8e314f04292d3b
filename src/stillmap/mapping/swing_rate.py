"""How often the doors of a recording swing, and what that tells of those seen in one position.

All doors swing at one rate, which is learned from those that were seen to swing, and from those
that were in the same position whenever somebody looked.
"""

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from stillmap.mapping.door import Door

Float = NDArray[np.float64]

_RATES = np.geomspace(1e-5, 1.0, 61)  # per s, of swings, each as probable before any is seen
_WATCHED = 2.0  # s between two looks within which a swing would have been seen
_LEAST = 1e-3  # s that a swing takes


def compute_p_moved(
    doors: Sequence[Door], looks: Sequence[NDArray[np.int64]], stamp_ns: NDArray[np.int64]
) -> tuple[Float, Float]:
    """Probability that each of some doors was in the same position at all looks, (K,), and if it
    was, that it moved while nobody saw it, (K,).

    A door swings at a constant rate, the same for all of them. The two positions of a door that
    swung at the rate r differ after t with probability (1 - exp(-2 r t)) / 2.

    Args:
        doors: those that were seen to swing.
        looks: (L, 2) of each of the others, see `observe_looks`.
        stamp_ns: (T,) of the recording.
    """
    spans = [_split_looks(one) for one in looks]
    log_same = [
        np.log(0.5 * (1.0 + np.exp(-2.0 * np.outer(_RATES, gaps)))).sum(axis=1) - _RATES * watched
        for watched, gaps in spans
    ]
    swings = [_log_likelihood_of_swings(door) for door in doors]
    log_likelihood = np.sum([np.zeros(len(_RATES)), *swings, *log_same], axis=0)
    posterior = _normalize(log_likelihood)
    # by the rate that all others tell
    same = [float(_normalize(log_likelihood - one) @ np.exp(one)) for one in log_same]
    moved = []
    for stamps, (_, gaps) in zip(looks, spans, strict=True):
        ends = 1e-9 * float((stamps[0, 0] - stamp_ns[0]) + (stamp_ns[-1] - stamps[-1, 1]))
        # it was in one position at both ends of a gap: an even number of swings, none with 1 / cosh
        log_still = -_RATES * ends - np.logaddexp(
            np.outer(_RATES, gaps), -np.outer(_RATES, gaps)
        ).sum(axis=1)
        log_still += len(gaps) * math.log(2.0)
        moved.append(1.0 - float(posterior @ np.exp(log_still)))
    return np.array(same), np.array(moved)


def _normalize(log_likelihood: Float) -> Float:
    """(R,) probability of each rate."""
    weights = np.exp(log_likelihood - log_likelihood.max())
    return np.asarray(weights / weights.sum())


def _log_likelihood_of_swings(door: Door) -> Float:
    """(R,) of the states of a door, at each rate.

    Each state lasts from the first to the last time the leaf was seen so; it may have moved to and
    fro meanwhile.
    """
    since, until = 1e-9 * np.array([[one.since_ns, one.until_ns] for one in door.states], float).T
    between = np.maximum(since[1:] - until[:-1], _LEAST)
    differs = 0.5 * -np.expm1(-2.0 * np.outer(_RATES, between))
    same = 0.5 * (1.0 + np.exp(-2.0 * np.outer(_RATES, until - since)))
    return np.asarray(np.log(differs).sum(axis=1) + np.log(same).sum(axis=1))


def _split_looks(stamps: NDArray[np.int64]) -> tuple[float, Float]:
    """Seconds in which a leaf was watched, and the gaps between them."""
    pauses = 1e-9 * (stamps[1:, 0] - stamps[:-1, 1]).astype(np.float64)
    watched = 1e-9 * float((stamps[:, 1] - stamps[:, 0]).sum()) + float(
        pauses[pauses <= _WATCHED].sum()
    )
    return watched, pauses[pauses > _WATCHED]
