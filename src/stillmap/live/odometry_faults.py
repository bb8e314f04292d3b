"""Faults of wheel odometry as scans arrive: leaps, wheels that slip, wheels that spin."""

import dataclasses
from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.slam import motion_model
from stillmap.slam.motion_model import MotionPrior, gaussian_prior
from stillmap.slam.odometry_faults import SlipDetector
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import ScanMatch, is_inconsistent, is_poor, refine_pose

Float = NDArray[np.float64]

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
_UNKNOWN = np.full((3, 3), np.inf)  # an increment that is not small


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
        self._gain, self._scans = self._gain + moving.cost - standing.cost, self._scans + 1
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


class _LatestIncrement:
    """The increment of odometry to the scan that is being registered, whatever the index."""

    value: Float | None = None

    def __getitem__(self, index: int, /) -> Float:
        return _UNKNOWN if self.value is None else self.value


class OdometryFaults:
    """Tests odometry scan by scan.

    Args:
        options: see OdometryOptions.
    """

    def __init__(self, options: OdometryOptions) -> None:
        self._options = options
        self._increment = _LatestIncrement()
        self._slip, self._standing = SlipDetector(self._increment), StandingTest()
        self._stands = False  # confirmed, and odometry has not agreed with a scan since
        self._leaped_ns: int | None = None
        self._stamps = deque[int](maxlen=_MAX_STAMPS)  # of the last scans
        self._count = 0

    @property
    def increment(self) -> Float | None:
        """(3, 3) of odometry to the scan that is being registered; None: there is none."""
        return self._increment.value

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
        self._increment.value = increment
        is_slipping = self._slip.is_slipping(self._count, pose, guess)
        if increment is None:
            return guess
        if not is_plausible(increment, seconds):
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
        priors: tuple[MotionPrior, MotionPrior],
        match: ScanMatch,
        ns: int,
        usual: float | None,
        *,
        may_stand: bool,
    ) -> Fault | None:
        """The fault that a scan shows.

        Args:
            grid: the local map.
            scan: the hits of the scan.
            pose: (3, 3) T_map_base of the scan before.
            priors: of the scan, and that of constant velocity.
            match: by the prior.
            ns: stamp of the scan.
            usual: recent average of the explained share; None: whether the robot stands is not
                tested, for the scans contradict the map.
            may_stand: if it does, that is believed now: what keeps its place is not people.
        """
        prior, guess = priors
        slip = self._slip.detect(self._count, pose, guess, grid, scan, match)
        if slip is not None:
            back = min(self._count - slip.first, len(self._stamps))
            # the velocity is that of the hypothesis, too
            before = [slip.before, *(step.T_map_base for step in slip.matches)][-2]
            self._standing.reset()
            return Fault(self._stamps[-back] if back else None, before, slip.matches[-1])
        increment = self.increment
        if increment is None:
            return None
        if self._stands:
            by_odometry = motion_model.odometry_prior(pose, increment, self._options)
            self._stands = is_inconsistent(by_odometry, match.T_map_base)
            return None
        if usual is None or not prior.is_odometry or match.contradicts_odometry:
            return None
        if not len(scan.points):
            return None
        standing = self._standing.observe(grid, scan, pose, match.T_map_base, increment, ns)
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


def is_plausible(step: Float, seconds: float) -> bool:
    """True if a robot can move by a step (3, 3) in that time."""
    return float(np.hypot(*step[:2, 2])) <= max(_LEAP, _MAX_SPEED * seconds)
