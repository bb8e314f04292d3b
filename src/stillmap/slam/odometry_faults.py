"""Odometry that stands still while the robot goes on: wheels, or what counts them, may stall.

Between two walls a scan fits well enough where odometry leaves it. So the robot is also followed as
if it had gone on, for as long as odometry stands still; what the scans say for that adds up.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.scan_matching import RegistrationOptions, Scan, ScanMatch

Float = NDArray[np.float64]

_LEAST = 0.02  # m and rad, of a step: slower robots may as well have stopped
_STILL = 0.2  # of the step before: what is shorter is none
_LONGEST = 500  # scans in which it has to become clear


@dataclass(frozen=True, eq=False)
class SlipHypothesis:
    """The robot as if it had gone on.

    Attributes:
        first: the scan at which odometry stopped.
        before: (3, 3) T_map_base of the scan before it.
        found: where each scan from the first on lies then.
        gain: nats by which they fit better than where odometry leaves them.
    """

    first: int
    before: Float
    found: list[ScanMatch]
    gain: float


class SlipDetector:
    """Follows a robot whose odometry may stall, scan by scan."""

    def __init__(self, increments: Float | None, options: RegistrationOptions) -> None:
        """Before the second scan.

        Args:
            increments: (T - 1, 3, 3) of odometry; None: nothing can stall.
            options: see RegistrationOptions.
        """
        self._increments, self._options = increments, options
        self.forget()

    def forget(self) -> None:
        """The robot is elsewhere: nothing of how it moved before tells how it goes on."""
        self._stalled = False
        self._going: SlipHypothesis | None = None

    def stalled(self, t: int, last: Float, guess: MotionPrior) -> bool:
        """Whether odometry has been found to stall and still does on the way to scan t.

        Args:
            t: the scan.
            last: (3, 3) T_map_base of the scan before.
            guess: the last motion once more.
        """
        if self._stalled:  # a robot that stands meanwhile does not make its odometry true again
            step = max(_size(se2.inverse(last) @ guess.T_map_base), _LEAST)
            self._stalled = self._moved(t) < _STILL * step
        return self._stalled

    def look(
        self,
        t: int,
        last: Float,
        guess: MotionPrior,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        found: ScanMatch,
    ) -> SlipHypothesis | None:
        """How the robot went on, once the scans leave no doubt that it did.

        Args:
            t, last, guess: as `stalled` has them.
            grid: the map so far.
            scan: what was seen.
            found: where it lies by the prior, which is odometry's unless that is implausible.
        """
        if self._stalled:
            return None
        onwards = self._onwards(t, last, guess) if len(scan.points) else None
        if onwards is None:
            self._going = None
        else:
            start = onwards.T_map_base
            moved = scan_matching.search_pose(grid, scan, onwards, self._options, 0.0, 0.0, start)
            self._add(t, last, moved, found.misfit - moved.misfit)
        if self._going is not None and self._going.gain > self._options.lies:
            gone_on, self._going, self._stalled = self._going, None, True
            return gone_on
        # a turn is seen at once
        self._stalled = found.disagrees and self._stands_still(t, last, found.T_map_base)
        if self._stalled:
            self._going = None
        return None

    def _onwards(self, t: int, last: Float, guess: MotionPrior) -> MotionPrior | None:
        """Where the robot is if it goes on; None where it moved as odometry says."""
        going = self._going
        if going is not None:
            if len(going.found) == _LONGEST:
                return None
            before, last = [going.before, *(f.T_map_base for f in going.found[-2:])][-2:]
            ahead = last @ se2.inverse(before) @ last
            guess = motion_model.gaussian_prior(
                ahead, guess.sigma_translation, guess.sigma_rotation
            )
        elif guess.sigma_translation > _size(se2.inverse(last) @ guess.T_map_base):
            return None  # nobody can tell how it would go on
        return guess if self._stands_still(t, last, guess.T_map_base) else None

    def _add(self, t: int, last: Float, moved: ScanMatch, gain: float) -> None:
        going = self._going or SlipHypothesis(t, last, [], 0.0)
        gain += going.gain
        going.found.append(moved)
        stopped = gain < -self._options.lies
        self._going = None if stopped else dataclasses.replace(going, gain=gain)

    def _stands_still(self, t: int, last: Float, T_map_base: Float) -> bool:
        """Whether odometry has no motion to scan t where a pose (3, 3) of it means some."""
        step = _size(se2.inverse(last) @ T_map_base)
        return step > _LEAST and self._moved(t) < _STILL * step

    def _moved(self, t: int) -> float:
        """How far odometry came on the way to scan t."""
        return np.inf if self._increments is None else _size(self._increments[t - 1])


def _size(increment: Float) -> float:
    x, y, theta = se2.parameters(increment)
    return float(np.hypot(x, y) + abs(theta))
