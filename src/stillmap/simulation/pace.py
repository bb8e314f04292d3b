"""How fast a robot drives: curves, red lights, and the time that it takes to gain speed."""

import math

import numpy as np
from numpy.typing import NDArray

from stillmap.simulation.options import RobotOptions
from stillmap.simulation.scene import Light

Float = NDArray[np.float64]

_AT_ONCE = 1e3  # m/s^2, as good as no limit
_OVER = 0.5  # m past the line that somebody stops who brakes for it
_BEND = 1.0  # m before and after a point, over which a curve is measured


class Pace:
    """Speeds along a way.

    Args:
        way: (N, 2) points in metres, evenly spaced.
        closed: the way begins again at its end.
        options: the robot's.
        lights: where it stops while they are red.
    """

    def __init__(
        self, way: Float, closed: bool, options: RobotOptions, lights: tuple[Light, ...]
    ) -> None:
        self._acceleration = options.acceleration or _AT_ONCE
        self._spacing = float(np.hypot(*(way[1] - way[0]))) if len(way) > 1 else 0.0
        self._closed, self._lights = closed, lights
        self._lines = [int(np.argmin(np.hypot(*(way - light.at).T))) for light in lights]
        self._allowed = self._through_curves(way, options.speed)

    def gained(self, wanted: float, now: float, dt: float) -> float:
        """m/s, how much of a wanted speed is reached in dt seconds."""
        return min(wanted, now + self._acceleration * dt)

    def allowed(self, at: int, past: float, now: float, seconds: float, dt: float) -> float:
        """m/s, how fast the robot may drive next.

        Args:
            at: the point of the way that the robot is nearest to.
            past: m, how far it is past that.
            now: m/s, its speed so far.
            seconds: since the recording began.
            dt: s, for how long.
        """
        a, points = self._acceleration, len(self._allowed)
        speed = float(self._allowed[at])
        for light, line in zip(self._lights, self._lines, strict=True):
            ahead = (line - at) % points if self._closed else line - at
            left = ahead * self._spacing - past
            # whoever is past it or cannot stop any more drives on
            if light.is_red(seconds) and left + _OVER > now**2 / (2 * a):
                # what is left is driven in this step and while braking after it
                left = max(left, 0.0)
                speed = min(speed, math.sqrt((a * dt) ** 2 + 2 * a * left) - a * dt)
        return speed

    def _through_curves(self, way: Float, fastest: float) -> Float:
        """(N,) m/s, no faster than curves allow, and slow enough to brake for those ahead."""
        if len(way) < 3:
            return np.full(len(way), fastest)
        laps = np.concatenate([way, way[1:]]) if self._closed else way
        heading = np.unwrap(np.arctan2(*np.diff(laps, axis=0).T[::-1]))
        half = max(1, round(_BEND / self._spacing))
        ends = np.pad(heading, half, mode="edge")
        bend = np.abs(ends[2 * half :] - ends[: -2 * half]) / (2 * half * self._spacing)
        squares = np.minimum(fastest**2, self._acceleration / np.maximum(bend, 1e-9))
        squares = np.append(squares, squares[-1])
        gain = 2 * self._acceleration * self._spacing * np.arange(len(squares))
        squares = np.minimum.accumulate((squares + gain)[::-1])[::-1] - gain
        # rounding must not make a straight way slower
        speed = np.where(
            squares > fastest**2 * (1 - 1e-9), fastest, np.sqrt(np.maximum(squares, 0))
        )
        return np.asarray(speed[: len(way)])
