"""Stretches in which scan matching and odometry differ over most of the way.

Each scan may leave odometry by a little, and people who walk along with the robot look like walls
at rest beside it: over a stretch the small differences add up. Which of the two is right is for the
caller to decide.
"""

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.slam import motion_model
from stillmap.slam.types import Diagnostics

Float = NDArray[np.float64]
Mask = NDArray[np.bool_]

_SECONDS = 4.0  # of a window in which differences are summed
# difference that counts: m, and share of the way in the window, by the longer of the two
_MIN_DIFFERENCE, _MIN_SHARE = 0.3, 0.5
_MAX_FAULT_SHARE = 0.25  # of the scans of a stretch: scan matching has weighed these faults itself


def replace_stretches(
    poses: Float, T_odom_base: Float, stamp_ns: NDArray[np.int64], diagnostics: Diagnostics
) -> Float | None:
    """Poses with the motion of odometry in the stretches in which both differ.

    Args:
        poses: (T, 3, 3) estimated T_map_base.
        T_odom_base: (T, 3, 3) odometry.
        stamp_ns: (T,) stamps.
        diagnostics: of the estimate. Stretches with a break, a leap of odometry, or many scans
            at which scan matching rejected odometry stay as they are.

    Returns:
        (T, 3, 3) poses; None where there is no such stretch.
    """
    measured = motion_model.compute_odometry_steps(T_odom_base)
    motion = se2.inverse(poses[:-1]) @ poses[1:]
    differs = find_differences(motion, measured.increments, stamp_ns)
    by_odometry = _drop_decided(differs, measured.plausible, diagnostics)
    if not by_odometry.any():
        return None
    out = np.array(poses)
    for t in range(int(np.argmax(by_odometry)) + 1, len(out)):
        step = measured.increments[t - 1] if by_odometry[t - 1] else motion[t - 1]
        out[t] = out[t - 1] @ step
    return se2.normalize(out)


def find_differences(motion: Float, increments: Float, stamp_ns: NDArray[np.int64]) -> Mask:
    """(T - 1,) steps in windows over which a motion and odometry differ by most of the way.

    Args:
        motion, increments: (T - 1, 3, 3) steps by scan matching and by odometry. Differences are
            summed in the frame of the robot, where an error of the heading has no lever.
        stamp_ns: (T,) stamps.
    """
    x, u = se2.parameters(motion), se2.parameters(increments)
    difference = np.concatenate([np.zeros((1, 2)), np.cumsum(x[:, :2] - u[:, :2], axis=0)])
    way = np.concatenate(
        [np.zeros((1, 2)), np.cumsum(np.stack([_length(x), _length(u)], axis=1), axis=0)]
    )
    seconds = 1e-9 * (stamp_ns - stamp_ns[0])
    first = np.arange(len(stamp_ns))
    last = np.minimum(np.searchsorted(seconds, seconds + _SECONDS), len(stamp_ns) - 1)
    summed = np.linalg.norm(difference[last] - difference[first], axis=1)
    longest = (way[last] - way[first]).max(axis=1)
    is_much = (summed > _MIN_DIFFERENCE) & (summed > _MIN_SHARE * longest)
    marks = np.zeros(len(stamp_ns) + 1)
    np.add.at(marks, first[is_much], 1.0)
    np.add.at(marks, last[is_much], -1.0)
    return np.asarray(np.cumsum(marks)[: len(motion)] > 0.0)


def _drop_decided(differs: Mask, plausible: Mask, diagnostics: Diagnostics) -> Mask:
    """The steps (T - 1,) of the stretches about which nothing else decides."""
    at_fault, breaks = np.zeros((2, len(differs) + 1), np.bool_)
    at_fault[diagnostics.odometry_faults] = True
    breaks[diagnostics.breaks] = True
    edges = np.flatnonzero(np.diff(np.concatenate([[False], differs, [False]])))
    out = np.array(differs)
    for first, last in edges.reshape(-1, 2):
        scans = slice(first + 1, last + 1)
        is_decided = at_fault[scans].mean() > _MAX_FAULT_SHARE or breaks[scans].any()
        if is_decided or not plausible[first:last].all():
            out[first:last] = False
    return out


def _length(parameters: Float) -> Float:
    return np.hypot(parameters[:, 0], parameters[:, 1])
