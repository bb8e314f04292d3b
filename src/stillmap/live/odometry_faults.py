"""Faults of wheel odometry as scans arrive, and where odometry alone may have led the robot.

Odometry is valid or not: while it is not, scans are predicted at constant velocity. A fault that
no single scan shows, of wheels that spin or odometry that stands still, is shown by a rival
hypothesis about the motion, which has poses of its own.
"""

import dataclasses
import math
from dataclasses import dataclass

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.slam import motion_model
from stillmap.slam.front_end import Evidence, judge_scan
from stillmap.slam.motion_model import MotionPrior, gaussian_prior
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import (
    FAULT_COST,
    MIN_GAIN,
    ScanMatch,
    is_inconsistent,
    is_poor,
    occluded_share,
    refine_pose,
    registration_cost,
    search_within_prior,
)

_STANDING_STD = 0.005, 0.003  # m and rad by which a robot that stands may seem to move
_MAX_SPEED = 3.0  # m/s of robots: odometry that is faster has leaped

# m and rad, standard deviations beyond which the search next to odometry may miss the pose
_FAR = 0.05, 0.02
# standard deviation of what odometry adds in every step alike: m per m, rad per m, rad per rad
_BIAS = 0.03, 0.01, 0.02
_MAX_OCCLUDED = 0.4  # share of beams through walls at the pose by odometry: more contradict the map
_ALIKE = 0.3, 0.3  # m and rad within which two optima are one pose
# scans that see another part of the map, or are ambiguous, until odometry is believed
_MAX_UNKNOWN, _MAX_SCANS = 10, 100


@dataclass(frozen=True, eq=False)
class Fault:
    """Odometry was wrong for some scans.

    Attributes:
        first_ns: stamp of the first one.
        before: (3, 3) T_map_base of the scan before the last one.
        match: of the last one.
    """

    first_ns: int
    before: Float
    match: ScanMatch


class RivalMotion:
    """A hypothesis about the motion that odometry contradicts: its poses, and its evidence.

    Args:
        pose: (3, 3) T_map_base of the scan before the first one.
        step: (3, 3) to it; the identity: the robot stands, else it goes on at constant velocity.
        ns: stamp of the first scan.

    Attributes:
        gain: nats by which scans so far fit better than at the poses by odometry.
    """

    def __init__(self, pose: Float, step: Float, ns: int, *, stands: bool) -> None:
        self.stands, self.first_ns, self.gain = stands, ns, 0.0
        self.pose, self.step = pose, step

    def observe(
        self, grid: _core.OccupancyGrid2D, scan: Scan, T: Float, guess: MotionPrior
    ) -> Fault | None:
        """Compare the pose of the next scan with that by odometry.

        Args:
            grid: the local map.
            scan: its hits, at least one.
            T: (3, 3) of the scan, by odometry and the map.
            guess: prior of constant velocity, for its standard deviations.
        """
        std = _STANDING_STD if self.stands else (guess.translation_std, guess.rotation_std)
        prior = gaussian_prior(self.pose @ self.step, *std)
        # labels that follow from the pose by odometry would leave out what contradicts it
        every = dataclasses.replace(scan, weights=np.ones_like(scan.weights))
        match = refine_pose(grid, every, prior, prior.T_map_base)
        # by end points alone: the local map is smeared along a motion that was none, and beams of
        # a robot that stands seem to pass through it
        by_odometry, by_rival = (registration_cost(grid, every, at) for at in (T, match.T_map_base))
        self.gain += by_odometry - by_rival
        before, self.pose = self.pose, match.T_map_base
        if not self.stands:
            self.step = se2.inverse(before) @ self.pose
        return Fault(self.first_ns, before, match) if self.gain > FAULT_COST else None


class OdometryFaults:
    """Tests odometry scan by scan.

    Args:
        options: see OdometryOptions.

    Attributes:
        increment: (3, 3) of odometry to the scan that is being registered; None: there is none.
    """

    def __init__(self, options: OdometryOptions) -> None:
        self._options = options
        self.increment: Float | None = None
        self.reset()

    def reset(self) -> None:
        """Discard the past motion, after the robot was carried elsewhere."""
        self._is_valid = True
        self._rival: RivalMotion | None = None
        self._doubtful: tuple[Float, Float] | None = None

    def predict(
        self, pose: Float, guess: MotionPrior, increment: Float | None, ns: int, seconds: float
    ) -> MotionPrior:
        """The prior of the next scan: by odometry while it is valid, else at constant velocity.

        Args:
            pose: (3, 3) T_map_base of the last scan.
            guess: prior of constant velocity.
            increment: (3, 3) of odometry since; None: there is none.
            ns: stamp of the scan.
            seconds: since the last one.
        """
        self.increment, self._guess, self._ns = increment, guess, ns
        if increment is None:
            return guess
        if np.hypot(*increment[:2, 2]) > max(motion_model.MIN_LEAP, _MAX_SPEED * seconds):
            self._is_valid = False
        by_odometry = motion_model.odometry_prior(pose, increment, self._options)
        return by_odometry if self._is_valid else guess

    def detect(
        self,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        pose: Float,
        match: ScanMatch,
        *,
        has_map: bool,
        may_stand: bool,
    ) -> Fault | None:
        """The fault that the scan shows to which the motion was predicted.

        Args:
            grid: the local map.
            scan: its hits.
            pose: (3, 3) T_map_base of the scan before.
            match: by the prior.
            has_map: of the sensor, and scans agree with it; else they say nothing of the motion.
            may_stand: if it does, that is believed now: what keeps its place is not people.
        """
        increment = self.increment
        if increment is None or not len(scan.points):
            self.reset()
            return None
        if match.contradicts_odometry:
            self._is_valid = False
        elif not self._is_valid:
            self._is_valid = self._agrees(pose, increment, match.T_map_base)
        if not self._is_valid or not has_map:
            self._rival = None
            return None
        rival = self._rival = self._choose_rival(pose, increment)
        fault = rival.observe(grid, scan, match.T_map_base, self._guess)
        if rival.gain < 0.0:  # a fault that began later is likelier
            self._rival = None
        if fault is None or (rival.stands and not may_stand):
            return None
        self._rival, self._is_valid = None, False
        return fault

    def _agrees(self, pose: Float, increment: Float, T_map_base: Float) -> bool:
        """True if the robot moved on, and as odometry says that was at fault."""
        start, step = self._doubtful or (pose, np.eye(3))
        step = step @ increment
        by_odometry = motion_model.odometry_prior(start, step, self._options)
        standing = motion_model.odometry_prior(start, np.eye(3), self._options)
        is_off = is_inconsistent(by_odometry, T_map_base)
        self._doubtful = None if is_off else (start, step)
        # steps of a fast laser are too short to say so: they add up
        return not is_off and is_inconsistent(standing, T_map_base)

    def _choose_rival(self, pose: Float, increment: Float) -> RivalMotion:
        """The robot stands while odometry moves, and goes on while odometry rather stands still."""
        rival = self._rival
        onward = se2.inverse(pose) @ self._guess.T_map_base
        if rival is not None and not rival.stands:
            onward = rival.step
        stands = _size(increment) > 0.5 * _size(onward)
        if rival is not None and rival.stands == stands:
            return rival
        return RivalMotion(pose, np.eye(3) if stands else onward, self._ns, stands=stands)


def _size(step: Float) -> float:
    """m and rad of a step (3, 3) together."""
    x, y, theta = se2.parameters(step)
    return float(np.hypot(x, y) + abs(theta))


class DeadReckoning:
    """The uncertainty of the pose since the last scan that met anything."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """The pose is known."""
        self._noise = np.zeros((3, 3))
        self._metres, self._radians = 0.0, 0.0
        self._unknown, self._scans = 0, 0

    @property
    def covariance(self) -> Float:
        """(3, 3) of x, y (map axes) and heading: noise of the steps, and their bias."""
        metres = _BIAS[0] * self._metres
        radians = _BIAS[1] * self._metres + _BIAS[2] * self._radians
        return np.asarray(self._noise + np.diag(np.square([metres, metres, radians])))

    @property
    def is_far(self) -> bool:
        """True if the robot may be elsewhere than next to the pose by odometry."""
        metres, radians = _stds(self.covariance)
        return metres > _FAR[0] or radians > _FAR[1]

    def move(self, before: Float, after: Float, drift: Float) -> None:
        """Add a step.

        Args:
            before, after: (3, 3) T_map_base.
            drift: (3, 3) covariance of the step alone.
        """
        self._noise = _propagate(self._noise, before, after) + drift
        x, y, theta = se2.parameters(se2.inverse(before) @ after)
        self._metres += float(np.hypot(x, y))
        self._radians += abs(float(theta))

    def search(
        self,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        prior: MotionPrior,
        before: Float,
        usual: float,
    ) -> tuple[ScanMatch | None, Evidence]:
        """The pose of the first scans after the stretch, if one explains a scan and no other does;
        and what the scan says of the map.

        Args:
            grid: the map so far.
            scan: its hits.
            prior: by odometry from the last pose.
            before: (3, 3) the last pose.
            usual: recent average of the explained share.
        """
        self._scans += 1
        covariance = _propagate(self.covariance, before, prior.T_map_base)
        covariance = np.asarray(covariance + np.linalg.inv(prior.information), np.float64)
        metres, radians = _stds(covariance)
        information = np.asarray(np.linalg.inv(covariance), np.float64)
        wide = MotionPrior(prior.T_map_base, information, metres, radians)
        # labels at a pose that is wrong would take walls for people
        alike = dataclasses.replace(scan, weights=np.ones_like(scan.weights))
        match = search_within_prior(grid, alike, wide)
        evidence = judge_scan(grid, alike, match, usual)
        if evidence is Evidence.CONTRADICTS:
            occluded = occluded_share(grid, alike, prior.T_map_base)
            # odometry may have led the robot to where nothing is mapped
            evidence = Evidence.UNKNOWN if occluded <= _MAX_OCCLUDED else evidence
        if evidence is not Evidence.CONTRADICTS:
            if not is_poor(match, usual) and not _is_ambiguous(match):
                return match, Evidence.AGREES
            self._unknown += is_poor(match, usual)
        return None, evidence

    @property
    def is_over(self) -> bool:
        """True if odometry is believed, for the scans say nothing else."""
        return self._unknown >= _MAX_UNKNOWN or self._scans >= _MAX_SCANS


def _is_ambiguous(match: ScanMatch) -> bool:
    """True if another pose explains the scan about as well."""
    x, y, theta, cost = match.alternatives.T
    is_other = (np.hypot(x, y) > _ALIKE[0]) | (np.abs(theta) > _ALIKE[1])
    return bool((is_other & (cost < MIN_GAIN)).any())


def _propagate(covariance: Float, before: Float, after: Float) -> Float:
    """(3, 3) after a step: an error of the heading turns it."""
    x, y = (after - before)[:2, 2].tolist()
    F = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    return np.asarray(F @ covariance @ F.T)


def _stds(covariance: Float) -> tuple[float, float]:
    """m and rad, of the worst direction and of the heading."""
    worst = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return math.sqrt(max(worst, 0.0)), math.sqrt(max(float(covariance[2, 2]), 0.0))
