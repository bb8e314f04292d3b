"""Scans whose beams are taken one after the other, while robot and movers move."""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.sim import laser
from stillmap.sim.dynamics import Motion
from stillmap.sim.laser import Movers, Outlines, Returns
from stillmap.sim.options import LaserOptions

Float = NDArray[np.float64]
Index = NDArray[np.int64]

_MAX_GROUPS = 64  # of simultaneous beams per scan
_BLOCK = 1000  # groups of beams processed at once
_MAX_SIGMAS = 10.0  # of a range
_MAX_SPEED = 40.0  # m/s; anything faster has restarted its lane


@dataclass(frozen=True, eq=False)
class Sweep:
    """Times of the beams of a scan.

    Attributes:
        group: number of simultaneous beams; the last group may be smaller.
        seconds: (G,) after the scan's stamp, of each group.
    """

    group: int
    seconds: Float

    @classmethod
    def of(cls, options: LaserOptions) -> "Sweep":
        """The sweep of a laser: times proportional to the beam angles."""
        n = options.beams
        if options.sweep_time == 0:
            return cls(n, np.zeros(1))
        group = max(2, math.ceil(n / _MAX_GROUPS))
        first = np.arange(0, n, group)
        middle = (first + np.minimum(first + group, n) - 1) / 2
        angles = laser.compute_beam_angles(n, options.fov)
        share = middle * (angles[1] - angles[0]) / options.fov
        return cls(group, options.sweep_time * share)

    def beam_times(self, beams: int) -> NDArray[np.float32]:
        """(n,) seconds after the stamp, of each beam of a scan."""
        return np.repeat(self.seconds, self.group)[:beams].astype(np.float32)


def cast_sweeps(motion: Motion, walls: Float, T_base_sensor: Float, o: LaserOptions) -> Returns:
    """The nearest surface on every beam of every scan.

    Args:
        motion: of T scans.
        walls: (W, 4) segments in metres.
        T_base_sensor: (T, 3, 3) pose of the laser of each scan.
        o: the lasers.

    Returns:
        Beams in the order of the scan: from the last angle to the first if the laser is mounted
        upside down.
    """
    sweep, angles = Sweep.of(o), laser.compute_beam_angles(o.beams, o.fov)
    T, G = len(motion.robot), len(sweep.seconds)
    reach = o.max_range + _MAX_SIGMAS * o.range_noise
    # a group of beams is cast as a scan of its own, rotated to the angles of the first group
    turned, group = np.arange(G) * sweep.group * (angles[1] - angles[0]), angles[: sweep.group]
    order = slice(None)
    if o.upside_down != "no":
        turned, group, order = -turned, -group[::-1], slice(None, None, -1)
    block = max(1, _BLOCK // G)
    parts = []
    for first in range(0, T, block):
        scans = np.arange(first, min(first + block, T))
        now = Moment(motion, np.repeat(scans, G), np.tile(sweep.seconds, len(scans)))
        T_robot_sensor = np.repeat(T_base_sensor[scans], G, axis=0)
        poses = se2.parameters(se2.matrix(*now.interpolate(motion.robot).T) @ T_robot_sensor)
        poses[:, 2] += np.tile(turned, len(scans))
        part = laser.cast_beams(poses, group, walls, *now.interpolate_movers(), reach)
        parts.append(
            [values[:, order].reshape(-1, G * sweep.group)[:, : o.beams] for values in part]
        )
    return Returns(*(np.concatenate(values) for values in zip(*parts, strict=True)))


class Moment:
    """N times, `seconds` (N,) after the stamps of `scans` (N,), for interpolation of the motion.

    Motion is linear between scans, and extrapolated after the last one.
    """

    def __init__(self, motion: Motion, scans: Index, seconds: Float) -> None:
        self._motion = motion
        later = seconds / motion.period
        # no interpolation across the gaps where the robot is carried or pauses
        breaks = np.unique([0, motion.carried, motion.paused, len(motion.robot)])
        piece = np.searchsorted(breaks, scans, side="right")
        self._last = breaks[piece] - 1
        first, last = breaks[piece - 1], self._last - (later > 0)
        self._scan, self._leap = scans, _MAX_SPEED * motion.period
        self._before = np.maximum(np.minimum(scans + later.astype(np.int64), last), first)
        self._share = scans + later - self._before

    def interpolate_movers(self) -> tuple[Movers, Outlines]:
        """Cross sections and faces of the movers."""
        people, outlines, things = self._motion.people, self._motion.outlines, self._motion.things
        xy, heading = self.interpolate(people.xy), self.interpolate(people.heading)
        # movable objects jump from place to place
        faces = np.concatenate([self.interpolate(outlines.faces), things.faces[self._scan]], axis=1)
        return (
            Movers(xy, heading, people.semi_axes, people.mover),
            Outlines(faces, np.concatenate([outlines.mover, things.mover])),
        )

    def interpolate(self, values: Float) -> Float:
        """(N, ...) values interpolated from those of all scans (T, ...)."""
        before = values[self._before]
        change = values[np.minimum(self._before + 1, self._last)] - before
        share = self._share.reshape(-1, *[1] * (values.ndim - 1))
        leaps = np.abs(change) > self._leap
        return np.where(leaps, values[self._scan], before + share * change)
