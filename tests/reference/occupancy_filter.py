"""Causal E-step: forward filters of two-state chains in every cell, updated scan by scan."""

import math
from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from reference.beam_counting import usable_beams
from reference.ray_traversal import traverse

Float = NDArray[np.float64]

HALF_EXTENT = 0.5  # cells, of a surface of unknown direction
MIN_RELIABILITY, CLEARLY_PASSED, MAX_PASSES = 0.05, 0.5, 32
MIN_PROBABILITY = 1e-6


@dataclass
class Passed:
    """A cell in which no beam ended: time bins in which beams passed."""

    bins: int = 0
    last_bin: int = -1
    tag: int = -1


@dataclass
class Filter:
    """The filters of a cell, one per class.

    Attributes:
        p_occupied, log_likelihood: (C,) after the observations before the open bin.
        last_bin: of the last observation before; None: there was none.
        open_bin: being observed; None: none yet.
        hit, p_missed: whether a beam ended there in the open bin; P(all beams missed the surface).
        tag: of the scan that hit it last.
    """

    p_occupied: Float
    log_likelihood: Float
    last_bin: int | None
    tag: int
    open_bin: int | None = None
    hit: bool = False
    p_missed: float = 1.0


class OccupancyFilter:
    """See the kernel; cells are tuples."""

    def __init__(
        self,
        resolution,
        *,
        rho,
        tau,
        weights,
        n_static,
        p_detection,
        bin_seconds,
        lateral_std,
        hit_radius,
        max_log_ratio,
    ):
        self.resolution = resolution
        self.rho, self.tau, self.weights = np.array(rho), np.array(tau), np.array(weights)
        self.n_static, self.p_detection, self.bin_seconds = n_static, p_detection, bin_seconds
        self.lateral_std, self.hit_radius = lateral_std, hit_radius
        self.max_log_ratio = max_log_ratio
        self.passed: dict[tuple[int, ...], Passed] = {}
        self.filters: dict[tuple[int, ...], Filter] = {}

    @property
    def size(self):
        return len(self.filters)

    def add(self, points, hit, margin, offset, T_map_sensor, *, time_bin, tag):
        beams = [
            b for b in usable_beams(points.shape[1], points, hit, offset, T_map_sensor) if b.hit
        ]
        for beam in beams:
            self._pass(beam, float(margin[beam.number]), time_bin, tag)
        for beam in beams:
            self._add_filter(beam.end / self.resolution, tag)
        for beam in beams:
            self._hit(beam.end / self.resolution, time_bin, tag)

    def label(self, points, hit, offset, T_map_sensor, prior):
        out = np.full(len(points), np.nan, np.float32)
        for beam in usable_beams(points.shape[1], points, hit, offset, T_map_sensor):
            near = self._near(beam.end / self.resolution) if beam.hit else []
            out[beam.number] = max((self.posterior(k)[0] for k in near), default=prior)
        return out

    def p_standing(self):
        """P(static and occupied) of every known cell."""
        free = {cell: 0.0 for cell, at in self.passed.items() if at.bins}
        return free | {cell: self.posterior(cell)[1] for cell in self.filters}

    def posterior(self, cell):
        """P(static), P(static and occupied now)."""
        one = self.filters[cell]
        p, log_likelihood = one.p_occupied, one.log_likelihood
        if one.open_bin is not None:
            gap = 0 if one.last_bin is None else one.open_bin - one.last_bin
            p, log_likelihood = self._step(p, log_likelihood, gap, one.hit, 1.0 - one.p_missed)
        joint = self.weights * np.exp(log_likelihood - log_likelihood.max())
        joint /= joint.sum()
        n = self.n_static
        return float(joint[:n].sum()), float((joint * p)[:n].sum())

    def _step(self, p, log_likelihood, gap, is_hit, reliability):
        """One observation in every class: transition, then likelihood."""
        kept = np.exp(-gap * self.bin_seconds / self.tau)
        p = self.rho + kept * (p - self.rho)
        if is_hit:
            likelihood = np.maximum(p * self.p_detection, MIN_PROBABILITY)
            return np.ones_like(p), log_likelihood + np.log(likelihood)
        missed = p * (1.0 - self.p_detection * reliability)
        total = missed + 1.0 - p
        return np.maximum(missed / total, MIN_PROBABILITY), log_likelihood + np.log(total)

    def _normalize(self, log_likelihood):
        return np.maximum(log_likelihood - log_likelihood.max(), -self.max_log_ratio)

    def _open(self, one, time_bin):
        """False if the open bin is a later one."""
        if one.open_bin is not None and one.open_bin >= time_bin:
            return one.open_bin == time_bin
        if one.open_bin is not None:
            gap = 0 if one.last_bin is None else one.open_bin - one.last_bin
            one.p_occupied, log_likelihood = self._step(
                one.p_occupied, one.log_likelihood, gap, one.hit, 1.0 - one.p_missed
            )
            one.log_likelihood = self._normalize(log_likelihood)
            one.last_bin = one.open_bin
        one.open_bin = time_bin if one.last_bin is None else max(time_bin, one.last_bin)
        one.hit, one.p_missed = False, 1.0
        return True

    def _pass(self, beam, margin, time_bin, tag):
        start, end = beam.start / self.resolution, beam.end / self.resolution
        length = float(np.linalg.norm(end - start))
        if length - margin <= 0.0:
            return
        direction = (end - start) / length
        cells, _ = traverse(start, start + (length - margin) * direction, 1.0)
        for key in map(tuple, cells.tolist()):
            off = np.array(key) + 0.5 - start
            distance = math.sqrt(max(float(off @ off - (off @ direction) ** 2), 0.0))
            edges = (np.array([-HALF_EXTENT, HALF_EXTENT]) - distance) / self.lateral_std
            reliability = float(np.diff(ndtr(edges))[0])
            if reliability < MIN_RELIABILITY:
                continue
            at = self.passed.setdefault(key, Passed())
            at.tag = tag
            if key in self.filters:
                one = self.filters[key]
                if self._open(one, time_bin) and not one.hit:
                    one.p_missed *= 1.0 - reliability
            elif reliability >= CLEARLY_PASSED and at.last_bin < time_bin:
                at.bins += 1
                at.last_bin = time_bin

    def _add_filter(self, end, tag):
        key = tuple(np.floor(end).astype(int).tolist())
        at = self.passed.setdefault(key, Passed())
        at.tag = tag
        if key not in self.filters:
            passes = [CLEARLY_PASSED] * min(at.bins, MAX_PASSES)
            self.filters[key] = self._new_filter(passes, at.last_bin, tag)

    def _hit(self, end, time_bin, tag):
        for near in self._near(end):
            one = self.filters[near]
            if self._open(one, time_bin):
                one.hit, one.tag = True, tag

    def _new_filter(self, passes, last_bin, tag):
        """After passes with these reliabilities, one for each bin; last_bin: -1: none."""
        p, log_likelihood = self.rho.copy(), -np.log(self.rho * self.p_detection)
        for n, reliability in enumerate(passes):
            p, log_likelihood = self._step(p, log_likelihood, min(n, 1), False, reliability)
        last = None if last_bin < 0 else last_bin
        return Filter(p, self._normalize(log_likelihood), last, tag)

    def _near(self, end):
        """The filters of the end cell, and of neighbours with centres within the hit radius."""
        own = np.floor(end).astype(int)
        found = []
        for shift in product((-1, 0, 1), repeat=len(end)):
            key = tuple((own + shift).tolist())
            within = np.linalg.norm(np.array(key) + 0.5 - end) <= self.hit_radius
            if key in self.filters and (within or not any(shift)):
                found.append(key)
        return found


OccupancyFilter2D = OccupancyFilter
