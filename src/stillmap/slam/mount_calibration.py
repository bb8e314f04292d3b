"""Hand-eye calibration of laser mounts and odometry errors from the motion of the recording.

Scan matching without odometry estimates the motion in a few short segments. Where it differs from
odometry by more than the motion model allows, more segments are matched. Parameters that differ
significantly there are calibrated; the others keep their nominal values.
"""

import dataclasses
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.slam.hand_eye import (
    GAIN,
    SCALE,
    Fit,
    HandEye,
    difference,
    kind,
    laser_names,
    nominal_values,
)
from stillmap.slam.latency import fit_latency, shift_odometry
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import thin_scans
from stillmap.slam.scan_motion import MotionWindows, measure_motion, select_segments

YAW, POSITION, UPSIDE_DOWN, LATENCY = "theta", ("x", "y"), "upside_down", "latency"

# least differences that are applied: less is within the motion model's own uncertainty; less of a
# laser's position matters no more than whether poses are those of the laser or of the robot's
# centre. rad, m (both coordinates together), shares, s
_MIN_DIFFERENCE = {"theta": 0.05, "x": 0.15, "y": 0.15, SCALE: 0.05, GAIN: 0.06, LATENCY: 0.1}
_STDS = 5.0  # standard deviations that are significant
# of each laser: at first, of short recordings less, and where something is found
_FIRST_WINDOWS, _LEAST_WINDOWS, _MORE_WINDOWS = 40, 24, 100
_SCANS_PER_WINDOW = 20  # of the recording, from which on fewer are measured at first
_MIN_WINDOWS = 12  # less motion says nothing
_SUSPICIOUS = 0.8  # of these differences: more windows are measured
_MIN_GAIN = 20.0  # nats by which a calibration, or mirrored scans, must agree better in all
# segments in which a calibration must gain so many nats, and the sum of all gains over all losses
_MIN_SEGMENTS, _CLEAR_GAIN, _MIN_RATIO = 3, 1.0, 3.0
_SAME_SENSE = 0.5  # correlation of the turns of laser and odometry: the right way up
_MAX_LASERS = 4  # more: a laser that moves on its robot has a pose for each scan
_LIMITS = {SCALE: (0.4, 2.5), GAIN: (0.4, 2.5)}  # beyond, odometry says nothing of this robot
_MAX_POSITION = 3.0  # m on a robot
_P_STATIC = 0.7  # of every beam: labels are not known yet


@dataclass(frozen=True)
class Parameter:
    """One quantity that was calibrated.

    Attributes:
        nominal: as recorded.
        value: as estimated.
        std: standard deviation.
        significant: whether the difference is certain and large enough to matter.
    """

    nominal: float
    value: float
    std: float
    significant: bool

    @property
    def applied(self) -> float:
        """The value to use."""
        return self.value if self.significant else self.nominal


@dataclass(frozen=True)
class Calibration(ShortRepr):
    """Poses of lasers and errors of odometry.

    Attributes:
        lasers: of each laser its `theta` (rad), `x`, `y` (m).
        upside_down: of each laser whether its scans have to be mirrored.
        odometry: `scale` and `rotation_gain`, recorded over true, and `latency` in s; what the
            recording does not show is missing, here and in `lasers`.
        windows: motions that were compared.
    """

    lasers: list[dict[str, Parameter]] = field(default_factory=list)
    upside_down: list[bool] = field(default_factory=list)
    odometry: dict[str, Parameter] = field(default_factory=dict)
    windows: int = 0


def calibrate_mounts(
    recording: Recording, resolution: float, given: Sequence[Collection[str]] = ()
) -> Calibration:
    """Compares the motions of the lasers with odometry's.

    Args:
        recording: 2D; without odometry, or of a laser that moves on its robot, nothing is found.
        resolution: m, edge of a map cell.
        given: of each laser the parameters that are given, of "theta", "x", "y" and "upside_down".
    """
    lasers = len(recording.T_base_sensor)
    if recording.dimension != 2 or recording.T_odom_base is None or lasers > _MAX_LASERS:
        return Calibration()
    recording, _ = thin_scans(recording, recording.hit)
    latency = _calibrate_latency(recording, resolution)
    recording = shift_odometry(recording, latency.applied)
    given = list(given) or [()] * lasers
    windows = max(_LEAST_WINDOWS, min(_FIRST_WINDOWS, recording.n_scans // _SCANS_PER_WINDOW))
    calibration = _Calibrator(recording, resolution, given, windows).calibrate()
    if _is_suspicious(calibration):
        calibration = _Calibrator(recording, resolution, given, _MORE_WINDOWS).calibrate()
    if np.isfinite(latency.std):
        calibration.odometry[LATENCY] = latency
    return calibration


def _calibrate_latency(recording: Recording, resolution: float) -> Parameter:
    fit = fit_latency(recording, _P_STATIC, SlamOptions(resolution=resolution))
    least = max(_MIN_DIFFERENCE[LATENCY], _STDS * fit.std)
    return Parameter(0.0, fit.latency, fit.std, abs(fit.latency) > least and fit.gain > _MIN_GAIN)


def _is_suspicious(found: Calibration) -> bool:
    """True if differences beyond two standard deviations are nearly as large as those applied."""
    named = [*found.odometry.items()] + [item for laser in found.lasers for item in laser.items()]
    for name, fitted in named:
        off = abs(difference(name, fitted.value, fitted.nominal))
        if off > 2.0 * fitted.std and off / _MIN_DIFFERENCE[name] > _SUSPICIOUS:
            return True
    return any(found.upside_down)


class _Calibrator:
    """One calibration from about so many motion windows of each laser."""

    def __init__(
        self,
        recording: Recording,
        resolution: float,
        given: Sequence[Collection[str]],
        windows: int,
    ) -> None:
        assert recording.T_odom_base is not None
        self.given, self.odometry = given, recording.T_odom_base
        lasers = len(recording.T_base_sensor)
        centred = dataclasses.replace(recording, T_base_sensor=np.tile(np.eye(3), (lasers, 1, 1)))
        e = recording.allocate_per_beam(np.float32)
        e[:] = _P_STATIC
        self.windows = [
            measure_motion(centred, e, select_segments(recording, k, windows), resolution)
            for k in range(lasers)
        ]
        self.nominal = nominal_values(recording)
        self.count = sum(len(one.first) for one in self.windows)

    def calibrate(self) -> Calibration:
        """Which way up, then all else; what is not significant stays nominal."""
        if min(len(one.first) for one in self.windows) < _MIN_WINDOWS:
            return Calibration(windows=self.count)
        T = self.odometry
        upside_down = [self._is_upside_down(k, T) for k in range(len(self.windows))]
        problem = HandEye(self.windows, upside_down, T, self.nominal)
        free = [name for k in range(len(self.windows)) for name in self._free_names(k)]
        everything = problem.fit_globally([*free, SCALE, GAIN])
        kept, final = self._select(problem, everything)
        parameters = {}
        for name in everything.std:
            fit = final if name in kept else everything
            parameters[name] = Parameter(
                self.nominal[name], fit.values[name], fit.std[name], name in kept
            )
        odometry = {name: parameters[name] for name in (SCALE, GAIN)}
        lasers = [
            {kind(name): parameters[name] for name in self._free_names(k)}
            for k in range(len(self.windows))
        ]
        return Calibration(lasers, upside_down, odometry, self.count)

    def _free_names(self, laser: int) -> list[str]:
        return [name for name in laser_names(laser) if kind(name) not in self.given[laser]]

    def _is_upside_down(self, k: int, T: Float) -> bool:
        """True if a laser's motion agrees with odometry's only if its scans are mirrored."""
        if UPSIDE_DOWN in self.given[k]:
            return False
        one, costs = self.windows[k], []
        turns = se2.parameters(se2.inverse(T[one.first]) @ T[one.last])[:, 2], one.motion[:, 2]
        if turns[0] @ turns[1] > _SAME_SENSE * np.linalg.norm(turns[0]) * np.linalg.norm(turns[1]):
            return False  # spares two fits
        nominal = {SCALE: 1.0, GAIN: 1.0}
        for name, of_laser in zip(laser_names(0), laser_names(k), strict=True):
            nominal[name] = self.nominal[of_laser]
        free = [name for name in laser_names(0) if kind(name) not in self.given[k]]
        for mirrored in (False, True):
            problem = HandEye([one], [mirrored], T, nominal)
            fit = problem.fit_globally([*free, SCALE, GAIN])
            costs.append(np.bincount(one.segment, fit.cost))
        return _is_clear(costs[0] - costs[1])

    def _select(self, problem: HandEye, everything: Fit) -> tuple[list[str], Fit]:
        """The significant parameters, fitted with all others at their nominal values."""
        kept, fit = list(everything.std), everything
        while (significant := self._significant(fit, kept)) != kept:
            kept = significant
            start = {n: fit.values[n] if n in kept else v for n, v in self.nominal.items()}
            fit = problem.fit(start, kept)
        return (kept, fit) if self._is_better(problem, fit, kept) else ([], fit)

    def _significant(self, fit: Fit, names: Sequence[str]) -> list[str]:
        out = []
        for name in names:
            pair = [name]
            if kind(name) in POSITION:  # one vector
                pair = [n for n in (f"x{name[1:]}", f"y{name[1:]}") if n in names]
            d = np.array([difference(n, fit.values[n], self.nominal[n]) for n in pair])
            std = np.array([fit.std[n] for n in pair])
            least = _MIN_DIFFERENCE[kind(name)]
            if (
                float(np.linalg.norm(d)) > least > float(std.max())
                and float(np.linalg.norm(d / std)) > _STDS
            ):
                out.append(name)
        return out

    def _is_better(self, problem: HandEye, fit: Fit, kept: Sequence[str]) -> bool:
        """True if it is plausible, and segments agree better that it was not fitted to."""
        for name, (low, high) in _LIMITS.items():
            if not low < fit.values[name] < high:
                return False
        if any(abs(fit.values[n]) > _MAX_POSITION for n in kept if kind(n) in POSITION):
            return False
        nominal, gain = problem.fit(self.nominal, []), np.zeros(int(problem.segment.max()) + 1)
        for side in (0, 1):
            use = problem.segment % 2 == side
            half = problem.fit(fit.values, kept, use)
            gain += np.bincount(problem.segment, (nominal.cost - half.cost) * ~use)
        return _is_clear(gain)


def _is_clear(gain: NDArray[Any]) -> bool:
    """True if gains (S,) of segments, in nats, are evidence: in sum, in several, against few."""
    loss = -float(gain.sum(where=gain < 0.0))
    return bool(
        gain.sum() > _MIN_GAIN
        and np.count_nonzero(gain > _CLEAR_GAIN) >= _MIN_SEGMENTS
        and gain.sum() + loss > _MIN_RATIO * loss
    )


_WINDOW = 0.3  # m or rad of motion
_WINDOWS_PER_SEGMENT = 5  # whose residuals may depend on each other
_STD = (0.005, 0.005, 0.002)  # m, m, rad of a motion, before the residuals scale them


def refine_positions(recording: Recording, poses: Float, found: Calibration) -> Calibration:
    """The calibration with the positions that were applied fitted to registered poses.

    Args:
        recording: 2D, as calibrated, with odometry.
        poses: (T, 3, 3) T_map_base of the recording.
        found: its calibration; other parameters stay as they are.
    """
    nominal = nominal_values(recording)
    free = [
        f"{name}{k}"
        for k, laser in enumerate(found.lasers)
        for name in POSITION
        if name in laser and laser[name].significant
    ]
    if not free:
        return found
    assert recording.T_odom_base is not None
    windows = [_windows(recording, poses, k) for k in range(len(found.lasers))]
    problem = HandEye(windows, [False] * len(windows), recording.T_odom_base, nominal)
    fit = problem.fit(nominal, [*free, SCALE, GAIN])
    lasers = [dict(laser) for laser in found.lasers]
    for fitted in free:
        laser, name = lasers[int(fitted[1:])], fitted[0]
        value, std = fit.values[fitted], fit.std[fitted]
        laser[name] = dataclasses.replace(laser[name], value=value, std=std)
    return dataclasses.replace(found, lasers=lasers)


def _windows(recording: Recording, poses: Float, laser: int) -> MotionWindows:
    """Motions of a laser between scans that odometry has so far apart."""
    assert recording.T_odom_base is not None
    scans = np.flatnonzero(recording.sensor == laser)
    odometry = recording.T_odom_base[scans]
    x, y, turn = np.abs(se2.parameters(se2.increments(odometry))).T
    ends, since = [0], 0.0
    for k, step in enumerate((np.hypot(x, y) + turn).tolist(), start=1):
        since += step
        if since >= _WINDOW:
            ends.append(k)
            since = 0.0
    first, last = scans[ends[:-1]], scans[ends[1:]]
    T = poses @ recording.T_base_sensor[laser]
    return MotionWindows(
        first,
        last,
        np.arange(len(first)) // _WINDOWS_PER_SEGMENT,
        se2.parameters(se2.inverse(T[first]) @ T[last]),
        np.tile(np.diag(np.square(_STD)), (len(first), 1, 1)),
    )
