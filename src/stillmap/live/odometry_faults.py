"""Faults of wheel odometry as scans arrive: leaps, wheels that slip, wheels that spin; and where
odometry alone may have led the robot."""

import dataclasses
import math
from collections import deque
from dataclasses import dataclass

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.live.slip_detection import SlipDetector
from stillmap.slam import motion_model
from stillmap.slam.front_end import Evidence, judge_scan
from stillmap.slam.motion_model import MotionPrior, gaussian_prior
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import (
    MIN_GAIN,
    ScanMatch,
    is_inconsistent,
    is_poor,
    occluded_share,
    refine_pose,
    registration_cost,
    search_pose,
)

_SPACING_NS = 10**8  # between scans that are compared
_STD = 0.005, 0.003  # m and rad by which both hypotheses may differ from the poses they predict
_REJECTED, _CONFIRMED = -10.0, 30.0  # nats of gain: the robot moves; it stands
# scans compared and m of odometry, at least, before it stands; m after which the test begins anew
_MIN_SCANS, _MIN_METRES, _MAX_METRES = 4, 0.3, 5.0
_MIN_STEP = 0.02  # m or rad of odometry between compared scans: less, and it stands, too
_FREE_STD = 0.02, 0.01  # m and rad, at least, of the prior while the robot stands
_LEAP = 1.0  # m between two scans, and times the speed below, beyond which odometry has leaped
_DISTRUST_NS = 10**9  # after a leap, in which smaller ones are none of odometry either
_MAX_SPEED = 3.0  # m/s of robots
_MAX_STAMPS = 500  # of scans that a fault may change in hindsight

# m and rad, standard deviations beyond which the search next to odometry may miss the pose
_FAR = 0.05, 0.02
# standard deviation of what odometry adds in every step alike: m per m, rad per m, rad per rad
_BIAS = 0.03, 0.01, 0.02
_WINDOW_STDS = 3.0  # half width of the search
_MAX_ROTATION = math.pi / 2.0  # rad, half width
_EXPLAINED = 0.7  # of the usual share, for a pose to be the right one
_MAX_OCCLUDED = 0.4  # share of beams through walls at the pose by odometry: more contradict the map
_ALIKE = 0.3, 0.3  # m and rad within which two optima are one pose
# scans that see another part of the map, or are ambiguous, until odometry is believed
_MAX_UNKNOWN, _MAX_SCANS = 10, 100


class StandingTest:
    """The hypothesis that the robot stands.

    Attributes:
        first_ns: stamp of the first scan of the hypothesis.
    """

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Begin anew with the next scan."""
        self._pose: Float | None = None
        self.first_ns, self._last_ns = 0, 0
        self._gain, self._scans, self._metres = 0.0, 0, 0.0
        self._step = np.eye(3)

    def observe(
        self, grid: _core.OccupancyGrid2D, scan: Scan, last: Float, T: Float, step: Float, ns: int
    ) -> ScanMatch | None:
        """Compare a scan at the pose by odometry with the standing pose.

        Args:
            grid: the local map.
            scan: its hits, at least one.
            last: (3, 3) T_map_base of the scan before.
            T: (3, 3) of the scan, by odometry and the map.
            step: (3, 3) of odometry.
            ns: its stamp.

        Returns:
            The match of the standing pose, if the scans so far confirm it.
        """
        if self._pose is None:
            self._pose, self.first_ns = last, ns
        self._metres, self._step = self._metres + float(np.hypot(*step[:2, 2])), self._step @ step
        if ns - self._last_ns < _SPACING_NS:
            return None
        x, y, theta = se2.parameters(self._step)
        self._last_ns, self._step = ns, np.eye(3)
        if max(np.hypot(x, y), abs(theta)) < _MIN_STEP or self._metres > _MAX_METRES:
            self.reset()
            return None
        # labels that follow from the pose by odometry would leave out what contradicts it
        every = dataclasses.replace(scan, weights=np.ones_like(scan.weights))
        standing, moving = (
            refine_pose(grid, every, gaussian_prior(pose, *_STD), pose) for pose in (self._pose, T)
        )
        # by end points alone: the local map is smeared along a motion that was none, and beams of
        # a robot that stands seem to pass through it
        stands, moves = (
            registration_cost(grid, every, match.T_map_base) for match in (standing, moving)
        )
        self._gain, self._scans = self._gain + moves - stands, self._scans + 1
        if self._gain < _REJECTED:
            self.reset()
            return None
        self._pose = standing.T_map_base
        is_enough = self._scans >= _MIN_SCANS and self._metres >= _MIN_METRES
        return standing if is_enough and self._gain > _CONFIRMED else None


def standing_prior(pose: Float, increment: Float) -> MotionPrior:
    """The prior of a robot that stands at a pose (3, 3), or moves on by odometry's step (3, 3)."""
    x, y, theta = se2.parameters(increment)
    return gaussian_prior(
        pose, max(float(np.hypot(x, y)), _FREE_STD[0]), max(abs(float(theta)), _FREE_STD[1])
    )


@dataclass(frozen=True, eq=False)
class Fault:
    """Odometry was wrong for some scans.

    Attributes:
        first_ns: stamp of the first one; None: none is known.
        before: (3, 3) T_map_base of the scan before the last one.
        match: of the last one.
    """

    first_ns: int | None
    before: Float
    match: ScanMatch


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
        self._slip, self._standing = SlipDetector(), StandingTest()
        self._stands = False  # confirmed, and odometry has not agreed with a scan since
        self._leaped_ns: int | None = None
        self._stamps = deque[int](maxlen=_MAX_STAMPS)  # of the last scans
        self._count = 0

    def predict(
        self, pose: Float, guess: MotionPrior, increment: Float | None, ns: int, seconds: float
    ) -> MotionPrior:
        """The prior of the next scan: odometry where it is plausible, a robot that stands while its
        wheels spin, else constant velocity.

        Args:
            pose: (3, 3) T_map_base of the last scan.
            guess: prior of constant velocity.
            increment: (3, 3) of odometry since; None: there is none.
            ns: stamp of the scan.
            seconds: since the last one.
        """
        self.increment, self._guess, self._ns = increment, guess, ns
        is_slipping = self._slip.is_slipping(pose, guess, increment)
        if increment is None:
            return guess
        if not _is_plausible(increment, seconds):
            self._leaped_ns = ns
        if self._stands:
            return standing_prior(pose, increment)
        has_leaped = self._leaped_ns is not None and ns < self._leaped_ns + _DISTRUST_NS
        if is_slipping or has_leaped:
            return guess
        return motion_model.odometry_prior(pose, increment, self._options)

    def detect(
        self,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        pose: Float,
        match: ScanMatch,
        usual: float | None,
        *,
        is_odometry: bool,
        may_stand: bool,
    ) -> Fault | None:
        """The fault that the scan shows to which the motion was predicted.

        Args:
            grid: the local map.
            scan: its hits.
            pose: (3, 3) T_map_base of the scan before.
            match: by the prior.
            usual: recent average of the explained share; None: whether the robot stands is not
                tested, for the scans contradict the map.
            is_odometry: the prior is that of odometry.
            may_stand: if it does, that is believed now: what keeps its place is not people.
        """
        guess, increment = self._guess, self.increment
        slip = self._slip.detect(self._count, pose, guess, increment, grid, scan, match)
        if slip is not None:
            back = min(self._count - slip.first, len(self._stamps))
            # the velocity is that of the hypothesis, too
            before = [slip.before, *(step.T_map_base for step in slip.matches)][-2]
            self._standing.reset()
            return Fault(self._stamps[-back] if back else None, before, slip.matches[-1])
        if increment is None:
            return None
        if self._stands:
            by_odometry = motion_model.odometry_prior(pose, increment, self._options)
            self._stands = is_inconsistent(by_odometry, match.T_map_base)
            return None
        is_tested = is_odometry and not match.contradicts_odometry and len(scan.points) > 0
        if usual is None or not is_tested:
            return None
        standing = self._standing.observe(grid, scan, pose, match.T_map_base, increment, self._ns)
        return self._accept_standing(standing, usual) if may_stand else None

    def advance(self, ns: int) -> None:
        """The scan with that stamp is registered."""
        self._stamps.append(ns)
        self._count += 1

    def reset(self) -> None:
        """Discard the past motion, after the robot was carried elsewhere."""
        self._slip.reset()
        self._standing.reset()
        self._stands = False

    def _accept_standing(self, standing: ScanMatch | None, usual: float) -> Fault | None:
        if standing is None:
            return None
        first_ns = self._standing.first_ns
        self._standing.reset()
        if is_poor(standing, usual):  # the robot is elsewhere
            return None
        self._stands = True
        return Fault(first_ns, standing.T_map_base, standing)


def _is_plausible(step: Float, seconds: float) -> bool:
    """True if a robot can move by a step (3, 3) in that time."""
    return float(np.hypot(*step[:2, 2])) <= max(_LEAP, _MAX_SPEED * seconds)


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
        window = _WINDOW_STDS * metres, min(_WINDOW_STDS * radians, _MAX_ROTATION)
        match = search_pose(grid, alike, wide, *window)
        evidence = judge_scan(grid, alike, match, usual)
        if evidence is Evidence.CONTRADICTS:
            occluded = occluded_share(grid, alike, prior.T_map_base)
            # odometry may have led the robot to where nothing is mapped
            evidence = Evidence.UNKNOWN if occluded <= _MAX_OCCLUDED else evidence
        if evidence is not Evidence.CONTRADICTS:
            if match.explained >= _EXPLAINED * usual and not _is_ambiguous(match):
                return match, Evidence.AGREES
            self._unknown += match.explained < _EXPLAINED * usual
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
