"""Lidar odometry: sweeps of a spinning lidar registered one after the other to a local map.

Point-to-plane registration of pose and twist together, so that the motion during each sweep is
part of the estimate; what is minimized is in `docs/poses.md`.
"""

from dataclasses import dataclass

import numpy as np

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.array_types import Bool, Float, Float32, Int64
from stillmap.core.recording import Recording
from stillmap.slam import constant_velocity
from stillmap.slam.constant_velocity import State
from stillmap.slam.options import OdometryOptions
from stillmap.slam.types import ScanProgress

# map of plane cells: m, edge of the finest; levels, each of twice the edge; beams that a cell takes
# in, as later ones have drifted
_CELL, _LEVELS, _MAX_WEIGHT = 0.4, 4, 60.0
# planes: beams around a position; variance across against variance along; variance along in square
# edges
_MIN_WEIGHT, _MAX_FLATNESS, _MIN_EXTENT = 5.0, 0.1, 0.02
MAX_RANGE = 100.0  # m to which the local map is kept
CROP_STEP = 10.0  # m of travel after which the map is cropped again
_MAP_SPACING = 0.2  # m between the points of a sweep that enter the map
# points that are registered: m between them, their number, factor of the spacing while too many
_POINT_SPACING, _MAX_POINTS, _SPACING_FACTOR = 0.35, 4000, 1.25
# m, std of a beam besides that of the plane; std at which the kernel weighs a beam one quarter;
# weight of one beam against the motion prior
_RANGE_STD, _KERNEL_WIDTH, _INFORMATION_SCALE = 0.03, 3.0, 0.5
_MAX_ITERATIONS, _TOLERANCE = 30, 0.001  # Gauss-Newton: m and 10 rad of the last step
_INITIAL_SPEED, _INITIAL_TURN_RATE = 10.0, 1.0  # m/s, rad/s: std before anything is known
# initial motion: sweeps it is found from, repetitions, its std then in m/s and rad/s
_FIRST_SWEEPS, _FIRST_ROUNDS, _FIRST_STD = 5, 2, 0.5
_LEVER_ARM = 10.0  # m at which an error of the heading counts as distance to planes


@dataclass(frozen=True, eq=False)
class Sweep:
    """The weighted hits of a sweep.

    Attributes:
        points: (N, 3) float32, m, in the base frame at the time of each.
        weights: (N,) float32, e.
        times: (N,) float32, s from the stamp.
    """

    points: Float32
    weights: Float32
    times: Float32

    def select(self, kept: Int64) -> "Sweep":
        """The points of these indices."""
        return Sweep(self.points[kept], self.weights[kept], self.times[kept])

    def deskew(self, twist: Float) -> Float32:
        """(N, 3) float32 in the base frame at the stamp, given the twist (6,) of the base."""
        return np.asarray(_core.transform_by_twist(self.points, self.times, twist))


@dataclass(frozen=True, eq=False)
class LidarOdometry:
    """Poses of sweeps.

    Attributes:
        poses: (T, 4, 4) T_map_base at the stamps; the map frame is the base of the first sweep.
        twists: (T, 6) m/s and rad/s in the base frame during each sweep.
        covariance: (T, 6, 6) of the poses against the local map: translation, then rotation about
            the base, along the axes of the map.
        explained: (T,) share of each sweep's points that lie on planes of the local map.
    """

    poses: Float
    twists: Float
    covariance: Float
    explained: Float


def select_sweep(recording: Recording, e: Float32, t: int) -> Sweep:
    """Sweep t of a 3D recording within the range of the map: the first hit in each voxel.

    e: (M,) P(static) of every beam.
    """
    beams, times = recording.beams_of(t), recording.beam_time
    sweep, _ = make_sweep(
        np.asarray(recording.points[beams]),
        np.asarray(recording.hit[beams]),
        e[beams],
        None if times is None else np.asarray(times[beams]),
        recording.T_base_sensor[recording.sensor[t]],
    )
    return sweep


def make_sweep(
    points: Float32, hit: Bool, e: Float32, times: Float32 | None, T_base_sensor: Float
) -> tuple[Sweep, Int64]:
    """The first hit in each voxel within the range of the map, and the indices of these beams.

    Args:
        points: (N, 3) in the sensor frame.
        hit: (N,).
        e: (N,) P(static).
        times: (N,) s from the stamp; None: all beams have it.
        T_base_sensor: (4, 4).
    """
    with np.errstate(invalid="ignore"):
        near = np.einsum("ni,ni->n", points, points) <= MAX_RANGE * MAX_RANGE
    weights = np.where(hit & near, e, np.float32(0.0))
    kept = _core.voxel_downsample(points, weights, _MAP_SPACING)
    in_base = (points[kept] @ T_base_sensor[:3, :3].T + T_base_sensor[:3, 3]).astype(np.float32)
    seconds = np.zeros(len(kept), np.float32) if times is None else times[kept]
    return Sweep(np.ascontiguousarray(in_base), weights[kept], seconds), kept


def initial_state(twist: Float | None = None) -> State:
    """The state at the origin before the first sweep, with a twist (6,) if it is known."""
    if twist is None:
        return constant_velocity.initial_state(np.zeros(6), _INITIAL_SPEED, _INITIAL_TURN_RATE)
    return constant_velocity.initial_state(twist, _FIRST_STD, _FIRST_STD)


def downsample_sweep(sweep: Sweep, max_points: int = _MAX_POINTS) -> Sweep:
    """The points that are registered: one per voxel, of larger voxels where too many are left."""
    edge = _POINT_SPACING
    kept = _core.voxel_downsample(sweep.points, sweep.weights, edge)
    while len(kept) > max_points:
        edge *= _SPACING_FACTOR
        kept = _core.voxel_downsample(sweep.points, sweep.weights, edge)
    return sweep.select(kept)


def make_local_map(levels: int = _LEVELS) -> _core.NdtMap3D:
    """An empty map of plane cells."""
    return _core.NdtMap3D(_CELL, levels, _MAX_WEIGHT)


def register_sweeps(
    recording: Recording,
    e: Float32,
    options: OdometryOptions,
    progress: ScanProgress,
    threads: int,
    max_points: int = _MAX_POINTS,
) -> LidarOdometry:
    """Registers every sweep to the local map, then adds it.

    The first sweeps are registered three times: until the motion during the first one is known, it
    is distorted, and all later ones would be distorted to match it.

    Args:
        recording: 3D.
        e: (M,) P(static) of every beam.
        options: noise of odometry, where there is some.
        progress: called with the number of sweeps done and their total.
        threads: the result does not depend on it.
        max_points: of a sweep that are registered.

    Raises:
        ValueError: the recording is not 3D.
    """
    if recording.dimension != 3:
        raise ValueError("recording: expected three dimensions")
    T = recording.n_scans
    if T == 0:
        none = np.zeros((0, 6, 6))
        return LidarOdometry(np.zeros((0, 4, 4)), none[:, 0], none, np.zeros(0))
    start = initial_state()
    odometry = _SweepOdometry(recording, e, options, threads, max_points)
    for _ in range(_FIRST_ROUNDS if T > 1 else 0):
        found = odometry.run(start, min(_FIRST_SWEEPS, T), lambda *_: None)
        twist = _initial_twist(recording, found.poses)
        start = initial_state(twist)
    return odometry.run(start, T, progress)


def _initial_twist(recording: Recording, poses: Float) -> Float:
    """(6,) constant motion from the first of poses (n, 4, 4) to the second later one."""
    seconds = 1e-9 * (recording.stamp_ns[: len(poses)] - recording.stamp_ns[0])
    later = np.flatnonzero(seconds >= constant_velocity.MIN_STEP)
    if not len(later):
        return np.zeros(6)
    n = int(later[:2][-1])  # the first later one alone would double the uncertainty
    twist: Float = se3.log(se2.inverse(poses[0]) @ poses[n]) / seconds[n]
    return twist


@dataclass(frozen=True, eq=False)
class _SweepOdometry:
    """Arguments of `register_sweeps`."""

    recording: Recording
    e: Float32
    options: OdometryOptions
    threads: int
    max_points: int

    def run(self, state: State, n: int, progress: ScanProgress) -> LidarOdometry:
        """Registers the first n sweeps, from a state at the first one."""
        local = make_local_map()
        poses, twists = np.tile(np.eye(4), (n, 1, 1)), np.zeros((n, 6))
        covariance, explained = np.zeros((n, 6, 6)), np.ones(n)
        cropped_at = state.T_map_base[:3, 3]
        for t in self.recording.iter_scans(range(n), self.e):
            sweep = select_sweep(self.recording, self.e, t)
            if t:
                prior, limits = self._predict(state, t), (self.threads, self.max_points)
                state, explained[t] = follow_sweep(local, sweep, prior, *limits)
            poses[t], twists[t] = state.T_map_base, state.twist
            covariance[t] = se2.rotate_covariance(state.covariance[:6, :6], state.T_map_base)
            local.add(sweep.deskew(state.twist), sweep.weights, state.T_map_base)
            if np.linalg.norm(poses[t, :3, 3] - cropped_at) > CROP_STEP:
                cropped_at = poses[t, :3, 3].copy()
                local.crop(poses[t], MAX_RANGE)
            progress(t + 1, n)
        return LidarOdometry(poses, twists, covariance, explained)

    def _predict(self, state: State, t: int) -> State:
        """The prior of sweep t."""
        recording = self.recording
        seconds = 1e-9 * float(recording.stamp_ns[t] - recording.stamp_ns[t - 1])
        if recording.T_odom_base is not None:
            before, after = recording.T_odom_base[t - 1 : t + 1]
            state = constant_velocity.update_with_odometry(
                state, se2.inverse(before) @ after, seconds, self.options
            )
        return constant_velocity.predict(state, seconds)


def register_sweep(
    local: _core.NdtMap3D, sweep: Sweep, prior: State, threads: int
) -> tuple[State, float]:
    """State at the stamp of a sweep, and the share of its points on planes of the local map."""
    slack = _prior_distance(prior.covariance)
    information: Float = np.linalg.inv(prior.covariance).astype(np.float64)
    level = int(np.clip(np.ceil(np.log2(slack / _CELL)), 0, _LEVELS - 1))
    T, twist, covariance, met, _, total, _ = _core.register_sweep(
        local,
        sweep.points,
        sweep.weights,
        sweep.times,
        prior.T_map_base,
        prior.twist,
        information,
        min_weight=_MIN_WEIGHT,
        max_flatness=_MAX_FLATNESS,
        min_extent=_MIN_EXTENT,
        range_std=_RANGE_STD,
        kernel_width=_KERNEL_WIDTH,
        information_scale=_INFORMATION_SCALE,
        start_level=level,
        start_slack=slack,
        max_iterations=_MAX_ITERATIONS,
        tolerance=_TOLERANCE,
        threads=threads,
    )
    return State(T, twist, covariance), met / max(total, 1e-9)


def follow_sweep(
    local: _core.NdtMap3D, sweep: Sweep, prior: State, threads: int, max_points: int = _MAX_POINTS
) -> tuple[State, float]:
    """As `register_sweep`, by at most so many points of the sweep."""
    return register_sweep(local, downsample_sweep(sweep, max_points), prior, threads)


def match_planes(local: _core.NdtMap3D, points: Float, T_map_base: Float) -> tuple[Float, Bool]:
    """Normals (N, 3) in the base frame at points (N, 3), and which points lie on planes (N,).

    Only the finest cells count.
    """
    positions = np.ascontiguousarray(points @ T_map_base[:3, :3].T + T_map_base[:3, 3])
    normals, offsets, variances, known = local.fit_planes(
        positions, 0, min_weight=_MIN_WEIGHT, max_flatness=_MAX_FLATNESS, min_extent=_MIN_EXTENT
    )
    near = offsets**2 < _KERNEL_WIDTH**2 * (_RANGE_STD**2 + variances)
    return normals @ T_map_base[:3, :3], (known == 1) & near


def _prior_distance(covariance: Float) -> float:
    """m that a sweep may be off planes, by the covariance (12, 12) of its prior."""
    place, turn = (np.linalg.eigvalsh(covariance[i : i + 3, i : i + 3])[-1] for i in (0, 3))
    return float(np.sqrt(max(place, 1e-12)) + _LEVER_ARM * np.sqrt(max(turn, 0.0)))
