"""Test whether the robot stands while its wheels spin: odometry moves on, the scans do not.

Between the walls of a corridor each scan fits well enough where odometry leads. A second hypothesis
therefore stays where the robot was, and its gain in log likelihood is summed over the scans.
"""

import dataclasses

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.slam.motion_model import MotionPrior, gaussian_prior
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import ScanMatch, refine_pose

Float = NDArray[np.float64]

_SPACING_NS = 10**8  # between scans that are compared
_STD = 0.005, 0.003  # m and rad by which both hypotheses may differ from the poses they predict
_REJECTED, _CONFIRMED = -10.0, 30.0  # nats of gain: the robot moves; it stands
# scans compared and m of odometry, at least, before it stands; m after which the test begins anew
_MIN_SCANS, _MIN_METRES, _MAX_METRES = 4, 0.3, 5.0
_MIN_STEP = 0.02  # m or rad of odometry between compared scans: less, and it stands, too
_FREE_STD = 0.02, 0.01  # m and rad, at least, of the prior while the robot stands


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
