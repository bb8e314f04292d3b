"""Incremental scan matching in 2D: each scan is matched (9), then added to the local map (10)."""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.recording import Recording
from stillmap.slam import motion_model
from stillmap.slam.local_map import LocalMap
from stillmap.slam.motion_model import MotionPrior, VelocityNoise
from stillmap.slam.odometry_faults import SlipDetector, SlipHypothesis
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_matching import (
    FREE_SPACE_MARGIN,
    MAX_OCCLUDED,
    Scan,
    ScanMatch,
    accept_prior,
    is_inconsistent,
    match_scan,
    occluded_share,
    select_hits,
)
from stillmap.slam.types import Diagnostics, MStepResult, ScanProgress

Float = NDArray[np.float64]

_EXPLAINED_RATE = 0.1  # weight of one scan in the running average of the explained share
_KIDNAPPED_BELOW = 0.3  # of that average: the robot may have been carried elsewhere


def register_scans(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    progress: ScanProgress,
    max_travel: float = np.inf,
    free_space_margin: float = FREE_SPACE_MARGIN,
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
    """
    T = recording.n_scans
    grid = _core.OccupancyGrid2D(options.resolution, free_space_margin)
    odometry = _ScanOdometry(recording, e, options, max_travel, LocalMap(grid, recording, e))
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
        e: NDArray[np.float32],
        options: SlamOptions,
        max_travel: float,
        local_map: LocalMap,
    ) -> None:
        T, odometry = recording.n_scans, recording.T_odom_base
        self.recording, self.e, self.options = recording, e, options
        self.max_travel, self.local_map = max_travel, local_map
        self.poses = np.tile(np.eye(3), (T, 1, 1))
        self.covariance, self.explained = np.zeros((T, 3, 3)), np.ones(T)
        self.widened, self.odometry_faults = np.zeros((2, T), np.bool_)
        self.breaks, self.unconnected = list[int](), list[int]()
        self.steps = None if odometry is None else motion_model.compute_odometry_steps(odometry)
        self.slip = SlipDetector(None if self.steps is None else self.steps.increments)
        self.noise = VelocityNoise()
        self.seconds = 1e-9 * float(np.median(np.diff(recording.stamp_ns))) if T > 1 else 0.0
        self.travelled = 0.0
        # running average of the explained share, per sensor: each sees its own side
        self.usual = np.zeros(len(recording.T_base_sensor))
        self.usual[recording.sensor[0]] = 1.0
        self.local_map.add(0, self.poses[0], 0.0)

    def register(self, t: int) -> None:
        """Matches scan t and adds it to the local map."""
        last, guess = self.poses[t - 1], self._predict(t)
        prior, other = self._priors(t, guess, self.slip.is_slipping(t, last, guess))
        scan, s = select_hits(self.recording, self.e, t), self.recording.sensor[t]
        # without odometry, the first scan of a sensor with another view has nothing to match
        has_map = prior.is_odometry or self.local_map.has_sensor(s)
        if has_map:
            match = match_scan(self.local_map.grid, scan, prior, other, self.usual[s])
        else:
            match = accept_prior(prior)
        slip = self.slip.detect(t, last, guess, self.local_map.grid, scan, match)
        if slip is not None:
            match = self._accept_slip(t, slip)
            guess = self._predict(t)
        self._detect_break(t, scan, match, (prior, other or guess))
        rejected = None if prior.is_odometry else other
        is_fault = rejected is not None and is_inconsistent(rejected, match.T_map_base)
        self._record(t, match, is_fault=is_fault)
        if has_map:
            rate = _EXPLAINED_RATE if self.usual[s] > 0.0 else 1.0  # 0: the first scan of a map
            self.usual[s] += rate * (match.explained - self.usual[s])
            self.noise = self.noise.update(guess.residual(match.T_map_base), self.seconds)
        self.travelled += _length(self.poses[t - 1 : t + 1])
        self.local_map.add(t, match.T_map_base, self.travelled)
        self.local_map.remove_before(self.travelled - self.max_travel)

    def _predict(self, t: int) -> MotionPrior:
        """Constant velocity; no motion where it is unknown, after a break."""
        before = t - 1 if t < 2 or t - 1 in self.breaks[-1:] else t - 2
        return motion_model.constant_velocity_prior(
            self.poses[t - 1], self.poses[before], self.noise
        )

    def _priors(
        self, t: int, guess: MotionPrior, is_slipping: bool
    ) -> tuple[MotionPrior, MotionPrior | None]:
        """The prior of scan t and the alternative to it: odometry and prediction."""
        if self.steps is None:
            return guess, None
        increment = self.steps.increments[t - 1]
        measured = motion_model.odometry_prior(self.poses[t - 1], increment, self.options.odometry)
        is_valid = self.steps.plausible[t - 1] and not is_slipping
        return (measured, guess) if is_valid else (guess, measured)

    def _accept_slip(self, t: int, slip: SlipHypothesis) -> ScanMatch:
        """Replaces the poses since odometry stopped; returns the match of scan t."""
        # the scans are not added again: those to come show the same
        self.local_map.remove_since(slip.first)
        for k, match in enumerate(slip.matches, slip.first):
            self._record(k, match, is_fault=True)
        self.travelled += _length(self.poses[slip.first - 1 : t])
        return slip.matches[-1]

    def _detect_break(
        self, t: int, scan: Scan, match: ScanMatch, priors: tuple[MotionPrior, MotionPrior]
    ) -> None:
        """Starts a new local map if the robot was carried elsewhere before scan t."""
        fits_nowhere = self._is_unexplained(t, scan, match)
        if not fits_nowhere and not (self.steps is not None and self._is_leap(scan, match, priors)):
            return
        self.breaks.append(t)
        if fits_nowhere:
            self.unconnected.append(t)
        self.usual[:] = 0.0
        self.local_map.clear()
        self.slip.reset()

    def _is_unexplained(self, t: int, scan: Scan, match: ScanMatch) -> bool:
        """Whether a scan contradicts the map wherever the robot may have moved by itself.

        A scan of a new place is explained as little, but its beams do not pass through walls.
        """
        usual = self.usual[self.recording.sensor[t]]
        if match.explained >= _KIDNAPPED_BELOW * usual or len(scan.points) == 0:
            return False
        return occluded_share(self.local_map.grid, scan, match.T_map_base) > MAX_OCCLUDED

    def _is_leap(
        self, scan: Scan, match: ScanMatch, priors: tuple[MotionPrior, MotionPrior]
    ) -> bool:
        """Whether a scan fits only where neither odometry nor the prediction lead.

        It may look alike there. Unless the robot was carried, the scan at the pose of odometry
        does not pass through walls.
        """
        if match.all_headings or not match.widened:
            return match.all_headings
        if not all(is_inconsistent(prior, match.T_map_base) for prior in priors):
            return False
        return occluded_share(self.local_map.grid, scan, priors[0].T_map_base) > MAX_OCCLUDED

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
            self.unconnected,
        )
        grid = _core.OccupancyGrid2D(self.options.resolution)
        return MStepResult(self.poses, self.covariance, grid, self.explained, diagnostics)


def _length(poses: Float) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :2, 2], axis=0), axis=1).sum())
