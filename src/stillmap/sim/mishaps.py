"""Mishaps of a planar laser: bumps that show it the floor, and stretches without returns."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.sim.laser import Float, Returns
from stillmap.sim.options import LaserOptions, RobotOptions

FLOOR = -3  # Truth.mover of beams that end on the floor
_SPREAD = (0.5, 1.5)  # of pitch and duration of a bump, times their options


@dataclass(frozen=True, eq=False)
class Bumps:
    """K bumps of the robot, each a half sine wave of pitch and roll.

    Attributes:
        start: (K,) s, since the beginning of the recording.
        duration: (K,) s.
        peak: (K, 2) rad, pitch (nose down) and roll (left side down) at the peak.
    """

    start: Float
    duration: Float
    peak: Float

    def tilt(self, seconds: Float) -> Float:
        """(..., 2) rad, pitch and roll at times (...); bumps that overlap add up."""
        out = np.zeros((*seconds.shape, 2))
        for start, duration, peak in zip(self.start, self.duration, self.peak, strict=True):
            phase = (seconds - start) / duration
            within = (phase > 0) & (phase < 1)
            out[within] += np.sin(np.pi * phase[within])[:, None] * peak
        return out


def simulate_bumps(
    robot: Float, seconds: Float, options: RobotOptions, rng: np.random.Generator
) -> Bumps:
    """The bumps on the way of a robot, a Poisson process in the distance driven.

    Args:
        robot: (T, 3) poses.
        seconds: (T,) times of them.
        options: rate and size of bumps.
        rng: not used at rate 0.
    """
    if options.bump_rate == 0:
        return Bumps(np.empty(0), np.empty(0), np.empty((0, 2)))
    steps = np.hypot(*np.diff(robot[:, :2], axis=0).T)
    # being carried or turned on the spot shakes nobody
    steps[np.diff(seconds) > 1.5 * np.median(np.diff(seconds))] = 0.0
    driven = np.concatenate([[0.0], np.cumsum(steps)])
    count = rng.poisson(options.bump_rate * driven[-1])
    start = np.interp(np.sort(rng.uniform(0.0, driven[-1], count)), driven, seconds)
    duration = options.bump_time * rng.uniform(*_SPREAD, count)
    pitch = options.bump_pitch * rng.uniform(*_SPREAD, count) * rng.choice([-1.0, 1.0], count)
    roll = options.bump_roll * rng.standard_normal(count)
    return Bumps(start, duration, np.stack([pitch, roll], axis=-1))


def add_floor(exact: Returns, bearing: Float, tilt: Float, height: float) -> Returns:
    """End beams on a level floor where that is nearer than what they would have met.

    A beam at bearing a of a laser at height h, pitched by p and rolled by r, ends on the floor
    after h / (sin p cos a + sin r sin a); walls are taken for high, and their distances for those
    of the level laser.

    Args:
        exact: returns (T, n) of the level laser.
        bearing: (T, n) of the beams in the frame of the base, rad.
        tilt: (T, n, 2) pitch and roll, rad.
        height: of the laser above the floor, m.
    """
    falls = np.sin(tilt[..., 0]) * np.cos(bearing) + np.sin(tilt[..., 1]) * np.sin(bearing)
    with np.errstate(divide="ignore"):
        floor = np.where(falls > 0, height / falls, np.inf)
    nearer = floor < exact.range
    return Returns(
        np.where(nearer, floor, exact.range),
        np.where(nearer, np.int32(-1), exact.wall),
        np.where(nearer, np.int32(FLOOR), exact.mover),
    )


def find_blind_scans(
    seconds: Float, options: LaserOptions, rng: np.random.Generator
) -> NDArray[np.bool_]:
    """(T,) mask of the scans without any return.

    Args:
        seconds: (T,) times of the scans.
        options: number, place and duration of blind stretches; with a number, the recording is
            divided into as many equal parts, and one stretch begins at a random time of each.
        rng: not used without such a number.
    """
    length, count = float(seconds[-1] - seconds[0]), options.blind_stretches
    starts = [] if options.blind_at is None else [seconds[0] + options.blind_at * length]
    if count:
        room = max(0.0, length / count - options.blind_time)
        begins = np.arange(count) * (length / count)
        starts += (seconds[0] + begins + rng.uniform(0.0, room, count)).tolist()
    blind = np.zeros(len(seconds), bool)
    for start in starts:
        blind |= (seconds >= start) & (seconds < start + options.blind_time)
    return blind
