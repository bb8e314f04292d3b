"""Stretches whose length the scans do not show, as along the bare walls of a corridor.

There a pose is where the motion model predicts it. Without odometry that is constant velocity, and
the velocity inherits the error of every pose, so that the errors of the steps add up.
"""

import math
from collections.abc import Iterable

import numpy as np

from stillmap.core.array_types import Float
from stillmap.slam.local_map import travelled_distance
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.types import BareStretch, LoopClosure

_VELOCITY_TIME = 5.0  # s after which a velocity that no scan corrected says nothing any more
_MIN_STEP_STD = 0.04  # m, from which a step is hardly measured
_MAX_GAP = 10  # scans that are measured within a stretch
_MIN_STD = 0.3  # m, of the length of a stretch, from which it is named


def unmeasured_variance(prior: MotionPrior, covariance: Float, seconds: float) -> float:
    """Variance in m^2 that a step adds to the length of the way, in its least known direction.

    The variance of the step times r^2, r the share of an error that the scan leaves (1 - gain of a
    Kalman filter). Without odometry the steps after it inherit what is left, in all
    r / (1 - lambda r), with lambda = exp(-seconds / _VELOCITY_TIME).

    Args:
        prior: of the step.
        covariance: (3, 3) of the posterior.
        seconds: of the step.
    """
    (xx, xy), (_, yy) = covariance[:2, :2].tolist()
    least_known = 0.5 * (xx + yy) + math.hypot(0.5 * (xx - yy), xy)  # the larger eigenvalue
    r = min(least_known / prior.translation_std**2, 1.0)
    if not prior.is_odometry:
        r /= 1.0 - math.exp(-max(seconds, 1e-3) / _VELOCITY_TIME) * r
    return float((prior.translation_std * r) ** 2)


def find_bare_stretches(
    variance: Float, poses: Float, breaks: Iterable[int] = ()
) -> list[BareStretch]:
    """Stretches of successive steps that are hardly measured, and that add up to a length unknown.

    Args:
        variance: (T,) m^2 of the step to each scan.
        poses: (T, 3, 3) T_map_base.
        breaks: scans at which a stretch ends.
    """
    steps = np.flatnonzero(variance > _MIN_STEP_STD**2)
    travelled = travelled_distance(poses)
    ends = np.flatnonzero(np.diff(steps) > _MAX_GAP) + 1
    found = []
    for part in np.split(steps, np.union1d(ends, np.searchsorted(steps, sorted(breaks)))):
        std = float(np.sqrt(variance[part].sum()))
        if std >= _MIN_STD:
            first, last = int(part[0]) - 1, int(part[-1])
            found.append(BareStretch(first, last, float(travelled[last] - travelled[first]), std))
    return found


def without_loops(
    stretches: Iterable[BareStretch], loops: Iterable[LoopClosure]
) -> list[BareStretch]:
    """The stretches that no accepted loop spans: one that does measures their length."""
    spans = [(loop.earlier, loop.later) for loop in loops if not loop.rejected]
    return [s for s in stretches if not any(i <= s.first and s.last <= j for i, j in spans)]
