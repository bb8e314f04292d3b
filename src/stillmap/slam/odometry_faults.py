"""Faults of odometry: stretches in which it and scan matching differ.

Each scan may leave odometry by a little, and people who walk along with the robot look like walls
beside one that is slower: over a stretch the small differences add up. Which of the two is right is
for the caller to decide.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Int64
from stillmap.slam import motion_model
from stillmap.slam.options import OdometryOptions
from stillmap.slam.types import Diagnostics

_SECONDS = (1.0, 2.0, 4.0)  # of the windows in which differences are summed
# a sum counts from so many standard deviations and m on; error of odometry per m that stays the
# same over a window
_MIN_STDS, _MIN_DIFFERENCE, _SCALE_ERROR = 6.0, 0.05, 0.02
_MAX_FAULT_SHARE = 0.25  # of the scans of a stretch: scan matching has weighed these faults itself
_MAX_SHARE = 0.5  # of the steps in such stretches: odometry that differs more often is no judge


def replace_stretches(
    poses: Float,
    T_odom_base: Float,
    stamp_ns: Int64,
    diagnostics: Diagnostics,
    options: OdometryOptions,
) -> Float | None:
    """Poses with the motion of odometry in the stretches in which both differ.

    Args:
        poses: (T, 3, 3) estimated T_map_base.
        T_odom_base: (T, 3, 3) odometry.
        stamp_ns: (T,) stamps.
        diagnostics: of the estimate. Stretches with a break, a leap of odometry, or many scans
            at which scan matching rejected odometry stay as they are.
        options: largest noise of odometry.

    Returns:
        (T, 3, 3) poses; None where there is no such stretch.
    """
    measured = motion_model.compute_odometry_steps(T_odom_base, stamp_ns)
    motion = se2.increments(poses)
    differs = find_differences(motion, measured.increments, stamp_ns, options)
    by_odometry = _exclude_known_faults(differs, measured.plausible, diagnostics)
    if not by_odometry.any() or by_odometry.mean() > _MAX_SHARE:
        return None
    out = np.array(poses)
    for t in range(int(np.argmax(by_odometry)) + 1, len(out)):
        step = measured.increments[t - 1] if by_odometry[t - 1] else motion[t - 1]
        out[t] = out[t - 1] @ step
    return se2.normalize(out)


def find_differences(
    motion: Float, increments: Float, stamp_ns: Int64, options: OdometryOptions
) -> Bool:
    """(T - 1,) steps in windows over which a motion and odometry differ by more than noise.

    The noise of odometry is learned from the differences of all steps.

    Args:
        motion, increments: (T - 1, 3, 3) steps by scan matching and by odometry. Differences are
            summed in the frame of the robot, where an error of the heading has no lever.
        stamp_ns: (T,) stamps.
        options: largest noise of odometry.
    """
    T = len(stamp_ns)
    if T < 3:
        return np.zeros(len(motion), np.bool_)
    u = se2.parameters(increments)
    noise, _ = motion_model.fit_odometry_noise(increments, motion, options)
    way = np.hypot(u[:, 0], u[:, 1])
    std, _ = motion_model.odometry_std(way, np.abs(u[:, 2]), options)
    difference = _accumulate(se2.parameters(motion)[:, :2] - u[:, :2])
    variance, way = _accumulate(np.square(noise.translation * std)), _accumulate(way)
    seconds, first = 1e-9 * (stamp_ns - stamp_ns[0]), np.arange(T)
    found = np.zeros(T - 1, np.bool_)
    for length in _SECONDS:
        last = np.minimum(np.searchsorted(seconds, seconds + length), T - 1)
        summed = np.linalg.norm(difference[last] - difference[first], axis=1)
        scale = _SCALE_ERROR * (way[last] - way[first])
        stds = np.sqrt(variance[last] - variance[first] + np.square(scale))
        is_much = (summed > _MIN_DIFFERENCE) & (summed > _MIN_STDS * stds)
        known = _accumulate(found)  # a longer window counts where no shorter one in it does
        is_much &= known[last] == known[first]
        marks = np.zeros(T)
        np.add.at(marks, first[is_much], 1.0)
        np.add.at(marks, last[is_much], -1.0)
        found |= np.cumsum(marks)[: T - 1] > 0.0
    return found


def _accumulate(steps: NDArray[Any]) -> Float:
    """Sums (T, ...) of steps (T - 1, ...) from the first scan on."""
    return np.concatenate([np.zeros((1, *steps.shape[1:])), np.cumsum(steps, axis=0)])


def _exclude_known_faults(differs: Bool, plausible: Bool, diagnostics: Diagnostics) -> Bool:
    """The steps (T - 1,) of the stretches without faults, breaks or leaps that were noticed."""
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
