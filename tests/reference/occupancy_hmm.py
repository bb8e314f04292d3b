"""Occupancy HMM: likelihood of the observations of each surfel under two-state Markov chains."""

# ruff: noqa: ARG002  (threads: as the kernels have it)

from dataclasses import replace
from math import exp, inf, log

import numpy as np
from numpy.typing import NDArray

from reference.beam_counting import Beam, usable_beams
from reference.change_hmm import ChangeModel, summarise_changes
from reference.no_return_beams import beams_in_runs
from reference.observation import (
    HIT,
    MeasurementModel,
    crossed_surfels,
    is_solid,
    observe,
    view_angle_between,
)
from reference.surroundings import count_misses, mark_misses

Float = NDArray[np.float64]

STEP = 0.5  # cells; a robot that moves less has not moved


def chain_log_likelihood(observations, rho, tau, p_detection, view_angle=inf):
    """ln P(all observations) by the forward algorithm over the states (empty, occupied).

    Args:
        observations: (time in seconds, HIT or reliability of the miss, change of the line of sight
            in radians since the one before), in the order of time.
        rho: stationary probability of being occupied.
        tau: seconds, correlation exp(-dt / tau - dv / view_angle).
        p_detection: probability that a reliable observation of an occupied cell is a hit.
        view_angle: radians.
    """
    state = np.array([1.0 - rho, rho])
    total, before = 0.0, None
    for time, reliability, dv in observations:
        if before is not None:
            kept = exp(-(time - before) / tau - dv / view_angle)
            transition = kept * np.eye(2) + (1.0 - kept) * np.array([[1.0 - rho, rho]] * 2)
            state = state @ transition
        if reliability == HIT:
            state = state * [0.0, p_detection]
        else:
            state = state * [1.0, 1.0 - p_detection * reliability]
        total += log(state.sum())
        state, before = state / state.sum(), time
    return total


class OccupancyHmm:
    """Observations of the surfels of a map, and their likelihood under classes of chains.

    Args:
        surfel_map: fitted.
        rho, tau, view_angle: (C,) of the classes; no view_angle: inf for all.
        p_detection: see `chain_log_likelihood`.
        bin_seconds: width of a time bin.
        lateral_std, margin, hit_radius, end_margin, use_normals: see MeasurementModel.
    """

    def __init__(
        self,
        surfel_map,
        *,
        rho,
        tau,
        view_angle=(),
        p_detection,
        bin_seconds,
        lateral_std,
        margin,
        hit_radius,
        end_margin,
        use_normals=True,
    ):
        if len(surfel_map.fitted) != surfel_map.size:
            raise ValueError("surfel_map: fit it first")
        self.surfel_map = surfel_map
        self.classes = list(zip(rho, tau, view_angle or [inf] * len(rho), strict=True))
        self.p_detection = p_detection
        self.bin_seconds = bin_seconds
        self.model = MeasurementModel(lateral_std, margin, hit_radius, end_margin, use_normals)
        self.position: Float | None = None  # of the robot, at the last observation
        # time, HIT or reliability, position
        self.observations: list[list[tuple[float, float, Float]]] = [[] for _ in surfel_map.fitted]
        self.change_model: ChangeModel | None = None
        self.edge = 0  # cells, of coarse cells; 0: surroundings are not tracked
        # by time bin, see `mark_misses`
        self.marked: list[dict[int, tuple[float, bool]]] = [{} for _ in surfel_map.fitted]

    def add(self, points, hit, offset, T_map_sensor, time_bin, threads=1, positions=None):
        """Add scans with their time bins (T,), which must not decrease.

        positions (T, D): of the robot, metres; None: of the sensors.
        """
        bins = np.asarray(time_bin, np.int64)
        if (np.diff(bins) < 0).any():
            raise ValueError("time_bin: must not fall")
        beams_of: dict[int, list[Beam]] = {int(n): [] for n in bins}
        for beam in usable_beams(self.surfel_map.dimension, points, hit, offset, T_map_sensor):
            beams_of[int(bins[beam.scan])].append(beam)
        sensors = np.asarray(T_map_sensor, float)[:, :-1, -1]
        where = sensors if positions is None else np.asarray(positions, float)
        for n, beams in beams_of.items():
            at = self._move_to(where[bins == n].mean(axis=0))
            seen = observe(self.surfel_map, beams, self.model)
            for k, reliability in seen.items():
                self.observations[k].append((n * self.bin_seconds, reliability, at))
            if self.edge:
                marked = mark_misses(seen, self.surfel_map.fitted, self.edge)
                for k, one in marked.items():
                    self.marked[k][n] = one

    def _move_to(self, position):
        if self.position is None or (
            np.linalg.norm(position - self.position) >= STEP * self.surfel_map.resolution
        ):
            self.position = position
        return self.position

    def count_no_return_beams(self, points, hit, offset, T_map_sensor):
        """Number of beams without a return in runs, and of those that cross a solid surfel."""
        index = self.surfel_map.index_of_cell()
        beams = list(usable_beams(self.surfel_map.dimension, points, hit, offset, T_map_sensor))
        trusted = beams_in_runs(beams)
        through = [
            any(
                is_solid(self.surfel_map.fitted[k], self.model)
                for k, _ in crossed_surfels(self.surfel_map, index, beam, self.model)
            )
            for beam in beams
            if beam.number in trusted
        ]
        return len(through), sum(through)

    def solid_cells(self):
        """(S, D) cells of planar surfels with many returns."""
        cells = [s.cell for s in self.surfel_map.fitted if is_solid(s, self.model)]
        return np.array(cells, np.int64).reshape(-1, self.surfel_map.dimension)

    def set_trust_beyond_solid(self, trust):
        """Set the trust in beams without a return beyond the first solid surfel."""
        self.model = replace(self.model, trust=trust)

    def track_changes(self, *, tau, passer_by_rho, passer_by_tau, p_detection):
        """Enable the change HMM; see ChangeModel."""
        if any(self.observations):
            raise ValueError("track_changes: expected before the first observation")
        self.change_model = ChangeModel(tau, passer_by_rho, passer_by_tau, p_detection)

    def track_surroundings(self, edge):
        """Enable `miss_counts`; edge: metres, of coarse cells."""
        if any(self.observations):
            raise ValueError("track_surroundings: expected before the first observation")
        self.edge = max(1, round(edge / self.surfel_map.resolution))

    def miss_counts(self):
        """(E, 2) misses, and those while something was hit in the surroundings."""
        if not self.edge:
            raise ValueError("miss_counts: expected track_surroundings before")
        return np.array([count_misses(one) for one in self.marked], np.float32).reshape(-1, 2)

    def changes(self):
        """(E,) log likelihood, (E,) occupied share, (E, 2), (E, 2), (E, 2, 2, 2).

        See ChangeSummary.
        """
        if self.change_model is None:
            raise ValueError("changes: expected track_changes before")
        summaries = [
            summarise_changes(
                [(round(t / self.bin_seconds), None if r == HIT else r) for t, r, _ in of_surfel],
                self.bin_seconds,
                self.change_model,
            )
            for of_surfel in self.observations
        ]
        return (
            np.array([one.log_likelihood for one in summaries]),
            np.array([one.occupied_share for one in summaries], np.float32),
            np.array([one.p_last for one in summaries], np.float32).reshape(-1, 2),
            np.array([one.count for one in summaries], np.int32).reshape(-1, 2),
            np.array([one.change_bins for one in summaries], np.int32).reshape(-1, 2, 2, 2),
        )

    def likelihood(self, classes=None):
        """(E, C) relative to the best class, (E,) logarithm of the best; of some classes (bool).

        Of the observations of each surfel given one return in its cell: divided by
        rho * p_detection, the probability of that return.
        """
        chosen = self.classes
        if classes is not None:
            chosen = [c for c, wanted in zip(chosen, np.asarray(classes), strict=True) if wanted]
        values = np.array(
            [
                [
                    chain_log_likelihood(observations, rho, tau, self.p_detection, view_angle)
                    - log(rho * self.p_detection)
                    for rho, tau, view_angle in chosen
                ]
                for observations in map(
                    self._with_view_angles, self.surfel_map.fitted, self.observations
                )
            ]
        ).reshape(len(self.observations), len(chosen))
        best = values.max(axis=1)
        return np.exp(values - best[:, None]).astype(np.float32), best

    def _with_view_angles(self, surfel, observations):
        """Observations of a surfel, each with the change of the line of sight since the last."""
        before = [position for _, _, position in observations[:1] + observations[:-1]]
        cell = self.surfel_map.resolution
        return [
            (time, reliability, view_angle_between(b, position, surfel.mean, cell))
            for b, (time, reliability, position) in zip(before, observations, strict=True)
        ]


OccupancyHmm2D = OccupancyHmm
OccupancyHmm3D = OccupancyHmm
