"""Dead reckoning while scans have no returns: covariance of the pose, and the search after it."""

import math

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.slam import scan_matching
from stillmap.slam.front_end import Evidence, judge_scan
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.scan_hits import Scan

# m and rad, standard deviations beyond which the search next to odometry may miss the pose
_FAR = 0.05, 0.02
# standard deviation of what odometry adds in every step alike: m per m, rad per m, rad per rad
_BIAS = 0.03, 0.01, 0.02
_MAX_OCCLUDED = 0.4  # share of beams through walls at the pose by odometry: more contradict the map
_ALIKE = 0.3, 0.3  # m and rad within which two optima are one pose
# scans that see another part of the map, or are ambiguous, until odometry is believed
_MAX_UNKNOWN, _MAX_SCANS = 10, 100


class DeadReckoning:
    """Covariance of the pose by odometry alone since the last scan with returns."""

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
    ) -> tuple[scan_matching.ScanMatch | None, Evidence]:
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
        unlabelled = scan.reweight(np.ones_like(scan.shares))
        match = scan_matching.search_within_prior(grid, unlabelled, wide)
        evidence = judge_scan(grid, unlabelled, match, usual)
        if evidence is Evidence.CONTRADICTS:
            occluded = scan_matching.occluded_share(grid, unlabelled, prior.T_map_base)
            # odometry may have led the robot to where nothing is mapped
            evidence = Evidence.UNKNOWN if occluded <= _MAX_OCCLUDED else evidence
        if evidence is not Evidence.CONTRADICTS:
            if not scan_matching.is_poor(match, usual) and not _is_ambiguous(match):
                return match, Evidence.AGREES
            self._unknown += scan_matching.is_poor(match, usual)
        return None, evidence

    @property
    def is_over(self) -> bool:
        """True if odometry is believed, for the scans say nothing else."""
        return self._unknown >= _MAX_UNKNOWN or self._scans >= _MAX_SCANS


def _is_ambiguous(match: scan_matching.ScanMatch) -> bool:
    """True if another pose explains the scan about as well."""
    x, y, theta, cost = match.alternatives.T
    is_other = (np.hypot(x, y) > _ALIKE[0]) | (np.abs(theta) > _ALIKE[1])
    return bool((is_other & (cost < scan_matching.MIN_GAIN)).any())


def _propagate(covariance: Float, before: Float, after: Float) -> Float:
    """(3, 3) after a step: an error of the heading turns it."""
    x, y = (after - before)[:2, 2].tolist()
    F = np.array([[1.0, 0.0, -y], [0.0, 1.0, x], [0.0, 0.0, 1.0]])
    return np.asarray(F @ covariance @ F.T)


def _stds(covariance: Float) -> tuple[float, float]:
    """m and rad, of the worst direction and of the heading."""
    worst = float(np.linalg.eigvalsh(covariance[:2, :2])[-1])
    return math.sqrt(max(worst, 0.0)), math.sqrt(max(float(covariance[2, 2]), 0.0))
