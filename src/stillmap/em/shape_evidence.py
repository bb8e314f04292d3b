"""Likelihood ratio of dynamic to static, from the shapes of what is hit, in 2D.

A place that was looked at once, or that stayed occupied until it was out of sight, has no history
that tells a wall from a person. Their shapes differ: how wide the segments of the scan are that
end there, what lies beside their ends, and whether static surface goes on along a line. How often
either has each shape is learned from the places of the same recording whose history does tell.
See `docs/estimator.md`.
"""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32, Index
from stillmap.core.arrays import finite_rows
from stillmap.core.chunks import ScanBeams, iter_beams
from stillmap.core.recording import Recording
from stillmap.em.mixture import MAX_FIT_ROWS
from stillmap.em.types import MIN_PROBABILITY

_LINK, _LINK_PER_METRE = 0.35, 0.02  # m between neighbours of one segment; more per metre of range
_WIDTHS = np.array([0.15, 0.35, 0.6, 0.9, 1.5])  # m: a leg, two, a person, a desk, a car
_MIN_WITHOUT_RETURN = 3  # neighbouring beams; fewer may have been lost
# what lies beside the two ends of a segment
_BOTH_FARTHER, _ONE_FARTHER, _BOTH_NEARER, _UNKNOWN = range(4)
N_SEGMENT_TYPES = 4 * (len(_WIDTHS) + 1)


def find_lost_beams(hit: Bool, points: Float32, scan: Index) -> Bool:
    """(M,) beams without a return, fewer than three side by side: they may have been lost.

    Args:
        hit, points: M beams in the order of their bearings; NaN points are unusable.
        scan: (M,) of each.
    """
    without = ~hit & finite_rows(points)
    if not without.any():
        return without
    begins = np.flatnonzero(np.append(True, (np.diff(without) != 0) | (np.diff(scan) > 0)))
    length = np.diff(np.append(begins, len(hit)))
    return without & np.repeat(length < _MIN_WITHOUT_RETURN, length)


def classify_segments(data: ScanBeams) -> NDArray[np.int8]:
    """(M,) type of the segment that each beam belongs to; -1 without a return.

    A type is one of six widths and one of four depth orders: what is hit beside the two ends lies
    farther away than these, or three or more beams without a return pass; it does at one end only;
    something nearer hides both; or one end is that of the scan.

    Args:
        data: M beams of 2D scans, in the order of their bearings.
    """
    scan = np.repeat(np.arange(len(data.offset) - 1), np.diff(data.offset))
    lost = find_lost_beams(data.hit, data.points, scan)
    usable = np.flatnonzero(finite_rows(data.points) & ~lost)
    types = np.full(len(data.hit), -1, np.int8)
    if len(usable) == 0:
        return types
    scan = scan[usable]
    hit, xy = data.hit[usable], data.points[usable].astype(np.float64)
    distance = np.hypot(*xy.T)
    step = np.hypot(*np.diff(xy, axis=0).T)
    max_step = _LINK + _LINK_PER_METRE * np.minimum(distance[1:], distance[:-1])
    is_cut = (np.diff(scan) > 0) | ~hit[1:] | ~hit[:-1] | (step > max_step)
    segment = np.append(0, np.cumsum(is_cut))
    first = np.flatnonzero(np.append(True, is_cut))
    last = np.append(first[1:], len(usable)) - 1
    width = np.hypot(*(xy[last] - xy[first]).T)
    depth = np.where(hit, distance, np.inf)
    order = _depth_order(scan, depth, first, last)
    of_segment = 4 * np.searchsorted(_WIDTHS, width, side="right") + order
    types[usable] = np.where(hit, of_segment[segment], -1)
    return types


def _depth_order(scan: Index, depth: Float, first: Index, last: Index) -> Index:
    """(S,) what is beside the ends of S segments, from beam `first` to beam `last` of all."""
    farther, known = np.zeros((2, 2, len(first)), np.bool_)
    for side, (end, beside) in enumerate(((first, first - 1), (last, last + 1))):
        inside = np.clip(beside, 0, len(scan) - 1)
        known[side] = (inside == beside) & (scan[inside] == scan[end])
        farther[side] = depth[inside] > depth[end]
    order = _BOTH_NEARER - farther.sum(axis=0)
    return np.where(known.all(axis=0), order, _UNKNOWN)


# m: reach of a line beyond the thing itself; nearer surfels may be of the same person
_RADIUS, _GAP, _HALF_WIDTH = 1.0, 0.15, 0.06
_MAX_RADIUS = 24.0  # cells: bounds the work at fine resolutions
# m of static surface on a line: borders are no multiples of the default cell of 5 cm, so that
# surfels with P(static) = 1 up to rounding are on the same side
_SUPPORT = np.array([0.025, 0.095, 0.195, 0.345, 0.495, 0.695, 0.895])

# exponent of the likelihood ratio: neighbouring surfels see the same thing, and so do both features
_TEMPER = 0.5
_MAX_LOG_RATIO = float(np.log(30.0))  # of a shape alone
_PSEUDO_COUNT = 20.0  # surfels, distributed as all surfels are
_MAX_ITERATIONS, _TOLERANCE = 60, 1e-3  # of EM; nats, largest change of a log ratio


class ShapeEvidence:
    """Shapes of E surfels, and their frequencies, which `fit` learns.

    Args:
        surfel_map: E surfels.
        recording: 2D, deskewed.
        poses: (T, 3, 3) T_map_base.
        threads: does not change the result.

    Attributes:
        factors: (E, 2) P(shape | group) / P(shape | static), tempered, of the groups of
            view-dependent and of dynamic surfels; 1 before `fit`.
    """

    def __init__(
        self, surfel_map: _core.SurfelMap2D, recording: Recording, poses: Float, threads: int = 1
    ) -> None:
        self._surfel_map, self._threads = surfel_map, threads
        self._segments = count_segments(surfel_map, recording, poses, threads)
        self._support: Index | None = None
        self.factors = np.ones((surfel_map.size, 2), np.float32)

    def fit(self, p_static: Float32, p_view_dependent: Float32) -> None:
        """Learns from P(static) and P(view-dependent) (E,) by history and the factors before.

        Lines of static surface count from the second time on: the first labels lack all shapes.
        """
        p = np.stack([p_static - p_view_dependent, p_view_dependent, 1.0 - p_static], axis=1)
        history = np.maximum(p.astype(np.float64), MIN_PROBABILITY)
        history[:, 1:] /= self.factors
        if self._support is None:
            self._support = np.zeros(len(p), np.intp)
        else:
            self._support = _classify_support(self._surfel_map, p_static, self._threads)
        log_ratio = _fit_shapes(history, self._segments, self._support)
        self.factors = np.exp(log_ratio[:, 1:]).astype(np.float32)


def count_segments(
    surfel_map: _core.SurfelMap2D, recording: Recording, poses: Float, threads: int = 1
) -> Float32:
    """(E, N_SEGMENT_TYPES) share of each type of segment among the beams that end on a surfel."""
    counts = np.zeros((surfel_map.size, N_SEGMENT_TYPES), np.float32)
    for *_, data in iter_beams(recording, poses):
        types = classify_segments(data)
        surfel = surfel_map.associate_beams(*data, threads)
        ended = (surfel >= 0) & (types >= 0)
        np.add.at(counts, (surfel[ended], types[ended]), np.float32(1.0))
    counts /= np.maximum(counts.sum(axis=1, keepdims=True), np.float32(1.0))
    return counts


def _classify_support(surfel_map: _core.SurfelMap2D, p_static: Float32, threads: int) -> Index:
    """(E,) class of the length of static surface on the best line through each surfel."""
    cell = surfel_map.resolution
    radius = min(max(_RADIUS / cell, 1.0), _MAX_RADIUS)
    support = _core.line_support(
        surfel_map,
        np.clip(p_static, np.float32(0.0), np.float32(1.0)),
        radius=radius,
        gap=min(_GAP / cell, radius),
        half_width=min(max(_HALF_WIDTH / cell, 0.75), radius),
        threads=threads,
    )
    return np.searchsorted(_SUPPORT, cell * support.astype(np.float64), side="right")


def _fit_shapes(history: Float, segments: Float32, support: Index) -> Float:
    """(E, G) tempered ln P(shape | group) / P(shape | first group) of G groups of surfels.

    EM over the frequencies of shapes, pairs of a class of support and a type of segment, in each
    group. The types of one surfel count as one, by their shares.

    Args:
        history: (E, G) weight times likelihood of each group, up to a factor of the surfel.
        segments: (E, N_SEGMENT_TYPES) shares.
        support: (E,) class of support.
    """
    step = max(-(-len(history) // MAX_FIT_ROWS), 1)
    sample = [
        (history[::step][support[::step] == b], segments[::step][support[::step] == b])
        for b in range(len(_SUPPORT) + 1)
    ]
    everything = np.array([shares.sum(axis=0, dtype=np.float64) for _, shares in sample])
    pseudo = _PSEUDO_COUNT * everything / max(everything.sum(), 1.0)
    G = history.shape[1]
    log_ratio = np.zeros((G, *everything.shape))  # of frequencies to those in the first group
    for _ in range(_MAX_ITERATIONS):
        counts = np.empty_like(log_ratio)
        for b, (weights, shares) in enumerate(sample):
            joint = weights * np.exp(_temper(shares, log_ratio[:, b]))
            counts[:, b] = np.einsum("eg,ek->gk", joint / joint.sum(axis=1, keepdims=True), shares)
        last, log_ratio = log_ratio, _compare(counts, pseudo)
        if np.abs(log_ratio - last).max() < _TOLERANCE:
            break
    out = np.empty_like(history)
    for b in range(len(_SUPPORT) + 1):
        out[support == b] = _temper(segments[support == b], log_ratio[:, b])
    return out


def _compare(counts: Float, pseudo: Float) -> Float:
    """Logarithm of the frequencies (G, ...) relative to the first; 0 of shapes that never occur."""
    frequency = counts + pseudo
    frequency /= np.maximum(frequency.sum(axis=(1, 2), keepdims=True), MIN_PROBABILITY)
    ratio = np.ones_like(frequency)
    np.divide(frequency, frequency[:1], out=ratio, where=pseudo > 0.0)
    return np.asarray(np.log(ratio))


def _temper(shares: Float32, log_ratio: Float) -> Float:
    """(K, G) mean log ratio by the shares (K, N), tempered, within bounds."""
    out = _TEMPER * np.einsum("ek,gk->eg", shares, log_ratio)
    return np.asarray(np.clip(out, -_MAX_LOG_RATIO, _MAX_LOG_RATIO))
