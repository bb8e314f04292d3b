"""Faults of odometry: wheel slip, and stretches in which it and scan matching differ.

Between two walls a scan fits well enough where odometry leaves it. While odometry stands still, a
second hypothesis therefore follows the robot at constant velocity, and its gain in log likelihood
is summed over the scans.

Each scan may leave odometry by a little, and people who walk along with the robot look like walls
beside one that is slower: over a stretch the small differences add up. Which of the two is right is
for the caller to decide.
"""

import dataclasses
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.array_types import Bool, Float, Int64
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.options import OdometryOptions
from stillmap.slam.scan_hits import Scan
from stillmap.slam.scan_matching import ODOMETRY_FAULT, ScanMatch
from stillmap.slam.types import Diagnostics

_MIN_STEP = 0.02  # m and rad between scans: a slower robot may as well have stopped
_STILL_RATIO = 0.2  # of the predicted step: shorter odometry steps count as standing still
_MAX_SCANS = 500  # of one hypothesis


class Increments(Protocol):
    """Increments of odometry by the index of the scan before."""

    def __getitem__(self, index: int, /) -> Float:
        """(3, 3)."""


@dataclass(frozen=True, eq=False)
class SlipHypothesis:
    """The robot at constant velocity while odometry stands still.

    Attributes:
        first: scan at which odometry stopped.
        before: (3, 3) T_map_base of the scan before it.
        matches: of each scan from the first on.
        gain: nats by which they fit better than the poses by odometry.
    """

    first: int
    before: Float
    matches: list[ScanMatch]
    gain: float


class SlipDetector:
    """Tests for wheel slip scan by scan.

    Args:
        increments: (T - 1, 3, 3) of odometry, or what gives one for each index; None: no odometry,
            no slip.
    """

    def __init__(self, increments: "Float | Increments | None") -> None:
        self._increments = increments
        self.reset()

    def reset(self) -> None:
        """Discards the past motion, after the robot was carried elsewhere."""
        self._is_slipping = False
        self._hypothesis: SlipHypothesis | None = None

    def is_slipping(self, t: int, last: Float, guess: MotionPrior) -> bool:
        """True if a detected slip still holds on the way to scan t.

        Args:
            t: the scan.
            last: (3, 3) T_map_base of the scan before.
            guess: constant-velocity prior of scan t.
        """
        if self._is_slipping:  # a robot that pauses does not make its odometry valid again
            step = max(_step_size(se2.inverse(last) @ guess.T_map_base), _MIN_STEP)
            self._is_slipping = self._odometry_step(t) < _STILL_RATIO * step
        return self._is_slipping

    def detect(
        self,
        t: int,
        last: Float,
        guess: MotionPrior,
        grid: _core.OccupancyGrid2D,
        scan: Scan,
        match: ScanMatch,
    ) -> SlipHypothesis | None:
        """The slip hypothesis, at the scan that confirms it.

        Args:
            t, last, guess: as of `is_slipping`.
            grid: the local map.
            scan: scan t.
            match: its match by the prior, which is odometry unless that is implausible.
        """
        if self._is_slipping:
            return None
        onward = self._predict(t, last, guess) if len(scan.points) else None
        if onward is None:
            self._hypothesis = None
        else:
            moved = scan_matching.refine_pose(grid, scan, onward, onward.T_map_base)
            self._extend(t, last, moved, match.cost - moved.cost)
        if self._hypothesis is not None and self._hypothesis.gain > ODOMETRY_FAULT:
            confirmed, self._hypothesis, self._is_slipping = self._hypothesis, None, True
            return confirmed
        # rotation shows at once
        self._is_slipping = match.contradicts_odometry and self.stands_still(
            t, last, match.T_map_base
        )
        if self._is_slipping:
            self._hypothesis = None
        return None

    def _predict(self, t: int, last: Float, guess: MotionPrior) -> MotionPrior | None:
        """Prior of scan t at constant velocity; None if odometry moves or velocity is unknown."""
        hypothesis = self._hypothesis
        if hypothesis is not None:
            if len(hypothesis.matches) == _MAX_SCANS:
                return None
            recent = (m.T_map_base for m in hypothesis.matches[-2:])
            before, last = [hypothesis.before, *recent][-2:]
            ahead = last @ se2.inverse(before) @ last
            guess = motion_model.gaussian_prior(ahead, guess.translation_std, guess.rotation_std)
        elif guess.translation_std > _step_size(se2.inverse(last) @ guess.T_map_base):
            return None
        return guess if self.stands_still(t, last, guess.T_map_base) else None

    def _extend(self, t: int, last: Float, moved: ScanMatch, gain: float) -> None:
        """Adds the match of scan t to the hypothesis, or rejects it where the robot stopped."""
        hypothesis = self._hypothesis or SlipHypothesis(t, last, [], 0.0)
        gain += hypothesis.gain
        hypothesis.matches.append(moved)
        has_stopped = gain < -ODOMETRY_FAULT
        self._hypothesis = None if has_stopped else dataclasses.replace(hypothesis, gain=gain)

    def stands_still(self, t: int, last: Float, T_map_base: Float) -> bool:
        """True if odometry stands still on the way to scan t at a pose (3, 3) that moved."""
        step = _step_size(se2.inverse(last) @ T_map_base)
        return step > _MIN_STEP and self._odometry_step(t) < _STILL_RATIO * step

    def _odometry_step(self, t: int) -> float:
        """Size of the odometry step to scan t."""
        return np.inf if self._increments is None else _step_size(self._increments[t - 1])


def _step_size(increment: Float) -> float:
    x, y, theta = se2.parameters(increment)
    return float(np.hypot(x, y) + abs(theta))


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
    motion = se2.inverse(poses[:-1]) @ poses[1:]
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
