"""Late odometry: readings older than the scans that they are attached to.

The step to a scan with a late reading is too short and the next ones are too long, until odometry
has caught up; the average speed over the whole interval is the usual one. Where scans show the
motion they correct such readings. Along a bare corridor they do not.
"""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2

Float = NDArray[np.float64]

_MAX_STEPS = 4  # of an interval from one timely reading to the next
_ACCELERATION, _ANGULAR_ACCELERATION = 2.0, 4.0  # m/s^2, rad/s^2 that robots reach
_MIN_LAG = 0.15  # m and rad behind constant speed from which a reading is late
# difference between the speeds before and after an interval, and twice that between their mean and
# the interval's, as shares of their mean
_MAX_SPEED_CHANGE = 0.5
_MIN_DURATION = 1e-3  # s: scans at the same time show no speed
_MAX_LATE_SHARE = 0.02  # of the scans: if more seem late, their stamps are uneven


def interpolate_late_odometry(
    stamp_ns: NDArray[np.int64], T_odom_base: Float
) -> tuple[Float, NDArray[np.intp]]:
    """Odometry (T, 3, 3) with late readings interpolated, and the scans (K,) that they belong to.

    Args:
        stamp_ns: (T,) of the scans.
        T_odom_base: (T, 3, 3).
    """
    out, late = T_odom_base.copy(), set[int]()
    seconds: Float = 1e-9 * (stamp_ns - stamp_ns[:1]).astype(np.float64)
    for n in range(2, _MAX_STEPS + 1):
        for first in _find_late_intervals(seconds, out, n).tolist():
            inside = range(first + 1, first + n)
            if not late.intersection(inside):
                out[inside] = _interpolate(seconds, out, first, n)
                late.update(inside)
    if len(late) > max(_MAX_LATE_SHARE * len(out), 1.0):
        return T_odom_base, np.zeros(0, np.intp)
    return out, np.array(sorted(late), np.intp)


def _find_late_intervals(seconds: Float, T_odom_base: Float, n: int) -> NDArray[np.intp]:
    """First scans of the intervals of n steps within which odometry is late."""
    first = np.arange(1, len(seconds) - n - 1)
    if len(first) == 0:
        return first
    dt = np.diff(seconds).clip(_MIN_DURATION)
    velocity = se2.log(se2.inverse(T_odom_base[:-1]) @ T_odom_base[1:]) / dt[:, None]
    before, after = velocity[first - 1], velocity[first + n]
    usual = 0.5 * (before + after)
    duration = (seconds[first + n] - seconds[first]).clip(_MIN_DURATION)
    motion = se2.log(se2.inverse(T_odom_base[first]) @ T_odom_base[first + n])
    excess = motion / duration[:, None] - usual
    is_late = np.zeros(len(first), np.bool_)
    for axes, acceleration in (([0, 1], _ACCELERATION), ([2], _ANGULAR_ACCELERATION)):
        speed, change, deviation = (
            np.linalg.norm(each[:, axes], axis=1) for each in (usual, after - before, 2.0 * excess)
        )
        is_steady = np.maximum(change, deviation) < _MAX_SPEED_CHANGE * speed
        for k in range(1, n):
            since = (seconds[first + k] - seconds[first]).clip(0.0, duration)
            expected = T_odom_base[first] @ se2.exp((since / duration)[:, None] * motion)
            off = se2.parameters(se2.inverse(expected) @ T_odom_base[first + k])[:, axes]
            lag = -(off * usual[:, axes]).sum(axis=1) / speed.clip(1e-9)
            is_late |= is_steady & (
                lag > np.maximum(_MIN_LAG, 0.5 * acceleration * since * (duration - since))
            )
    return first[is_late]


def _interpolate(seconds: Float, T_odom_base: Float, first: int, n: int) -> Float:
    """(n - 1, 3, 3) poses between two scans at constant speed."""
    here, there = T_odom_base[first], T_odom_base[first + n]
    since = seconds[first + 1 : first + n] - seconds[first]
    share = since / (seconds[first + n] - seconds[first])
    out: Float = here @ se2.exp(share[:, None] * se2.log(se2.inverse(here) @ there))
    return out
