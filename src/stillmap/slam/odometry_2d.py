"""Incremental scan matching in 2D: each scan is matched (9), then added to the local map (10)."""

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, relocalization
from stillmap.slam.local_map import LocalMap, travelled_distance
from stillmap.slam.motion_model import MotionPrior, VelocityNoise
from stillmap.slam.options import SlamOptions
from stillmap.slam.relocalization import Evidence
from stillmap.slam.scan_hits import FREE_SPACE_MARGIN, Scan, select_hits
from stillmap.slam.scan_matching import (
    ScanMatch,
    accept_prior,
    is_inconsistent,
    is_poor,
    match_scan,
    widen_match,
)
from stillmap.slam.types import BareStretch, Diagnostics, MStepResult, ScanProgress

_EXPLAINED_RATE = 0.1  # weight of one scan in the running average of the explained share
# featureless stretches: m, from which a step is hardly measured; scans that are measured within one
# of them; m, std of the length from which one is named
_MIN_STEP_STD, _MAX_GAP, _MIN_STD = 0.04, 10, 0.3


def register_scans(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    progress: ScanProgress,
    max_travel: float = np.inf,
    free_space_margin: float = FREE_SPACE_MARGIN,
    *,
    search_wider: bool = True,
    faults: Index | None = None,
) -> MStepResult:
    """Poses by incremental maximum likelihood.

    The grid of the result is empty: the local map lacks beams without a return and most scans.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        progress: called with the number of scans done and their total.
        max_travel: m of travel after which a scan leaves the local map.
        free_space_margin: m before its end in which a beam is not used as free space.
        search_wider: whether a scan that does not fit near its prior is searched for.
        faults: (n,) scans at which odometry fails.
    """
    T = recording.n_scans
    grid = _core.OccupancyGrid2D(options.resolution, free_space_margin)
    odometry = _ScanOdometry(
        recording, e, options, max_travel, LocalMap(grid, recording, e), search_wider
    )
    if odometry.steps is not None and faults is not None:
        odometry.steps.plausible[faults - 1] = False
    progress(1, T)
    for t in recording.iter_scans(range(1, T), e):
        odometry.register(t)
        progress(t + 1, T)
    return odometry.result()


class _ScanOdometry:
    """State of incremental scan matching; arguments as of `register_scans`, and an empty map."""

    def __init__(
        self,
        recording: Recording,
        e: Float32,
        options: SlamOptions,
        max_travel: float,
        local_map: LocalMap,
        search_wider: bool,
    ) -> None:
        T, odometry = recording.n_scans, recording.T_odom_base
        self.recording, self.e, self.options = recording, e, options
        self.max_travel, self.local_map = max_travel, local_map
        self.search_wider = search_wider
        self.poses = np.tile(np.eye(3), (T, 1, 1))
        self.covariance, self.explained = np.zeros((T, 3, 3)), np.ones(T)
        self.drift, self.unmeasured = np.zeros((T, 3, 3)), np.zeros(T)
        self.widened, self.odometry_faults = np.zeros((2, T), np.bool_)
        self.breaks = list[int]()
        self.steps = (
            None
            if odometry is None
            else motion_model.compute_odometry_steps(odometry, recording.stamp_ns)
        )
        self.noise = VelocityNoise()
        self.odometry_noise = motion_model.OdometryNoise()
        self.seconds_before = np.append(0.0, 1e-9 * np.diff(recording.stamp_ns))
        self.seconds = 1e-9 * float(np.median(np.diff(recording.stamp_ns))) if T > 1 else 0.0
        self.travelled = 0.0
        self.compared_until = 0
        # running average of the explained share, per sensor: each sees its own side
        self.usual = np.zeros(len(recording.T_base_sensor))
        self.usual[recording.sensor[0]] = 1.0
        self.local_map.add(0, self.poses[0], 0.0)

    def register(self, t: int) -> None:
        """Matches scan t and adds it to the local map."""
        guess = self._predict(t)
        prior, alternative = self._priors(t, guess)
        scan, s = select_hits(self.recording, self.e, t), self.recording.sensor[t]
        # without odometry, the first scan of a sensor with another view has nothing to match
        has_map = prior.is_odometry or self.local_map.has_sensor(s)
        learned = self._learned_prior(t, prior)
        if has_map:
            match = match_scan(self.local_map.grid, scan, prior, self.usual[s], learned)
        else:
            match = accept_prior(prior)
        match, contradicts = self._resolve_poor_match(t, scan, match, prior, alternative, learned)
        self._record(t, match, is_fault=self._rejects_odometry(t, prior, alternative, match))
        self.drift[t] = motion_model.blind_drift(learned or prior, match.covariance)
        self.unmeasured[t] = motion_model.unmeasured_variance(
            learned or prior, match.covariance, float(self.seconds_before[t])
        )
        if has_map:
            if learned is not None and not is_poor(match, self.usual[s]):
                self.odometry_noise = self.odometry_noise.update(
                    learned, match.T_map_base, match.covariance
                )
            rate = _EXPLAINED_RATE if self.usual[s] > 0.0 else 1.0  # 0: the first scan of a map
            self.usual[s] += rate * (match.explained - self.usual[s])
            self.noise = self.noise.update(guess.residual(match.T_map_base), self.seconds)
        self.travelled += _length(self.poses[t - 1 : t + 1])
        if not contradicts:
            self.local_map.add(t, match.T_map_base, self.travelled)
        self.local_map.remove_before(self.travelled - self.max_travel)

    def _learned_prior(self, t: int, prior: MotionPrior) -> MotionPrior | None:
        """The odometry prior of scan t with the noise learned so far; None: use `prior`."""
        if self.steps is None or not prior.is_odometry:
            return None
        increment = self.steps.increments[t - 1]
        return motion_model.odometry_prior(
            self.poses[t - 1], increment, self.options.odometry, self.odometry_noise
        )

    def _predict(self, t: int) -> MotionPrior:
        """Constant velocity; no motion where it is unknown, after a break."""
        before = t - 1 if t < 2 or t - 1 in self.breaks[-1:] else t - 2
        return motion_model.constant_velocity_prior(
            self.poses[t - 1], self.poses[before], self.noise
        )

    def _priors(self, t: int, guess: MotionPrior) -> tuple[MotionPrior, MotionPrior | None]:
        """The prior of scan t and the alternative to it: odometry and prediction."""
        if self.steps is None:
            return guess, None
        increment = self.steps.increments[t - 1]
        measured = motion_model.odometry_prior(self.poses[t - 1], increment, self.options.odometry)
        return (measured, guess) if self.steps.plausible[t - 1] else (guess, measured)

    def _rejects_odometry(
        self, t: int, prior: MotionPrior, alternative: MotionPrior | None, match: ScanMatch
    ) -> bool:
        """True if odometry was not the prior of scan t, and leaps or contradicts its match."""
        if self.steps is None or prior.is_odometry or alternative is None:
            return False
        return not self.steps.plausible[t - 1] or is_inconsistent(alternative, match.T_map_base)

    def _resolve_poor_match(
        self,
        t: int,
        scan: Scan,
        match: ScanMatch,
        prior: MotionPrior,
        alternative: MotionPrior | None,
        learned: MotionPrior | None,
    ) -> tuple[ScanMatch, bool]:
        """The match of scan t after a wider search, and whether it contradicts the local map.

        Starts a new segment if the robot may have been carried elsewhere before it.
        """
        grid, usual = self.local_map.grid, self.usual[self.recording.sensor[t]]
        step = prior if learned is None else learned
        if not self.search_wider or len(scan.points) == 0 or usual == 0.0:
            return match, False
        if is_poor(match, usual):
            # one scan that fits somewhere near does not say where the robot went, or was carried,
            # while nothing was recorded: all that follow decide
            seconds = float(self.seconds_before[t])
            if relocalization.is_gap(seconds, self.seconds, step.translation_std):
                return self._start_segment(t, step), False
            wider = widen_match(grid, scan, prior, alternative, match, usual)
            if wider.widened:
                return wider, False
        if not is_poor(match, usual):
            return match, False
        contradicts = relocalization.judge_scan(grid, scan, match, usual) is Evidence.CONTRADICTS
        if (
            not contradicts
            or t <= self.compared_until
            or self._is_consistent_ahead(t, match, usual)
        ):
            return match, contradicts
        return self._start_segment(t, step), False

    def _start_segment(self, t: int, prior: MotionPrior) -> ScanMatch:
        """Starts a new local map where the prior leads: loop closure decides where it belongs."""
        self.breaks.append(t)
        self.usual[:] = 0.0
        self.local_map.clear()
        return accept_prior(prior)

    def _is_consistent_ahead(self, t: int, match: ScanMatch, usual: float) -> bool:
        """True if the scans after t do not contradict the map if the robot goes on from a match."""
        contradicts, last = relocalization.look_ahead(
            self.recording,
            self.e,
            self.local_map.grid,
            self._increments(),
            t,
            match.T_map_base,
            usual,
        )
        if not contradicts:
            self.compared_until = last
        return not contradicts

    def _increments(self) -> Float:
        """(T - 1, 3, 3) increments of odometry; without it, the robot stands still."""
        if self.steps is not None:
            return self.steps.increments
        return np.broadcast_to(np.eye(3), (self.recording.n_scans - 1, 3, 3))

    def _record(self, t: int, match: ScanMatch, *, is_fault: bool) -> None:
        self.poses[t], self.covariance[t] = match.T_map_base, match.covariance
        self.explained[t], self.widened[t] = match.explained, match.widened
        self.odometry_faults[t] |= match.contradicts_odometry or is_fault

    def result(self) -> MStepResult:
        """Poses and diagnostics of all scans."""
        diagnostics = Diagnostics(
            np.flatnonzero(self.widened).tolist(),
            np.flatnonzero(self.odometry_faults).tolist(),
            self.breaks,
            bare_stretches=_find_bare_stretches(self.unmeasured, self.poses, self.breaks),
        )
        grid = _core.OccupancyGrid2D(self.options.resolution)
        return MStepResult(
            self.poses, self.covariance, grid, self.explained, self.drift, diagnostics
        )


def _length(poses: Float) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2, 2], axis=0), axis=1).sum())


def _find_bare_stretches(variance: Float, poses: Float, breaks: list[int]) -> list[BareStretch]:
    """Stretches whose length the scans do not show, as along the bare walls of a corridor.

    There a pose is where the motion model predicts it. Without odometry that is constant velocity,
    which inherits the error of every pose, so that the errors of the steps add up.

    Args:
        variance: (T,) m^2 of the step to each scan.
        poses: (T, 3, 3) T_map_base.
        breaks: scans at which a stretch ends.
    """
    steps = np.flatnonzero(variance > _MIN_STEP_STD**2)
    travelled = travelled_distance(poses)
    ends = np.flatnonzero(np.diff(steps) > _MAX_GAP) + 1
    stretches = []
    for part in np.split(steps, np.union1d(ends, np.searchsorted(steps, sorted(breaks)))):
        std = float(np.sqrt(variance[part].sum()))
        if std >= _MIN_STD:
            first, last = int(part[0]) - 1, int(part[-1])
            metres = float(travelled[last] - travelled[first])
            stretches.append(BareStretch(first, last, metres, std))
    return stretches
