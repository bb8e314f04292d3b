"""Poses in space from sweeps of spinning lidars, one after the other, and during each.

Single sweeps of a recording in space: in the frame of the base, thinned out.
"""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.config import option
from stillmap.core.recording import Recording
from stillmap.slam import constant_velocity
from stillmap.slam.constant_velocity import State
from stillmap.slam.motion_model import MotionOptions

Float = NDArray[np.float64]

Points = NDArray[np.float32]

_COARSER = 1.25  # times the edge of cells, where too many points are left


@dataclass(frozen=True, eq=False)
class Sweep:
    """Hits of a sweep that weigh something.

    Attributes:
        points: (N, 3) float32, metres in the frame of the base at the time of each.
        weights: (N,) float32, e: how probable it is that each was static.
        times: (N,) float32, seconds from the stamp.
    """

    points: Points
    weights: NDArray[np.float32]
    times: NDArray[np.float32]

    def part(self, kept: NDArray[np.int64]) -> "Sweep":
        """Some of them."""
        return Sweep(self.points[kept], self.weights[kept], self.times[kept])

    def at_its_stamp(self, twist: Float) -> Points:
        """(N, 3) float32 as seen from where the base was at the stamp, moving by a twist (6,)."""
        return np.asarray(_core.transform_by_twist(self.points, self.times, twist))


def select_sweep(
    recording: Recording, e: NDArray[np.float32], t: int, reach: float, edge: float
) -> Sweep:
    """Sweep t within `reach` metres, the first of its hits in each cell of `edge` metres.

    Args:
        recording: 3D.
        e: (M,) probability that each beam was reflected by something static.
    """
    beams = recording.beams_of(t)
    points = np.asarray(recording.points[beams])
    with np.errstate(invalid="ignore"):
        near = np.einsum("ni,ni->n", points, points) <= reach * reach
    weights = np.where(recording.hit[beams] & near, e[beams], np.float32(0.0))
    kept = _core.voxel_downsample(points, weights, edge)
    T = recording.T_base_sensor[recording.sensor[t]]
    in_base = (points[kept] @ T[:3, :3].T + T[:3, 3]).astype(np.float32)
    times = recording.beam_time
    seconds = np.zeros(len(kept), np.float32) if times is None else np.asarray(times[beams])[kept]
    return Sweep(np.ascontiguousarray(in_base), weights[kept], seconds)


def downsample_sweep(sweep: Sweep, edge: float, most: int) -> Sweep:
    """The first point in each cell of `edge` metres, or of more where over `most` are left."""
    kept = _core.voxel_downsample(sweep.points, sweep.weights, edge)
    while len(kept) > most:
        edge *= _COARSER
        kept = _core.voxel_downsample(sweep.points, sweep.weights, edge)
    return sweep.part(kept)


# sweeps from which the motion at the start is found, how often, and how well it is known then
_FIRST, _ROUNDS, _FOUND = 5, 2, 0.5  # m/s and rad/s

_ARM = 10.0  # m, at which an error of the heading counts in how far off surfaces may be

_SHED = 0.1  # of the reach, after which the map is cut again


@dataclass(frozen=True)
class SpinningOptions:
    """Sweeps in space; `docs/registration3d.md` says what is minimised."""

    edge: float = option(0.4, "m, edge of the finest cells that surfaces are made from")
    levels: int = option(4, "sizes of cells, each twice the one before")
    enough: float = option(60.0, "beams that a cell takes in: what comes later has drifted")
    reach: float = option(100.0, "m from the robot to which the local map goes")
    thin_map: float = option(0.2, "m between the points of a sweep that go into the map")
    thin: float = option(0.35, "m between those that are registered, at least")
    most: int = option(4000, "points of a sweep that are registered, at most")
    least: float = option(5.0, "beams around a place that may be a surface, at least")
    flat: float = option(0.1, "variance across a surface against that along it, at most")
    wide: float = option(0.02, "square edges, variance along a surface, at least")
    sigma: float = option(0.03, "m, error of a beam besides the scatter of the surface")
    kernel: float = option(3.0, "standard deviations at which a beam counts a quarter")
    gain: float = option(0.5, "weight of one beam against the motion prior")
    acceleration: float = option(3.0, "m/s^2, how unsteady the motion is")
    turn_acceleration: float = option(3.0, "rad/s^2, likewise")
    first_speed: float = option(10.0, "m/s, standard deviation before anything is known")
    first_turn: float = option(1.0, "rad/s, likewise")
    max_iterations: int = option(30, "Gauss-Newton steps at most")
    tolerance: float = option(0.001, "m, and 10 rad, of the last step")

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'slam.spinning.{name}' wants {low:g} to {high:g}")


_LIMITS = (
    ("edge", 0.02, 10.0),
    ("levels", 1, 8),
    ("enough", 1.0, 1e9),
    ("reach", 1.0, 1000.0),
    ("thin_map", 0.01, 10.0),
    ("thin", 0.01, 10.0),
    ("most", 100, 10_000_000),
    ("least", 3.0, 1e9),
    ("flat", 1e-4, 1.0),
    ("wide", 0.0, 1.0),
    ("sigma", 1e-3, 1.0),
    ("kernel", 0.5, 100.0),
    ("gain", 1e-6, 1e3),
    ("acceleration", 1e-3, 1e3),
    ("turn_acceleration", 1e-3, 1e3),
    ("first_speed", 1e-3, 1e3),
    ("first_turn", 1e-3, 1e3),
    ("max_iterations", 1, 1000),
    ("tolerance", 1e-6, 1.0),
)


@dataclass(frozen=True, eq=False)
class LidarOdometry:
    """Poses in space.

    Attributes:
        poses: (T, 4, 4) T_map_base at the stamps; the map frame is the first sweep's base.
        twists: (T, 6) m/s and rad/s in the frame of the base, during each sweep.
        covariance: (T, 6, 6) of the poses against the local map: translation, and rotation about
            the base, along the axes of the map.
        explained: (T,) share of each sweep's points that lie on surfaces of the local map.
    """

    poses: Float
    twists: Float
    covariance: Float
    explained: Float


def register_sweeps(
    recording: Recording,
    e: NDArray[np.float32],
    options: SpinningOptions,
    odometry: MotionOptions,
    progress: Callable[[int, int], None],
    threads: int,
) -> LidarOdometry:
    """Every sweep registered on the map of those before it, and then added to it.

    The first sweeps are gone through three times: before it is known how the robot moved during
    the first one, that one is bent, and all later ones would be bent to match it.

    Args:
        recording: 3D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SpinningOptions.
        odometry: how sure odometry is, where there is some.
        progress: called with the number of sweeps done and their total.
        threads: the result does not depend on it.

    Raises:
        ValueError: the recording is not in space.
    """
    if recording.dimension != 3:
        raise ValueError("recording: expected one in three dimensions")
    if recording.n_scans == 0:
        none = np.zeros((0, 6, 6))
        return LidarOdometry(np.zeros((0, 4, 4)), none[:, 0], none, np.zeros(0))
    start = constant_velocity.initial_state(np.zeros(6), options.first_speed, options.first_turn)
    drive = _Drive(recording, e, options, odometry, threads)
    for _ in range(_ROUNDS if recording.n_scans > 1 else 0):
        found = drive.followed(start, min(_FIRST, recording.n_scans), _silent)
        start = constant_velocity.initial_state(
            _first_twist(recording, found.poses), _FOUND, _FOUND
        )
    return drive.followed(start, recording.n_scans, progress)


def _silent(done: int, total: int) -> None:
    """Reports progress to nobody."""


def _first_twist(recording: Recording, poses: Float) -> Float:
    """(6,) steady motion from the first of poses (n, 4, 4) to the second one that is later."""
    seconds = 1e-9 * (recording.stamp_ns[: len(poses)] - recording.stamp_ns[0])
    later = np.flatnonzero(seconds > 0.0)
    if not len(later):
        return np.zeros(6)
    n = int(later[:2][-1])  # to the first one it would be as uncertain again
    twist: Float = se3.log(se2.inverse(poses[0]) @ poses[n]) / seconds[n]
    return twist


@dataclass(frozen=True, eq=False)
class _Drive:
    """What stays the same from sweep to sweep; `build` says what it is."""

    recording: Recording
    e: NDArray[np.float32]
    options: SpinningOptions
    odometry: MotionOptions
    threads: int

    def followed(self, state: State, n: int, progress: Callable[[int, int], None]) -> LidarOdometry:
        """The first n sweeps, from a state at the first one."""
        options, recording = self.options, self.recording
        local = _core.NdtMap3D(options.edge, options.levels, options.enough)
        poses, twists = np.tile(np.eye(4), (n, 1, 1)), np.zeros((n, 6))
        covariance, explained = np.zeros((n, 6, 6)), np.ones(n)
        shed = state.T_map_base[:3, 3]
        for t in recording.iter_scans(range(n), self.e):
            sweep = select_sweep(recording, self.e, t, options.reach, options.thin_map)
            if t:
                few = downsample_sweep(sweep, options.thin, options.most)
                state, explained[t] = register_sweep(
                    local, few, self._prior(state, t), options, self.threads
                )
            poses[t], twists[t] = state.T_map_base, state.twist
            covariance[t] = along_map(state)
            local.add(sweep.at_its_stamp(state.twist), sweep.weights, state.T_map_base)
            if np.linalg.norm(poses[t, :3, 3] - shed) > _SHED * options.reach:
                shed = poses[t, :3, 3].copy()
                local.crop(poses[t], options.reach)
            progress(t + 1, n)
        return LidarOdometry(poses, twists, covariance, explained)

    def _prior(self, state: State, t: int) -> State:
        """Where sweep t ought to be."""
        recording, options = self.recording, self.options
        seconds = 1e-9 * float(recording.stamp_ns[t] - recording.stamp_ns[t - 1])
        if recording.T_odom_base is not None:
            before, after = recording.T_odom_base[t - 1 : t + 1]
            state = constant_velocity.update_with_odometry(
                state, se2.inverse(before) @ after, seconds, self.odometry
            )
        return constant_velocity.predict(
            state, seconds, options.acceleration, options.turn_acceleration
        )


def register_sweep(
    local: _core.NdtMap3D, sweep: Sweep, prior: State, options: SpinningOptions, threads: int
) -> tuple[State, float]:
    """A sweep laid on a map: the state at its stamp, and the share of it that lies on surfaces."""
    slack = how_far_off(prior.covariance)
    information: Float = np.linalg.inv(prior.covariance).astype(np.float64)
    level = int(np.clip(np.ceil(np.log2(slack / options.edge)), 0, options.levels - 1))
    T, twist, covariance, met, _, all_, _ = _core.register_sweep(
        local,
        sweep.points,
        sweep.weights,
        sweep.times,
        prior.T_map_base,
        prior.twist,
        information,
        min_weight=options.least,
        max_flatness=options.flat,
        min_extent=options.wide,
        range_std=options.sigma,
        kernel_width=options.kernel,
        information_scale=options.gain,
        start_level=level,
        start_slack=slack,
        max_iterations=options.max_iterations,
        tolerance=options.tolerance,
        threads=threads,
    )
    return State(T, twist, covariance), met / max(all_, 1e-9)


def how_far_off(covariance: Float) -> float:
    """Metres that a sweep may be off surfaces, by the covariance (12, 12) of its prior."""
    place, turn = (np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1] for i in (0, 3))
    return float(np.sqrt(max(place, 1e-12)) + _ARM * np.sqrt(max(turn, 0.0)))


def along_map(state: State) -> Float:
    """(6, 6) covariance of the pose along the axes of the map."""
    turn = np.kron(np.eye(2), state.T_map_base[:3, :3])
    out: Float = turn @ state.covariance[:6, :6] @ turn.T
    return out
