"""Odometry that stands still while the robot goes on: wheels, or what counts them, may stall.

Between two walls a scan fits well enough where odometry leaves it. So the robot is also followed as
if it had gone on, for as long as odometry stands still; what the scans say for that adds up.
"""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, se2
from stillmap.slam import motion, registration
from stillmap.slam.motion import Steadiness
from stillmap.slam.registration import Registration, RegistrationOptions
from stillmap.slam.scans import Scan

Float = NDArray[np.float64]

_LEAST = 0.02  # m and rad, of a step: slower robots may as well have stopped
_STILL = 0.2  # of the step before: what is shorter is none
_LONGEST = 500  # scans in which it has to become clear


@dataclass(frozen=True, eq=False)
class GoingOn:
    """The robot as if it had gone on.

    Attributes:
        first: the scan at which odometry stopped.
        found: where each scan from that one on lies then.
        gain: nats by which they fit better than where odometry leaves them.
    """

    first: int
    found: list[Registration]
    gain: float


class Watch:
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
        self._going: GoingOn | None = None

    def stalled(self, t: int, poses: Float) -> bool:
        """Whether odometry has been found to stall and still does on the way to scan t."""
        self._stalled = self._stalled and self._stands_still(t, poses[t - 2], poses[t - 1])
        return self._stalled

    def look(
        self,
        t: int,
        poses: Float,
        steadiness: Steadiness,
        grid: _core.Grid2D,
        scan: Scan,
        found: Registration,
    ) -> GoingOn | None:
        """How the robot went on, once the scans leave no doubt that it did.

        Args:
            t: the scan.
            poses: (T, 3, 3) T_map_base, known before it.
            steadiness: how far guesses were off of late.
            grid: the map so far.
            scan: what was seen.
            found: where it lies by the prior, which is odometry's unless that is implausible.
        """
        if self._stalled:
            return None
        self._going = self._followed(t, poses, steadiness, grid, scan, found)
        if self._going is not None and self._going.gain > self._options.lies:
            gone_on, self._going, self._stalled = self._going, None, True
            return gone_on
        # a turn is seen at once
        self._stalled = found.disagrees and self._stands_still(t, poses[t - 1], found.T_map_base)
        if self._stalled:
            self._going = None
        return None

    def _followed(
        self,
        t: int,
        poses: Float,
        steadiness: Steadiness,
        grid: _core.Grid2D,
        scan: Scan,
        found: Registration,
    ) -> GoingOn | None:
        """What is known of a robot that goes on, with one more scan; None when it does not."""
        going = self._going
        if len(scan.points) == 0 or (going is not None and len(going.found) == _LONGEST):
            return None
        earlier = [poses[s] for s in range(max(t - 2, 0), t)]
        if going is not None:
            earlier = [poses[going.first - 1], *(f.T_map_base for f in going.found)][-2:]
        if len(earlier) < 2 or not self._stands_still(t, *earlier):
            return None
        before, last = earlier
        if going is None and steadiness.translation > _size(se2.inverse(before) @ last):
            return None  # nobody can tell how it would go on
        guess = motion.from_constant_velocity(last, before, steadiness)
        start = guess.T_map_base
        moved = registration.search(grid, scan, guess, self._options, 0.0, 0.0, start)
        gain = found.misfit - moved.misfit
        if going is None:
            return GoingOn(t, [moved], gain)
        going.found.append(moved)
        gain += going.gain
        return None if gain < -self._options.lies else dataclasses.replace(going, gain=gain)

    def _stands_still(self, t: int, before: Float, after: Float) -> bool:
        """Whether odometry has no motion to scan t where that between two poses (3, 3) is some."""
        if self._increments is None:
            return False
        step = _size(se2.inverse(before) @ after)
        return step > _LEAST and _size(self._increments[t - 1]) < _STILL * step


def _size(increment: Float) -> float:
    x, y, theta = se2.parameters(increment)
    return float(np.hypot(x, y) + abs(theta))
