"""Late odometry: readings that were still old when a scan was taken.

A scan whose odometry is late seems to come after a short step, and the scans after it after long
ones, until odometry has caught up. The whole way in the whole time is that of the usual speed.
Scans that see the robot move correct such readings; those of a bare corridor do not.
"""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2

Float = NDArray[np.float64]

_MAX_STEPS = 4  # from the last reading in time to the next one in time
# m/s^2 and rad/s^2 that robots reach; m and rad from which a reading is late
_ACCELERATION, _ANGULAR_ACCELERATION = 2.0, 4.0
_MIN_OFF = 0.15
_MAX_SPEED_CHANGE = 0.5  # of the speed in between, from before to after the way
_SHORT = 1e-3  # s: scans at the same time do not show a speed
_MAX_LATE_SHARE = 0.02  # of the scans: where more seem late, their stamps are uneven


def interpolate_late_odometry(
    stamp_ns: NDArray[np.int64], T_odom_base: Float
) -> tuple[Float, NDArray[np.intp]]:
    """Odometry poses (T, 3, 3) with late ones interpolated between those around, and the late ones.

    Args:
        stamp_ns: (T,) of the scans.
        T_odom_base: (T, 3, 3).
    """
    out, late = T_odom_base.copy(), set[int]()
    seconds: Float = 1e-9 * (stamp_ns - stamp_ns[:1]).astype(np.float64)
    for n in range(2, _MAX_STEPS + 1):
        for first in _late_ways(seconds, out, n).tolist():
            between = range(first + 1, first + n)
            if not late.intersection(between):
                out[between] = _interpolate(seconds, out, first, n)
                late.update(between)
    if len(late) > max(_MAX_LATE_SHARE * len(out), 1.0):
        return T_odom_base, np.zeros(0, np.intp)
    return out, np.array(sorted(late), np.intp)


def _late_ways(seconds: Float, T_odom_base: Float, n: int) -> NDArray[np.intp]:
    """First scans of the ways of n steps within which odometry was late."""
    T = len(seconds)
    first = np.arange(1, T - n - 1)
    if len(first) == 0:
        return first
    dt = np.diff(seconds).clip(_SHORT)
    steps = se2.log(se2.inverse(T_odom_base[:-1]) @ T_odom_base[1:])
    before, after = (steps[at] / dt[at, None] for at in (first - 1, first + n))
    whole = se2.log(se2.inverse(T_odom_base[first]) @ T_odom_base[first + n])
    duration = (seconds[first + n] - seconds[first]).clip(_SHORT)
    speed = whole / duration[:, None]
    usual = 0.5 * (before + after)
    is_late = np.zeros(len(first), np.bool_)
    for axes, acceleration in (((0, 1), _ACCELERATION), ((2,), _ANGULAR_ACCELERATION)):
        some = list(axes)
        size = np.linalg.norm(usual[:, some], axis=1)
        is_steady = np.linalg.norm((before - after)[:, some], axis=1) < _MAX_SPEED_CHANGE * size
        is_steady &= (
            np.linalg.norm((speed - usual)[:, some], axis=1) < 0.5 * _MAX_SPEED_CHANGE * size
        )
        for k in range(1, n):
            since = (seconds[first + k] - seconds[first]).clip(0.0, duration)
            there = T_odom_base[first] @ se2.exp((since / duration)[:, None] * whole)
            off = se2.parameters(se2.inverse(there) @ T_odom_base[first + k])[:, some]
            allowed = np.maximum(_MIN_OFF, 0.5 * acceleration * since * (duration - since))
            # late, not early: behind on the way
            behind = -(off * usual[:, some]).sum(axis=1) > allowed * size
            is_late |= is_steady & behind
    return first[is_late]


def _interpolate(seconds: Float, T_odom_base: Float, first: int, n: int) -> Float:
    """(n - 1, 3, 3) poses between two scans at constant speed."""
    here, there = T_odom_base[first], T_odom_base[first + n]
    since = seconds[first + 1 : first + n] - seconds[first]
    share = since / (seconds[first + n] - seconds[first])
    out: Float = here @ se2.exp(share[:, None] * se2.log(se2.inverse(here) @ there))
    return out
