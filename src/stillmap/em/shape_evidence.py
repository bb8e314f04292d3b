"""Likelihood ratio of dynamic to static, from the shapes of what is hit, in 2D.

A place that was looked at once, or that stayed occupied until it was out of sight, has no history
that tells a wall from a person. Their shapes differ: how wide the segments of the scan are that
end there, what lies beside their ends, and whether static surface goes on along a line. How often
either has each shape is learned from the places of the same recording whose history does tell.
See `docs/estimator/shapes.md`.
"""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.em.mixture import MAX_FIT_ROWS, MAX_STATIC_WEIGHT
from stillmap.em.scan_segments import N_SEGMENT_TYPES, classify_segments
from stillmap.em.types import MIN_PROBABILITY, Float

# m: reach of a line beyond the thing itself; nearer surfels may be of the same person
_RADIUS, _GAP, _HALF_WIDTH = 1.0, 0.15, 0.06
_MAX_RADIUS = 24.0  # cells: bounds the work at fine resolutions
_SUPPORT = np.array([0.025, 0.1, 0.2, 0.35, 0.5, 0.7, 0.9])  # m of static surface on a line

# exponent of the likelihood ratio: neighbouring surfels see the same thing, and so do both features
_TEMPER = 0.5
_MAX_LOG_RATIO = float(np.log(30.0))  # shape alone decides nothing that the history denies
_PSEUDO_COUNT = 20.0  # surfels, distributed as all surfels are
_MAX_ITERATIONS, _TOLERANCE = 60, 1e-3  # of EM; nats, largest change of a log ratio


class ShapeEvidence:
    """Shapes of E surfels, and what they say, which `fit` learns.

    Args:
        surfel_map: E surfels.
        recording: 2D, deskewed.
        poses: (T, 3, 3) T_map_base.
        threads: does not change the result.

    Attributes:
        log_ratio: (E,) nats, ln P(shape | dynamic) / P(shape | static), tempered; 0 before `fit`.
    """

    def __init__(
        self,
        surfel_map: _core.SurfelMap2D,
        recording: Recording,
        poses: Float,
        threads: int = 1,
    ) -> None:
        self._surfel_map, self._threads = surfel_map, threads
        self._segments = count_segments(surfel_map, recording, poses, threads)
        self._support: NDArray[np.intp] | None = None
        self.log_ratio = np.zeros(surfel_map.size)

    def fit(self, p_static: NDArray[np.float32], prior: float) -> None:
        """Learns from P(static) (E,) by history and shape, of which `prior` is the prior.

        Lines of static surface count from the second time on: the first labels lack all shapes.
        """
        p = np.clip(p_static.astype(np.float64), MIN_PROBABILITY, 1.0 - MIN_PROBABILITY)
        history = _logit(p) - _logit(np.float64(prior)) + self.log_ratio
        if self._support is None:
            self._support = np.zeros(len(p), np.intp)
        else:
            self._support = _classify_support(self._surfel_map, p, self._threads)
        log_ratio = _fit_shapes(history, self._segments, self._support, prior)
        # leaves of doors have the shape of walls, so shape does not outweigh a history of misses
        fade = np.where(log_ratio < 0.0, np.exp(np.minimum(history, 0.0)), 1.0)
        self.log_ratio = fade * log_ratio


def count_segments(
    surfel_map: _core.SurfelMap2D, recording: Recording, poses: Float, threads: int = 1
) -> NDArray[np.float32]:
    """(E, N_SEGMENT_TYPES) share of each type of segment among the beams that end on a surfel."""
    counts = np.zeros((surfel_map.size, N_SEGMENT_TYPES), np.float32)
    for *_, data in iter_beams(recording, poses):
        types = classify_segments(data)
        surfel = surfel_map.associate_beams(*data, threads)
        ended = (surfel >= 0) & (types >= 0)
        np.add.at(counts, (surfel[ended], types[ended]), np.float32(1.0))
    counts /= np.maximum(counts.sum(axis=1, keepdims=True), np.float32(1.0))
    return counts


def _classify_support(
    surfel_map: _core.SurfelMap2D, p_static: Float, threads: int
) -> NDArray[np.intp]:
    """(E,) class of the length of static surface on the best line through each surfel."""
    cell = surfel_map.resolution
    radius = min(max(_RADIUS / cell, 1.0), _MAX_RADIUS)
    support = _core.line_support(
        surfel_map,
        p_static.astype(np.float32),
        radius=radius,
        gap=min(_GAP / cell, radius),
        half_width=min(max(_HALF_WIDTH / cell, 0.75), radius),
        threads=threads,
    )
    return np.searchsorted(_SUPPORT, cell * support.astype(np.float64), side="right")


def _fit_shapes(
    history: Float, segments: NDArray[np.float32], support: NDArray[np.intp], prior: float
) -> Float:
    """(E,) ln P(shape | dynamic) / P(shape | static).

    EM over the frequencies of shapes, pairs of a class of support and a type of segment, among
    static and among dynamic surfels. The types of one surfel count as one, by their shares.
    """
    step = max(-(-len(history) // MAX_FIT_ROWS), 1)
    sample = [
        (history[::step][support[::step] == b], segments[::step][support[::step] == b])
        for b in range(len(_SUPPORT) + 1)
    ]
    everything = np.array([shares.sum(axis=0, dtype=np.float64) for _, shares in sample])
    pseudo = _PSEUDO_COUNT * everything / max(everything.sum(), 1.0)
    log_frequency = np.zeros_like(everything)  # ratio of dynamic to static
    share = prior
    for _ in range(_MAX_ITERATIONS):
        static, total, n = np.zeros_like(everything), 0.0, 0
        for b, (ratio, shares) in enumerate(sample):
            p = _sigmoid(ratio + _logit(np.float64(share)) - _log_ratio(shares, log_frequency[b]))
            static[b] = np.einsum("e,ek->k", p, shares)
            total, n = total + float(p.sum()), n + len(p)
        share = float(np.clip(total / max(n, 1), 1.0 - MAX_STATIC_WEIGHT, MAX_STATIC_WEIGHT))
        last, log_frequency = log_frequency, _compare(everything - static, static, pseudo)
        if np.abs(log_frequency - last).max() < _TOLERANCE:
            break
    out = np.empty(len(history))
    for b in range(len(_SUPPORT) + 1):
        of = support == b
        out[of] = _log_ratio(segments[of], log_frequency[b])
    return out


def _compare(dynamic: Float, static: Float, pseudo: Float) -> Float:
    """Logarithm of the ratio of the frequencies of all shapes; 0 for those that never occur."""
    dynamic, static = np.maximum(dynamic, 0.0) + pseudo, static + pseudo
    ratio = np.divide(
        dynamic * static.sum(),
        static * max(dynamic.sum(), MIN_PROBABILITY),
        out=np.ones_like(static),
        where=pseudo > 0.0,
    )
    return np.asarray(np.log(ratio))


def _log_ratio(shares: NDArray[np.float32], log_frequency: Float) -> Float:
    """(K,) tempered, within bounds."""
    log_ratio = _TEMPER * np.einsum("ek,k->e", shares, log_frequency)
    return np.asarray(np.clip(log_ratio, -_MAX_LOG_RATIO, _MAX_LOG_RATIO))


def _logit(p: Float | np.float64) -> Float:
    return np.asarray(np.log(p / (1.0 - p)))


def _sigmoid(log_odds: Float) -> Float:
    return np.asarray(1.0 / (1.0 + np.exp(-log_odds)))
