"""The chain over sessions: whether something static stands in a cell, session by session.

A cell is of one of three classes: static (occupied in every session), free (in none), or changing,
a two-state Markov chain over the sessions
that switches at least once. Evidence of a session is the log likelihood ratio of
occupied to free; sessions that did not observe the cell say nothing. Forward-backward and Viterbi
as in Thrun, Burgard, Fox, Probabilistic Robotics, and Meyer-Delius et al. 2012, with a session as
the time step.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core.short_repr import ShortRepr

Float = NDArray[np.float64]

# nats: of a static hit within the tolerance, of a pass through all cells around; of one session at
# most, since its beams share the session's errors
_NATS_PER_HIT, _NATS_PER_PASS = 1.5, 1.5
_MAX_OCCUPIED, _MAX_FREE = 7.0, 9.0
_MIN_STOPPED = 0.5  # share of the beams through a cell that a surface in it stops at least
_SWITCH = 0.25  # probability that a changing cell is otherwise in the next session
_WEIGHTS = (0.8, 0.1, 0.1)  # prior of static, free, changing
# independent observations that neighbouring cells of one history amount to; nats of a cell at most
_INDEPENDENT_CELLS, _MAX_POOLED = 4.0, 20.0
_MIN_SHARE = 1e-12  # of a probability that is divided by
# free cells at least, for each changing one: those in which movers that paused left a few hits
_RESIDUE_SHARE = 1.5
_MIN_WEIGHT, _ROUNDS = 0.01, 20  # of a class while the weights are fitted; rounds of EM


@dataclass(frozen=True, eq=False)
class CellStates(ShortRepr):
    """States of K cells over S sessions.

    Attributes:
        p_static: (K,) P(occupied in every session).
        p_changing: (K,) P(otherwise in some session).
        p_occupied: (K, S) P(occupied in a session), of all classes together.
        path: (K, S) bool, occupied by the most probable path of a changing cell.
        observed: (K, S) bool, sessions that observed the cell.
    """

    p_static: Float
    p_changing: Float
    p_occupied: Float
    path: NDArray[np.bool_]
    observed: NDArray[np.bool_]


def weigh_evidence(
    hits: NDArray[np.float32], passes: NDArray[np.float32], stopped: NDArray[np.float32]
) -> NDArray[np.float32]:
    """Log likelihood ratio (nats) of occupied to free.

    Args:
        hits: of any shape, largest number of static hits within the tolerance.
        passes: of the same shape, smallest number of passes through the cells around.
        stopped: of the same shape, largest share of hits among hits and passes of a cell within the
            tolerance.
    """
    occupied = np.minimum(_NATS_PER_HIT * hits, _MAX_OCCUPIED)
    free = np.minimum(_NATS_PER_PASS * passes, _MAX_FREE)
    # a surface stops beams, though some still graze the cells beside it; who paused does not
    solid = np.minimum(np.minimum(hits, stopped / _MIN_STOPPED), 1.0)
    return np.asarray(solid * occupied - (1.0 - solid) * free)


def fit_weights(evidence: Float, rare: tuple[float, float, float] = _WEIGHTS) -> Float:
    """(3,) weights of static, free and changing cells, by EM over cells (K, S)."""
    weights = np.array(rare)
    if not len(evidence):
        return weights
    log = _log_likelihoods(evidence, _chain_likelihood(evidence, _forward(evidence)[1]))
    likelihood = np.exp(log - log.max(axis=1, keepdims=True))
    for _ in range(_ROUNDS):
        joint = likelihood * weights
        weights = (joint / joint.sum(axis=1, keepdims=True)).mean(axis=0)
        weights = np.maximum(weights, _MIN_WEIGHT)
        weights[1] = max(weights[1], _RESIDUE_SHARE * weights[2])
        weights /= weights.sum()
    return weights


def estimate_states(
    evidence: Float, weights: Float, pairs: NDArray[np.intp] | None = None
) -> CellStates:
    """States of cells over sessions.

    Args:
        evidence: (K, S) nats, sessions in the order of time; 0: not observed.
        weights: (3,) of static, free and changing.
        pairs: (P, 2) cells beside each other: those with one history decide together on their
            class; None: each cell for itself.
    """
    log_chain, p_occupied = _chain(evidence)
    log, path, observed = _log_likelihoods(evidence, log_chain), _decode(evidence), evidence != 0.0
    if pairs is not None and len(pairs):
        log = _pool(log, path, observed, pairs)
    joint = np.exp(log - log.max(axis=1, keepdims=True)) * weights
    posterior = joint / joint.sum(axis=1, keepdims=True)
    p_occupied = posterior[:, :1] + posterior[:, 2:] * p_occupied
    return CellStates(posterior[:, 0], posterior[:, 2], p_occupied, path, observed)


def _pool(
    log: Float, path: NDArray[np.bool_], observed: NDArray[np.bool_], pairs: NDArray[np.intp]
) -> Float:
    """(K, 3) log likelihoods of cells together with their neighbours of the same history.

    The mean over the neighbours, times their number up to a limit: they share their errors.
    """
    i, j = pairs.T
    same = ((path[i] == path[j]) | ~(observed[i] & observed[j])).all(axis=1)
    i, j = np.concatenate([i[same], j[same]]), np.concatenate([j[same], i[same]])
    count = 1.0 + np.bincount(i, minlength=len(log))
    total = np.stack(
        [of + np.bincount(i, of[j], minlength=len(log)) for of in np.maximum(log, -_MAX_POOLED).T],
        axis=1,
    )
    out: Float = total * (np.minimum(count, _INDEPENDENT_CELLS) / count)[:, None]
    return out


def _log_likelihoods(evidence: Float, log_chain: Float) -> Float:
    """(K, 3) log likelihood of each class, relative to that of a free cell."""
    log_static = evidence.sum(axis=1)
    return np.stack([log_static, np.zeros(len(evidence)), log_chain], axis=1)


def _chain(evidence: Float) -> tuple[Float, Float]:
    """Log likelihood (K,) of the changing class, and P(occupied) (K, S) under it.

    The histories of the chain without a switch belong to the other two classes.
    """
    p, log_all = _forward(evidence)
    occupied, _, rest = _split_histories(evidence, log_all)
    p_occupied = (_smooth(evidence, p).T - occupied[:, None]) / rest[:, None]
    return _chain_likelihood(evidence, log_all), np.clip(p_occupied, 0.0, 1.0)


def _chain_likelihood(evidence: Float, log_all: Float) -> Float:
    """(K,) log likelihood of the changing class, from that of the chain with all histories."""
    stay = (1.0 - _SWITCH) ** (evidence.shape[1] - 1)
    if stay == 1.0:
        return np.full(len(log_all), -np.inf)
    rest = _split_histories(evidence, log_all)[2]
    return np.asarray(log_all + np.log(rest / max(1.0 - stay, _MIN_SHARE)))


def _split_histories(evidence: Float, log_all: Float) -> tuple[Float, Float, Float]:
    """(K,) shares in the likelihood of the chain of the histories that are occupied throughout,
    free throughout, and of all others."""
    log_static, stay = evidence.sum(axis=1), (1.0 - _SWITCH) ** (evidence.shape[1] - 1)
    occupied, free = 0.5 * stay * np.exp(log_static - log_all), 0.5 * stay * np.exp(-log_all)
    return occupied, free, np.maximum(1.0 - occupied - free, _MIN_SHARE)


def _forward(evidence: Float) -> tuple[Float, Float]:
    """(S, K) filtered P(occupied) of the chain, and its log likelihood (K,)."""
    K, S = evidence.shape
    p, log = np.empty((S, K)), np.zeros(K)
    prior = np.full(K, 0.5)
    for s, ratio in enumerate(_ratios(evidence)):
        total = prior * ratio + 1.0 - prior
        p[s] = prior * ratio / total
        log += np.log(total)
        prior = p[s] * (1.0 - _SWITCH) + (1.0 - p[s]) * _SWITCH
    return p, log


def _ratios(evidence: Float) -> Float:
    """(S, K) likelihood ratios; session by session, as the chain goes through them."""
    out: Float = np.exp(np.ascontiguousarray(evidence.T))
    return out


def _smooth(evidence: Float, p: Float) -> Float:
    """(S, K) P(occupied) of the chain given all sessions (forward-backward).

    Args:
        evidence: (K, S) nats.
        p: (S, K) as of `_forward`.
    """
    out, ratio = p.copy(), _ratios(evidence)
    occupied, free = np.ones(len(evidence)), np.ones(len(evidence))  # backward messages
    for s in range(len(p) - 1, 0, -1):
        by_occupied, by_free = occupied * ratio[s], free
        occupied = (1.0 - _SWITCH) * by_occupied + _SWITCH * by_free
        free = _SWITCH * by_occupied + (1.0 - _SWITCH) * by_free
        scale = occupied + free
        occupied, free = occupied / scale, free / scale
        joint = p[s - 1] * occupied
        out[s - 1] = joint / (joint + (1.0 - p[s - 1]) * free)
    return out


def _decode(evidence: Float) -> NDArray[np.bool_]:
    """(K, S) most probable path of the chain (Viterbi); True: occupied."""
    K, S = evidence.shape
    nats = np.ascontiguousarray(evidence.T)
    stay, switch = np.log(1.0 - _SWITCH), np.log(_SWITCH)
    occupied, free = nats[0].copy(), np.zeros(K)
    from_occupied, from_free = np.zeros((2, S, K), np.bool_)
    for s in range(1, S):
        keeps, leaves = occupied + stay, occupied + switch
        comes, stays_free = free + switch, free + stay
        from_occupied[s] = keeps >= comes  # to occupied
        from_free[s] = leaves > stays_free  # to free, coming from occupied
        occupied = np.maximum(keeps, comes) + nats[s]
        free = np.maximum(leaves, stays_free)
    path = np.zeros((S, K), np.bool_)
    path[-1] = occupied > free
    for s in range(S - 1, 0, -1):
        path[s - 1] = np.where(path[s], from_occupied[s], from_free[s])
    return np.ascontiguousarray(path.T)
