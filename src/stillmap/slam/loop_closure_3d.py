"""Loops in space: earlier places that are seen again, laid on each other, and what follows."""

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.config import option
from stillmap.core.recording import Recording
from stillmap.slam import lidar_odometry, local_map, pose_graph
from stillmap.slam.constant_velocity import State
from stillmap.slam.lidar_odometry import (
    LidarOdometry,
    SpinningOptions,
    Sweep,
    downsample_sweep,
    select_sweep,
)
from stillmap.slam.loop_types import LoopClosure, refuse
from stillmap.slam.pose_graph import Constraint, PoseGraph, Robust

Float = NDArray[np.float64]

# m and rad/s to which the motion during a sweep is known once it was registered
_TWIST = 0.05
# of the grid in which beams are followed: m, occupancy of what stops them, m before their ends
_CELL, _SOLID, _MARGIN = 0.4, 0.4, 1.0
_ANNEALING = 8


@dataclass(frozen=True)
class SpinningLoopOptions:
    """Loop closure in space; `docs/registration3d.md` says how."""

    enabled: bool = option(True, "close loops; without, poses are incremental only")
    distance: float = option(2.0, "m between keyframes")
    turn: float = option(0.5, "rad between keyframes")
    gap: float = option(40.0, "m of travel after which a place counts as seen again")
    reach: float = option(8.0, "m, how near a keyframe must come to an earlier one")
    stretch: float = option(15.0, "m of travel to either side that make a local map")
    levels: int = option(5, "sizes of its cells, as slam.spinning.levels")
    drift_translation: float = option(0.01, "m of drift per metre: how far to search")
    drift_rotation: float = option(0.0003, "rad of drift per metre: how far to search")
    step_translation: float = option(0.01, "m of random error, per root of a metre")
    step_rotation: float = option(0.0005, "rad of random error, per root of a metre")
    sigma_translation: float = option(0.03, "m, error of a closure at least")
    sigma_rotation: float = option(0.002, "rad, error of a closure at least")
    compared: float = option(
        0.75, "of the share that the local map explained, that the earlier map must explain"
    )
    met: float = option(
        0.55, "share of surfaces that must meet earlier ones, those of every direction alike"
    )
    through: float = option(
        0.1, "share of beams that pass through the earlier map, beyond those that did at that time"
    )
    misfit: float = option(25.0, "chi-square above which the graph refuses a closure")

    def __post_init__(self) -> None:
        for name, low, high in _LIMITS:
            if not low <= getattr(self, name) <= high:
                raise ValueError(f"'slam.spinning_loops.{name}' wants {low:g} to {high:g}")
        if 2.0 * self.stretch > self.gap:  # else a sweep may lie in the map it is laid on
            raise ValueError("'slam.spinning_loops.stretch' wants half of 'gap' at most")


_LIMITS = (
    ("distance", 0.05, 100.0),
    ("turn", 0.05, 100.0),
    ("gap", 1.0, 1e9),
    ("reach", 0.0, 100.0),
    ("stretch", 0.5, 1000.0),
    ("levels", 1, 8),
    ("drift_translation", 0.0, 1.0),
    ("drift_rotation", 0.0, 1.0),
    ("step_translation", 1e-5, 10.0),
    ("step_rotation", 1e-6, 10.0),
    ("sigma_translation", 1e-4, 10.0),
    ("sigma_rotation", 1e-5, 10.0),
    ("compared", 0.0, 1.0),
    ("met", 0.0, 1.0),
    ("through", 0.0, 1.0),
    ("misfit", 1e-3, 1e9),
)


@dataclass(frozen=True, eq=False)
class _Drive:
    """What loops are looked for in: a recording, its poses so far and its keyframes (K,)."""

    recording: Recording
    e: NDArray[np.float32]
    driven: LidarOdometry
    travelled: Float
    keyframes: NDArray[np.intp]
    spinning: SpinningOptions
    options: SpinningLoopOptions
    threads: int

    def sweep(self, t: int) -> Sweep:
        """What sweep t is registered with."""
        options = self.spinning
        fine = select_sweep(self.recording, self.e, t, options.reach, options.thin_map)
        return downsample_sweep(fine, options.thin, options.most)


def close_loops_3d(
    recording: Recording,
    e: NDArray[np.float32],
    spinning_options: SpinningOptions,
    options: SpinningLoopOptions,
    driven: LidarOdometry,
    progress: Callable[[int, int], None],
    threads: int,
) -> tuple[LidarOdometry, list[LoopClosure], PoseGraph | None]:
    """Poses after loop closure, all attempts at closing a loop, and the graph.

    Args:
        recording: 3D.
        e: (M,) probability that each beam was reflected by something static.
        spinning_options, options: how sweeps are registered, and loops looked for.
        driven: the incremental result.
        progress: called with the number of sweeps done and their total.
        threads: the result does not depend on it.
    """
    if not options.enabled or len(driven.poses) < 2:
        return driven, [], None
    travelled = local_map.travelled_distance(driven.poses)
    frames = local_map.select_keyframes(driven.poses, options.distance, options.turn)
    drive = _Drive(recording, e, driven, travelled, frames, spinning_options, options, threads)
    found = _attempted(drive, progress)
    way = _way(drive)
    start = driven.poses[frames]
    relations = [_relation(drive, closure) for closure in found]
    accepted = [r for r, c in zip(relations, found, strict=True) if not c.refused]
    if not accepted:
        return driven, found, PoseGraph(frames, start, way)
    moved = pose_graph.optimize_poses(start, way, accepted, Robust(options.misfit, _ANNEALING))
    misfits = pose_graph.squared_mahalanobis(moved, relations)
    found = [
        refuse(c, "other loops disagree") if not c.refused and m > options.misfit else c
        for c, m in zip(found, misfits, strict=True)
    ]
    accepted = [r for r, c in zip(relations, found, strict=True) if not c.refused]
    moved = pose_graph.optimize_poses(moved, way, accepted, None)
    poses = local_map.propagate_corrections(driven.poses, frames, moved)
    return (
        dataclasses.replace(driven, poses=poses),
        found,
        PoseGraph(frames, moved, [*way, *accepted]),
    )


def _way(drive: _Drive) -> list[Constraint]:
    """Successive keyframes: a random walk that grows with the root of the way."""
    options, frames, out = drive.options, drive.keyframes, list[Constraint]()
    poses = drive.driven.poses[frames]
    steps = se2.inverse(poses[:-1]) @ poses[1:]
    metres = np.diff(drive.travelled[frames]) + 0.05  # standing still is not free of error either
    for k, (T, way) in enumerate(zip(steps, metres, strict=True)):
        sigma = [options.step_translation] * 3 + [options.step_rotation] * 3
        out.append(Constraint(k, k + 1, T, way * np.diag(np.square(sigma))))
    return out


def _relation(drive: _Drive, closure: LoopClosure) -> Constraint:
    first, second = np.searchsorted(drive.keyframes, [closure.earlier, closure.later])
    return Constraint(int(first), int(second), closure.T, closure.covariance)


def _attempted(drive: _Drive, progress: Callable[[int, int], None]) -> list[LoopClosure]:
    """Every keyframe with the nearest one of much earlier travel, where that is within reach.

    What a closure corrects is carried along to the keyframes that follow, and drift is counted
    from there on.
    """
    poses, options, found = drive.driven.poses, drive.options, list[LoopClosure]()
    carried, since = np.eye(4), 0.0
    corrected = poses[drive.keyframes].copy()
    for k, t in enumerate(drive.keyframes.tolist()):
        progress(t, len(poses))
        corrected[k] = carried @ poses[t]
        here = drive.travelled[t]
        n = int(np.searchsorted(drive.travelled[drive.keyframes], here - options.gap))
        if n == 0:
            continue
        apart = np.linalg.norm(corrected[:n, :3, 3] - corrected[k, :3, 3], axis=1)
        i = int(np.argmin(apart))
        metres = here - max(since, float(drive.travelled[drive.keyframes[i]]))
        if apart[i] > options.reach + _drift(metres, options)[0]:
            continue
        T = se2.inverse(corrected[i]) @ corrected[k]
        closure = _laid_on(drive, int(drive.keyframes[i]), t, T, *_drift(metres, options))
        found.append(closure)
        if not closure.refused:
            corrected[k] = corrected[i] @ closure.T
            carried, since = corrected[k] @ se2.inverse(poses[t]), here
    return found


def _drift(metres: float, options: SpinningLoopOptions) -> tuple[float, float]:
    """Standard deviations of place and direction after a way, in metres and radians."""
    return (
        float(np.hypot(0.1, options.drift_translation * metres)),
        float(np.hypot(0.01, options.drift_rotation * metres)),
    )


def _laid_on(
    drive: _Drive, earlier: int, later: int, T: Float, sigma: float, sigma_turn: float
) -> LoopClosure:
    """The later sweep registered on the map of an earlier stretch of travel.

    Args:
        drive: where loops are looked for.
        earlier, later: sweeps.
        T: (4, 4) where the later one ought to be, in the frame of the earlier one.
        sigma, sigma_turn: standard deviations of that, in metres and radians.
    """
    options, driven = drive.options, drive.driven
    local, solid, usual = _local_map(drive, earlier)
    sweep = drive.sweep(later)
    covariance = np.diag(np.square([sigma] * 3 + [sigma_turn] * 3 + [_TWIST] * 6))
    prior = State(driven.poses[earlier] @ T, driven.twists[later], covariance)
    state, explained = lidar_odometry.register_sweep(
        local, sweep, prior, drive.spinning, drive.threads
    )
    found = se2.inverse(driven.poses[earlier]) @ state.T_map_base
    least = [options.sigma_translation] * 3 + [options.sigma_rotation] * 3
    closure = LoopClosure(
        earlier, later, found, state.covariance[:6, :6] + np.diag(np.square(least)), explained
    )
    if explained < options.compared * driven.explained[later]:
        return refuse(closure, "explains too little")
    if _share_met(drive, local, sweep, later, state) < options.met:
        return refuse(closure, "surfaces do not meet")
    if _through(drive, solid, sweep, later, state) > usual + options.through:
        return refuse(closure, "looks through what is there")
    off = se3.log(se2.inverse(T) @ found)
    if off @ np.linalg.solve(covariance[:6, :6], off) > options.misfit:
        return refuse(closure, "lies farther off than it can have drifted")
    return closure


def _local_map(drive: _Drive, earlier: int) -> tuple[_core.NdtMap3D, _core.OccupancyGrid3D, float]:
    """Keyframes of one stretch as surfaces, as cells that stop beams, and the share of beams of
    the one in the middle that pass through these all the same."""
    options, driven, travelled = drive.spinning, drive.driven, drive.travelled
    half = drive.options.stretch
    frames = drive.keyframes
    around = frames[np.abs(travelled[frames] - travelled[earlier]) <= half]
    local = _core.NdtMap3D(options.edge, drive.options.levels, options.enough)
    solid = _core.OccupancyGrid3D(_CELL, 0.0)
    for t in around.tolist():
        fine = select_sweep(drive.recording, drive.e, t, options.reach, options.thin_map)
        local.add(fine.at_its_stamp(driven.twists[t]), fine.weights, driven.poses[t])
        few = downsample_sweep(fine, options.thin, options.most)
        X = drive.recording.T_base_sensor[drive.recording.sensor[t]]
        points = few.at_its_stamp(driven.twists[t]) @ X[:3, :3] - X[:3, 3] @ X[:3, :3]
        _core.add_beams(
            solid,
            np.ascontiguousarray(points, dtype=np.float32),
            np.ones(len(points), np.bool_),
            few.weights,
            np.array([0, len(points)]),
            (driven.poses[t] @ X)[None],
        )
    state = State(driven.poses[earlier], driven.twists[earlier], np.zeros((12, 12)))
    return local, solid, _through(drive, solid, drive.sweep(earlier), earlier, state)


def _share_met(
    drive: _Drive, local: _core.NdtMap3D, sweep: Sweep, later: int, state: State
) -> float:
    """Share of the surfaces around a later sweep that lie on earlier ones.

    Most of what a lidar sees on a street is the street, which meets any other. So every beam counts
    by its leverage n^T (sum n n^T)^-1 n, n being the normal where it ended, as the map of its own
    time has it: surfaces of every direction count the same.
    """
    own = _local_map(drive, later)[0]
    points = sweep.at_its_stamp(state.twist).astype(np.float64)
    normals, known = _surfaces(drive.spinning, own, points, drive.driven.poses[later])
    n = normals[known]
    if len(n) < 10:
        return 0.0
    spread = n.T @ n + 1e-6 * len(n) * np.eye(3)
    leverage = np.einsum("ni,ij,nj->n", n, np.linalg.inv(spread), n)
    _, met = _surfaces(drive.spinning, local, points[known], state.T_map_base)
    return float(leverage[met].sum() / leverage.sum())


def _surfaces(
    options: SpinningOptions, local: _core.NdtMap3D, points: Float, T: Float
) -> tuple[Float, NDArray[np.bool_]]:
    """Normals (N, 3) in the frame of the base where points (N, 3) at a pose T lie on surfaces of
    the finest cells, and where they do (N,)."""
    places = np.ascontiguousarray(points @ T[:3, :3].T + T[:3, 3])
    normals, offsets, variances, known = local.fit_planes(
        places, 0, min_weight=options.least, max_flatness=options.flat, min_extent=options.wide
    )
    near = offsets**2 < options.kernel**2 * (options.sigma**2 + variances)
    return normals @ T[:3, :3], (known == 1) & near


def _through(
    drive: _Drive, solid: _core.OccupancyGrid3D, sweep: Sweep, t: int, state: State
) -> float:
    """Share of the beams of sweep t, at a state, that pass through what is there."""
    return _core.occluded_share(
        solid,
        sweep.at_its_stamp(state.twist),
        sweep.weights,
        state.T_map_base,
        drive.recording.T_base_sensor[drive.recording.sensor[t]],
        margin=_MARGIN,
        min_occupancy=_SOLID,
    )
