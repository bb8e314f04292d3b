"""Wheel slip while the robot drives: odometry stands still, and the robot does not.

Between two walls a scan fits well enough where odometry leaves it. While odometry stands still, a
second hypothesis therefore follows the robot at constant velocity, and its gain in log likelihood
is summed over the scans.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import ScanMatch

_DECISIVE = 10.0  # nats of gain from which odometry is rejected, of loss from which it is believed
_MIN_STEP = 0.02  # m and rad between scans: a slower robot may as well have stopped
_STILL_RATIO = 0.2  # of the predicted step: shorter odometry steps count as standing still
_MAX_SCANS = 500  # of one hypothesis


@dataclass(frozen=True, eq=False)
class SlipHypothesis:
    """The robot at constant velocity while odometry stands still.

    Attributes:
        first: scan at which odometry stopped.
        before: (3, 3) T_map_base of the scan before it.
        matches: of each scan from the first on.
        gain: nats by which they fit better than the poses by odometry.
    """

    first: int
    before: Float
    matches: list[ScanMatch]
    gain: float


class SlipDetector:
    """Tests for wheel slip scan by scan."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Discards the past motion, after the robot was carried elsewhere."""
        self._is_slipping = False
        self._hypothesis: SlipHypothesis | None = None

    def is_slipping(self, last: Float, guess: MotionPrior, increment: Float | None) -> bool:
        """True if a detected slip still holds on the way to the next scan.

        Args:
            last: (3, 3) T_map_base of the scan before.
            guess: constant-velocity prior of the scan.
            increment: (3, 3) of odometry; None: there is none.
        """
        if self._is_slipping:  # a robot that pauses does not make its odometry valid again
            step = max(_step_size(se2.inverse(last) @ guess.T_map_base), _MIN_STEP)
            self._is_slipping = _step_size(increment) < _STILL_RATIO * step
        return self._is_slipping

    def detect(
        self,
        t: int,
        last: Float,
        guess: MotionPrior,
        increment: Float | None,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        match: ScanMatch,
    ) -> SlipHypothesis | None:
        """The slip hypothesis, at the scan that confirms it.

        Args:
            t: number of the scan.
            last, guess, increment: as of `is_slipping`.
            grid: the local map.
            scan: scan t.
            match: its match by the prior, which is odometry unless that is implausible.
        """
        if self._is_slipping:
            return None
        onward = self._predict(last, guess, increment) if len(scan.points) else None
        if onward is None:
            self._hypothesis = None
        else:
            moved = scan_matching.refine_pose(grid, scan, onward, onward.T_map_base)
            self._extend(t, last, moved, match.cost - moved.cost)
        if self._hypothesis is not None and self._hypothesis.gain > _DECISIVE:
            confirmed, self._hypothesis, self._is_slipping = self._hypothesis, None, True
            return confirmed
        # rotation shows at once
        self._is_slipping = match.contradicts_odometry and _stands_still(
            increment, last, match.T_map_base
        )
        if self._is_slipping:
            self._hypothesis = None
        return None

    def _predict(
        self, last: Float, guess: MotionPrior, increment: Float | None
    ) -> MotionPrior | None:
        """Prior of the scan at constant velocity; None if odometry moves or velocity is unknown."""
        hypothesis = self._hypothesis
        if hypothesis is not None:
            if len(hypothesis.matches) == _MAX_SCANS:
                return None
            recent = (m.T_map_base for m in hypothesis.matches[-2:])
            before, last = [hypothesis.before, *recent][-2:]
            ahead = last @ se2.inverse(before) @ last
            guess = motion_model.gaussian_prior(ahead, guess.translation_std, guess.rotation_std)
        elif guess.translation_std > _step_size(se2.inverse(last) @ guess.T_map_base):
            return None
        return guess if _stands_still(increment, last, guess.T_map_base) else None

    def _extend(self, t: int, last: Float, moved: ScanMatch, gain: float) -> None:
        """Adds the match of scan t to the hypothesis, or rejects it where the robot stopped."""
        hypothesis = self._hypothesis or SlipHypothesis(t, last, [], 0.0)
        gain += hypothesis.gain
        hypothesis.matches.append(moved)
        has_stopped = gain < -_DECISIVE
        self._hypothesis = None if has_stopped else dataclasses.replace(hypothesis, gain=gain)


def _stands_still(increment: Float | None, last: Float, T_map_base: Float) -> bool:
    """True if odometry stands still on the way from a pose (3, 3) to another that moved."""
    step = _step_size(se2.inverse(last) @ T_map_base)
    return step > _MIN_STEP and _step_size(increment) < _STILL_RATIO * step


def _step_size(increment: Float | None) -> float:
    """m and rad together; without odometry no small step."""
    if increment is None:
        return np.inf
    x, y, theta = se2.parameters(increment)
    return float(np.hypot(x, y) + abs(theta))
