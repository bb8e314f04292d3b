"""The E-step over sessions: the cells of a place in which anything stood, and their states.

A cell is of one of three classes: static (occupied in every session), free (in none), or changing,
a two-state Markov chain over the sessions that switches at least once. Evidence of a session is the
log likelihood ratio of occupied to free; sessions that did not observe the cell say nothing.
Forward-backward and Viterbi as in Thrun, Burgard, Fox, Probabilistic Robotics, and Meyer-Delius et
al. 2012, with a session as the time step.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Bool, Float, Float32, Index, Int64
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import neighbor_pairs
from stillmap.places.evidence import BLOCK, Bytes, Evidence, crop_without_gaps, look_up, to_sums

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
    path: Bool
    observed: Bool


def weigh_evidence(hits: Float32, passes: Float32, stopped: Float32) -> Float32:
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


def estimate_states(evidence: Float, weights: Float, pairs: Index | None = None) -> CellStates:
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


def _pool(log: Float, path: Bool, observed: Bool, pairs: Index) -> Float:
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
    return np.asarray(total * (np.minimum(count, _INDEPENDENT_CELLS) / count)[:, None])


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
    return np.asarray(np.exp(np.ascontiguousarray(evidence.T)))


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


def _decode(evidence: Float) -> Bool:
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


_BLOCKS_PER_TILE = 8  # along each axis
# cells: within so many of each other two surfaces are the same; around a cell that must be passed
TOLERANCE, _FREE_RADIUS = 1, 1
_CANDIDATE_RADIUS = {2: 2, 3: 1}  # cells within which hits of one surface scatter
MIN_HITS = 0.75  # expected static hits of a session that make a cell a candidate
_MIN_PROMINENCE = 0.2  # share of the hits of the most-hit cell within that radius
_POOL_RADIUS = 3.0  # cells within which those of one history decide together
_MAX_FIT_ROWS = 50_000  # cells that the weights are fitted to


class Tile(NamedTuple):
    """A box of cells: its lowest cell (D,) and its shape."""

    low: Int64
    shape: tuple[int, ...]


@dataclass(frozen=True, eq=False)
class PlaceStates(ShortRepr):
    """Cells of a place in which something stood in some session.

    Attributes:
        cells: (K, D) int64, sorted by tile.
        evidence: (K, S) float32, nats, see `estimate_states`; sessions in the order of time.
        own: (K, S) float32, nats, the same without a tolerance: of each cell by itself.
        states: of each cell over the sessions.
        resolution: m, edge of a cell.
        weights: (3,) of static, free and changing cells.
    """

    cells: Int64
    evidence: Float32
    own: Float32
    states: CellStates
    resolution: float
    weights: Float

    def look_up(self, points: Float, values: Float) -> Float:
        """(n,) values (K,) of the cells that hold points (n, D); 0 where nothing ever stood."""
        return look_up(self.cells, values, np.floor(points / self.resolution).astype(np.int64), 0.0)

    def with_evidence(self, evidence: Float32, changed: Index) -> "PlaceStates":
        """The same with other evidence (K, S) of the cells `changed` (n,)."""
        states = estimate_states(evidence[changed].astype(np.float64), self.weights)
        columns = {name: np.array(getattr(self.states, name)) for name in vars(states)}
        for name, column in columns.items():
            column[changed] = getattr(states, name)
        return replace(self, evidence=evidence, states=CellStates(**columns))


def are_near(cells: Int64, others: Int64, distance: float) -> Bool:
    """(n,) True for cells (n, D) at most so many cells away from any of the others."""
    if not len(cells) or not len(others):
        return np.zeros(len(cells), np.bool_)
    from scipy.spatial import cKDTree  # slow to load

    nearest, _ = cKDTree(others).query(cells, distance_upper_bound=distance + 1.0)
    return np.asarray(nearest <= distance)


def measure_overlap(sessions: Sequence[Evidence], index: int) -> float:
    """Share of the hits of a session in cells that another one observed."""
    known = total = 0
    for tile in iter_tiles([sessions[index]]):
        hits, _ = sessions[index].crop(*tile)
        total += int(hits.sum())
        seen = np.zeros(tile.shape, np.bool_)
        for k, session in enumerate(sessions):
            if k != index:
                seen |= np.bitwise_or(*session.crop(*tile)) > 0
        known += int(hits[seen].sum())
    return known / max(total, 1)


def estimate_place(sessions: Sequence[Evidence]) -> PlaceStates:
    """The states of all cells over the sessions.

    Args:
        sessions: evidence of each in the frame of the place, in the order of time.
    """
    D = sessions[0].dimension
    cells, observed = [np.zeros((0, D), np.int64)], [np.zeros((2, 0, len(sessions)), np.float32)]
    for tile in iter_tiles(sessions):
        of_tile, nats = _observe_tile(sessions, tile)
        cells.append(of_tile)
        observed.append(nats)
    table, own = np.concatenate(observed, axis=1)
    step = max(-(-len(table) // _MAX_FIT_ROWS), 1)
    weights = fit_weights(table[::step].astype(np.float64))
    all_cells = np.concatenate(cells)
    pairs = neighbor_pairs(all_cells, _POOL_RADIUS)
    states = estimate_states(table.astype(np.float64), weights, pairs)
    return PlaceStates(all_cells, table, own, states, sessions[0].resolution, weights)


def iter_tiles(sessions: Sequence[Evidence]) -> Iterator[Tile]:
    """The tiles in which sessions observed anything, in order."""
    D = sessions[0].dimension
    size = BLOCK[D] * _BLOCKS_PER_TILE
    lows = np.concatenate([session.corner // size * size for session in sessions])
    for low in np.unique(lows, axis=0).astype(np.int64):
        yield Tile(low, (size,) * D)


def _observe_tile(sessions: Sequence[Evidence], tile: Tile) -> tuple[Int64, Float32]:
    """Candidate cells (k, D) of a tile, and the evidence (2, k, S) of every session: with the
    tolerance, and of each cell by itself."""
    D = len(tile.shape)
    halo = _CANDIDATE_RADIUS[D]
    low, shape = tile.low - halo, tuple(n + 2 * halo for n in tile.shape)
    inner = (slice(halo, -halo),) * D
    sums = [crop_without_gaps(session, low, shape) for session in sessions]
    at = np.nonzero(_find_candidates([hits for hits, _ in sums], halo)[inner])
    nats = np.empty((2, len(at[0]), len(sessions)), np.float32)
    for s, (hits, passes) in enumerate(sums):
        share = hits / np.maximum(passes + hits.astype(np.float32), np.float32(1.0))
        for out, tolerance, around in ((0, TOLERANCE, _FREE_RADIUS), (1, 0, 0)):
            most = _reduce_around(hits, tolerance, np.maximum)[inner][at]
            fewest = _reduce_around(passes, around, np.minimum)[inner][at]
            stopped = _reduce_around(share, tolerance, np.maximum)[inner][at]
            nats[out, :, s] = weigh_evidence(to_sums(most), to_sums(fewest), stopped)
    return np.stack(at, axis=1) + tile.low, nats


def _find_candidates(hits: Sequence[Bytes], radius: int) -> Bool:
    """The cells in which something stood in some session, and that are no noise of a wall."""
    out = np.zeros(hits[0].shape, np.bool_)
    for of in hits:
        at = np.nonzero(of)
        own, strongest = (to_sums(c[at]) for c in (of, _reduce_around(of, radius, np.maximum)))
        out[at] |= own >= np.maximum(MIN_HITS, _MIN_PROMINENCE * strongest)
    return out


def _reduce_around(cells: NDArray[Any], radius: int, reduce: "np.ufunc") -> NDArray[Any]:
    """The extreme of all cells within a radius along each axis; cells at the border stay.

    Shifted copies take a tenth of the time of a filter of SciPy.
    """
    for axis in range(cells.ndim if radius else 0):
        n, out = cells.shape[axis] - 2 * radius, cells.copy()
        inner = out[(slice(None),) * axis + (slice(radius, radius + n),)]
        for shift in range(2 * radius + 1):
            reduce(inner, cells[(slice(None),) * axis + (slice(shift, shift + n),)], out=inner)
        cells = out
    return cells
