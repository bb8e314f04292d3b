"""Faults of wheel odometry as scans arrive.

Odometry is valid or not: while it is not, scans are predicted at constant velocity. A fault that
no single scan shows, of wheels that spin or odometry that stands still, is shown by a rival
hypothesis about the motion, which has poses of its own.
"""

from dataclasses import dataclass

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.slam import motion_model
from stillmap.slam.motion_model import MotionPrior, gaussian_prior
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import (
    FAULT_COST,
    ScanMatch,
    is_inconsistent,
    refine_pose,
    registration_cost,
)

_STANDING_STD = 0.005, 0.003  # m and rad by which a robot that stands may seem to move
_MAX_SPEED = 3.0  # m/s of robots: odometry that is faster has leaped


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
        unlabelled = scan.reweight(np.ones_like(scan.shares))
        match = refine_pose(grid, unlabelled, prior, prior.T_map_base)
        # by end points alone: the local map is smeared along a motion that was none, and beams of
        # a robot that stands seem to pass through it
        by_odometry, by_rival = (
            registration_cost(grid, unlabelled, at) for at in (T, match.T_map_base)
        )
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
        self._unconfirmed: tuple[Float, Float] | None = None

    def predict(
        self,
        measured: MotionPrior | None,
        guess: MotionPrior,
        increment: Float | None,
        ns: int,
        seconds: float,
    ) -> MotionPrior:
        """The prior of the next scan: by odometry while it is valid, else at constant velocity.

        Args:
            measured: prior of odometry; None: there is none.
            guess: prior of constant velocity.
            increment: (3, 3) of odometry since the last scan; None: there is none.
            ns: stamp of the scan.
            seconds: since the last one.
        """
        self.increment, self._guess, self._ns = increment, guess, ns
        if measured is None or increment is None:
            return guess
        if np.hypot(*increment[:2, 2]) > max(motion_model.MIN_LEAP, _MAX_SPEED * seconds):
            self._is_valid = False
        return measured if self._is_valid else guess

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
        start, step = self._unconfirmed or (pose, np.eye(3))
        step = step @ increment
        by_odometry = motion_model.odometry_prior(start, step, self._options)
        standing = motion_model.odometry_prior(start, np.eye(3), self._options)
        is_off = is_inconsistent(by_odometry, T_map_base)
        self._unconfirmed = None if is_off else (start, step)
        # steps of a fast laser are too short to say so: they add up
        return not is_off and is_inconsistent(standing, T_map_base)

    def _choose_rival(self, pose: Float, increment: Float) -> RivalMotion:
        """The robot stands while odometry moves, and goes on while odometry rather stands still."""
        rival = self._rival
        onward = se2.inverse(pose) @ self._guess.T_map_base
        if rival is not None and not rival.stands:
            onward = rival.step
        stands = _size(increment) > 0.5 * _size(onward)  # nearer to that step than to none
        if rival is not None and rival.stands == stands:
            return rival
        return RivalMotion(pose, np.eye(3) if stands else onward, self._ns, stands=stands)


def _size(step: Float) -> float:
    """m and rad of a step (3, 3) together."""
    x, y, theta = se2.parameters(step)
    return float(np.hypot(x, y) + abs(theta))
