"""The front end in 2D, of maps in batch and live: one scan after another is registered (9).

It knows the last poses and what scans taught it so far: the noise of odometry and of constant
velocity, how much of a scan the local map explains, and which scans contradict that map. The caller
keeps the local map, and decides what becomes of a robot that was carried elsewhere.
"""

from enum import Enum

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.local_map import SCAN_SPACING, SPACING_PER_SECOND
from stillmap.slam.motion_model import MotionPrior, OdometryNoise, VelocityNoise
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import (
    ScanMatch,
    compare_priors,
    is_poor,
    match_scan,
    widen_match,
)

_EXPLAINED_RATE = 0.1  # weight of one scan in the running average of the explained share
_AGREE_SHARE, _CONTRADICT_SHARE = 0.6, 0.4  # explained, of the usual share
# spaced scans that contradict the map, more than others agree, after which the robot was carried;
# at most; contradicting ones that one outweighs which agrees, and one that says nothing
_CARRIED_AFTER, _MAX_CONTRADICTIONS, _AGREEMENT, _NO_EVIDENCE = 6.0, 12.0, 2.0, 0.1


class Evidence(Enum):
    """Relation of a matched scan to the map."""

    AGREES = "agrees"
    CONTRADICTS = "contradicts"
    UNKNOWN = "unknown"


def judge_scan(grid: _core.OccupancyGrid2D, scan: Scan, match: ScanMatch, usual: float) -> Evidence:
    """Compare a matched scan with a map: it agrees, contradicts it, or sees another part of it.

    A scan of a new place is explained as little as one elsewhere, but its beams do not pass
    through walls.
    """
    if len(scan.points) == 0:
        return Evidence.UNKNOWN
    occluded = scan_matching.occluded_share(grid, scan, match.T_map_base)
    if occluded <= scan_matching.MAX_OCCLUDED:
        return Evidence.AGREES if match.explained >= _AGREE_SHARE * usual else Evidence.UNKNOWN
    return Evidence.CONTRADICTS if match.explained < _CONTRADICT_SHARE * usual else Evidence.UNKNOWN


class FrontEnd:
    """State of the registration of scans.

    Args:
        options: largest noise of odometry.

    Attributes:
        pose, before: (3, 3) T_map_base of the last scan and of the one before it; the same where
            the velocity is unknown.
        usual: running average of the explained share of each sensor, which sees its own side.
        first_contradicting: the first of the scans that contradict the local map, until as many
            spaced ones agree; None: none does.
    """

    def __init__(self, options: OdometryOptions) -> None:
        self._options = options
        self.pose, self.before = np.eye(3), np.eye(3)
        self.usual: dict[str | int, float] = {}
        self._increment: Float | None = None  # (3, 3) of odometry to the next scan
        self._velocity_noise, self._odometry_noise = VelocityNoise(), OdometryNoise()
        self.agree()

    def agree(self) -> None:
        """The scans so far agree with the local map."""
        self._contradictions, self._since = 0.0, np.inf
        self.first_contradicting: int | None = None
        # pose (3, 3) from which odometry is valid if it was late at the scans since, the last one
        # at least, and its increment (3, 3) since
        self._late: tuple[Float, Float] | None = None

    @property
    def is_carried(self) -> bool:
        """True if so many scans contradict the local map that the robot was carried elsewhere."""
        return self._contradictions >= _CARRIED_AFTER

    def predict(self) -> MotionPrior:
        """The prior of the next scan at constant velocity."""
        return motion_model.constant_velocity_prior(self.pose, self.before, self._velocity_noise)

    def follow_odometry(self, increment: Float, *, learned: bool) -> MotionPrior:
        """The prior of the next scan after an increment (3, 3), which is kept until `advance`, with
        the noise learned so far or the largest."""
        self._increment = increment
        noise = self._odometry_noise if learned else OdometryNoise()
        return motion_model.odometry_prior(self.pose, increment, self._options, noise)

    def match(
        self,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        sensor: str | int,
        prior: MotionPrior,
        learned: MotionPrior | None,
        alternative: MotionPrior | None,
    ) -> tuple[ScanMatch, bool]:
        """The match of a scan within its prior or, if odometry fails, an alternative to it; and
        whether it is a poor one: without hits, too."""
        usual = self.usual.get(sensor, 1.0)
        match = match_scan(grid, scan, prior, usual, learned)
        if prior.is_odometry and alternative is not None and len(scan.points):
            match = compare_priors(grid, scan, prior, learned, alternative, match, usual)
        return match, is_poor(match, usual)

    def confirms(self, prior: MotionPrior, match: ScanMatch, sensor: str | int) -> bool:
        """True if a scan fits; if its prior may lead to one of several places, as well as usual."""
        usual = self.usual.get(sensor, 1.0)
        if not scan_matching.is_narrow(prior):
            return match.explained >= scan_matching.LOCAL_SHARE * usual
        return not is_poor(match, usual)

    def search_wider(
        self,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        sensor: str | int,
        prior: MotionPrior,
        alternative: MotionPrior | None,
        match: ScanMatch,
    ) -> tuple[ScanMatch, Evidence]:
        """A poor match, or one outside the prior that is more likely, and what it says."""
        usual = self.usual.get(sensor, 1.0)
        priors = [prior] if alternative is None else [prior, alternative]
        if self._late is not None and self._increment is not None:
            pose, since = self._late
            priors += [motion_model.odometry_prior(pose, since @ self._increment, self._options)]
        wider = widen_match(grid, scan, priors, match, usual)
        return wider, judge_scan(grid, scan, wider, usual)

    def weigh(self, t: int, T_map_base: Float, seconds: float, evidence: Evidence) -> None:
        """Count scans that contradict the local map, less those that agree.

        Args:
            t: number of a scan.
            T_map_base: (3, 3) of it: scans that are close to each other count as one.
            seconds: since the one before.
            evidence: what it says.
        """
        x, y, theta = se2.parameters(se2.inverse(self.pose) @ T_map_base)
        self._since += float(np.hypot(x, y) + abs(theta)) + SPACING_PER_SECOND * seconds
        contradicts = evidence is Evidence.CONTRADICTS
        if contradicts and self.first_contradicting is None:
            self.first_contradicting = t
        if self._since < SCAN_SPACING:
            return
        self._since = 0.0
        if contradicts:
            self._contradictions = min(self._contradictions + 1.0, _MAX_CONTRADICTIONS)
        else:
            less = _AGREEMENT if evidence is Evidence.AGREES else _NO_EVIDENCE
            self._contradictions = max(self._contradictions - less, 0.0)
            if self._contradictions == 0.0:
                self.first_contradicting = None

    def learn(
        self, sensor: str | int, prior: MotionPrior, match: ScanMatch, seconds: float
    ) -> None:
        """Update the running averages of noise and of the explained share; not while scans
        contradict the map, which says nothing about them.

        Args:
            sensor: of the scan.
            prior: with the noise learned so far.
            match: of the scan.
            seconds: usually between scans.
        """
        if self.first_contradicting is not None:
            return
        usual = self.usual.get(sensor, 1.0)
        if prior.is_odometry and not is_poor(match, usual):
            self._odometry_noise = self._odometry_noise.update(
                prior, match.T_map_base, match.covariance
            )
        self.usual[sensor] = usual + _EXPLAINED_RATE * (match.explained - usual)
        residual = self.predict().residual(match.T_map_base)
        self._velocity_noise = self._velocity_noise.update(residual, seconds)

    def advance(
        self, T_map_base: Float, *, is_fault: bool = False, is_first: bool = False
    ) -> float:
        """Go on to the pose (3, 3) of a scan; m of travel.

        Args:
            T_map_base: the pose.
            is_fault: odometry does not lead there.
            is_first: the velocity is 0.
        """
        if self._increment is None or is_first:
            self._late = None
        elif is_fault and self._late is not None:
            pose, since = self._late
            self._late = pose, since @ self._increment
        else:
            self._late = self.pose, self._increment
        self._increment = None
        self.before = T_map_base if is_first else self.pose
        metres = float(np.hypot(*(T_map_base[:2, 2] - self.pose[:2, 2])))
        self.pose = T_map_base
        return metres
