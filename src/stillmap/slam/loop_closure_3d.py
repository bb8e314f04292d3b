"""Loop closure in 3D: keyframes registered to submaps of earlier travel, then the pose graph."""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

import stillmap._core as _core
from stillmap.core import se2, se3
from stillmap.core.array_types import Float, Float32, Index
from stillmap.core.recording import Recording
from stillmap.slam import lidar_odometry, local_map
from stillmap.slam.constant_velocity import State
from stillmap.slam.lidar_odometry import LidarOdometry, Sweep, downsample_sweep, select_sweep
from stillmap.slam.local_map import KEYFRAME_ANGLE
from stillmap.slam.loop_candidates import DRIFT_ROTATION
from stillmap.slam.loop_closure import accepted_constraints, solve_graph
from stillmap.slam.loop_verification import CLOSURE_TRANSLATION
from stillmap.slam.options import SlamOptions
from stillmap.slam.pose_graph import Constraint, PoseGraph
from stillmap.slam.scan_matching import WALL_OCCUPANCY
from stillmap.slam.types import LoopClosure, ScanProgress

KEYFRAME_DISTANCE, SEARCH_DISTANCE = 2.0, 8.0  # m, defaults of the options
# m after which a place counts as revisited; m of travel to either side that forms a submap: at most
# half of that, or a sweep may lie in the submap it is registered to
_MIN_LOOP_TRAVEL, _SUBMAP_TRAVEL = 40.0, 15.0
_SUBMAP_LEVELS = 5  # of plane cells
_DRIFT_TRANSLATION = 0.01  # m per m, which sets the search window
_MIN_DRIFT = (0.1, 0.01)  # m, rad
_STEP_TRANSLATION, _STEP_ROTATION = 0.01, 0.0005  # random walk, m and rad per root of a metre
_TWIST_STD = 0.05  # m/s and rad/s, of the motion during a registered sweep
_CLOSURE_ROTATION = 0.002  # rad, min std of a closure
_MIN_EXPLAINED_RATIO = 0.75  # of the share that the local map explained
MIN_PLANE_OVERLAP = 0.55  # share of planes, balanced over their directions, that meet earlier ones
_MAX_OCCLUDED = 0.1  # share of beams through the submap, beyond that of the sweep at its center
MAX_CHI2 = 25.0  # 6 degrees of freedom; above it the graph rejects a loop
_GRID_CELL, _WALL_MARGIN = 0.4, 1.0  # m: cells in which beams are traced; before the end of a beam


def close_loops_3d(
    recording: Recording,
    e: Float32,
    options: SlamOptions,
    odometry: LidarOdometry,
    progress: ScanProgress,
    threads: int,
) -> tuple[Float, list[LoopClosure], PoseGraph | None]:
    """Poses (T, 4, 4) after loop closure, all attempted closures, and the pose graph.

    Args:
        recording: 3D.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        odometry: result of lidar odometry.
        progress: called with the number of sweeps done and their total.
        threads: the result does not depend on it.
    """
    poses = odometry.poses
    if len(poses) < 2:
        return poses, [], None
    distance = options.keyframe_distance or KEYFRAME_DISTANCE
    keyframes = local_map.select_keyframes(poses, distance, KEYFRAME_ANGLE)
    travelled = local_map.travelled_distance(poses)
    search = options.loop_search_distance
    closer = SweepLoopCloser(
        recording,
        e,
        odometry,
        travelled,
        keyframes,
        SEARCH_DISTANCE if search is None else search,
        threads,
    )
    found, chain = closer.search_loops(progress), closer.odometry_constraints()
    start = poses[keyframes]
    if all(closure.rejected for closure in found):
        return poses, found, PoseGraph(keyframes, start, chain)
    corrected, found = solve_graph(keyframes, chain, start, found, MAX_CHI2)
    graph = PoseGraph(keyframes, corrected, [*chain, *accepted_constraints(keyframes, found)])
    return local_map.propagate_corrections(poses, keyframes, corrected), found, graph


def _drift_std(metres: float) -> tuple[float, float]:
    """Standard deviations of position (m) and direction (rad) after that much travel."""
    return (
        float(np.hypot(_MIN_DRIFT[0], _DRIFT_TRANSLATION * metres)),
        float(np.hypot(_MIN_DRIFT[1], DRIFT_ROTATION * metres)),
    )


class LoopSearch:
    """Keyframes as the loops found so far correct them.

    Args:
        keyframes: their number.
    """

    def __init__(self, keyframes: int) -> None:
        self.corrected = np.zeros((keyframes, 4, 4))
        self.correction = np.eye(4)  # of what follows
        self.since = 0.0  # m of travel up to the last loop


@dataclass(frozen=True, eq=False)
class SweepLoopCloser:
    """A 3D trajectory in which loops are searched.

    Attributes:
        travelled: (T,) m up to each sweep.
        keyframes: (K,) sweeps.
        search_distance: m between a keyframe and an earlier one.
    """

    recording: Recording
    e: Float32
    odometry: LidarOdometry
    travelled: Float
    keyframes: Index
    search_distance: float
    threads: int

    def odometry_constraints(self) -> list[Constraint]:
        """Constraints between successive keyframes: a random walk."""
        poses = self.odometry.poses[self.keyframes]
        steps = se2.increments(poses)
        metres = np.diff(self.travelled[self.keyframes]) + 0.05  # standing still has errors too
        covariance = np.diag(np.square([_STEP_TRANSLATION] * 3 + [_STEP_ROTATION] * 3))
        return [
            Constraint(k, k + 1, T, length * covariance)
            for k, (T, length) in enumerate(zip(steps, metres, strict=True))
        ]

    def search_loops(self, progress: ScanProgress) -> list[LoopClosure]:
        """Each keyframe with the nearest one of much earlier travel, if near enough.

        An accepted closure corrects the keyframes that follow, and drift counts from there.
        """
        poses, found = self.odometry.poses, list[LoopClosure]()
        search = LoopSearch(len(self.keyframes))
        for k, t in enumerate(self.keyframes.tolist()):
            progress(t, len(poses))
            closure = self.search_keyframe(k, search)
            if closure is not None:
                found.append(closure)
        return found

    def search_keyframe(self, k: int, search: "LoopSearch") -> LoopClosure | None:
        """The closure of keyframe k with an earlier one, if one is near enough.

        Args:
            k: keyframe.
            search: of the keyframes before; updated.
        """
        t, poses, corrected = int(self.keyframes[k]), self.odometry.poses, search.corrected
        corrected[k] = search.correction @ poses[t]
        here = self.travelled[t]
        n = int(np.searchsorted(self.travelled[self.keyframes], here - _MIN_LOOP_TRAVEL))
        if n == 0:
            return None
        distance = np.linalg.norm(corrected[:n, :3, 3] - corrected[k, :3, 3], axis=1)
        i = int(np.argmin(distance))
        metres = here - max(search.since, float(self.travelled[self.keyframes[i]]))
        if distance[i] > self.search_distance + _drift_std(metres)[0]:
            return None
        T = se2.inverse(corrected[i]) @ corrected[k]
        closure = self.verify(int(self.keyframes[i]), t, T, *_drift_std(metres))
        if not closure.rejected:
            corrected[k] = corrected[i] @ closure.T
            search.correction, search.since = corrected[k] @ se2.inverse(poses[t]), here
        return closure

    def verify(
        self, earlier: int, later: int, T: Float, translation_std: float, rotation_std: float
    ) -> LoopClosure:
        """The later sweep registered to the submap of the earlier one.

        Args:
            earlier, later: sweeps.
            T: (4, 4) predicted pose of the later one in the frame of the earlier one.
            translation_std, rotation_std: of that, m and rad.
        """
        odometry = self.odometry
        planes = self._build_planes(earlier)
        sweep = downsample_sweep(select_sweep(self.recording, self.e, later))
        std = [translation_std] * 3 + [rotation_std] * 3 + [_TWIST_STD] * 6
        covariance = np.diag(np.square(std))
        prior = State(odometry.poses[earlier] @ T, odometry.twists[later], covariance)
        state, explained = lidar_odometry.register_sweep(planes, sweep, prior, self.threads)
        found = se2.inverse(odometry.poses[earlier]) @ state.T_map_base
        floor = [CLOSURE_TRANSLATION] * 3 + [_CLOSURE_ROTATION] * 3
        closure = LoopClosure(
            earlier, later, found, state.covariance[:6, :6] + np.diag(np.square(floor)), explained
        )
        if explained < _MIN_EXPLAINED_RATIO * odometry.explained[later]:
            return closure.reject("explains too little")
        points = sweep.deskew(state.twist).astype(np.float64)
        own, T_own = self._build_planes(later), odometry.poses[later]
        if plane_overlap(points, own, T_own, planes, state.T_map_base) < MIN_PLANE_OVERLAP:
            return closure.reject("surfaces do not overlap")
        grid, usual = self._build_grid(earlier)
        if self._occluded_share(grid, sweep, later, state) > usual + _MAX_OCCLUDED:
            return closure.reject("passes through occupied space")
        off = se3.log(se2.inverse(T) @ found)
        if off @ np.linalg.solve(covariance[:6, :6], off) > MAX_CHI2:
            return closure.reject("exceeds the possible drift")
        return closure

    def _sweeps_around(self, center: int) -> Iterator[tuple[int, Sweep]]:
        """The keyframes of the submap around a sweep."""
        offset = np.abs(self.travelled[self.keyframes] - self.travelled[center])
        for t in self.keyframes[offset <= _SUBMAP_TRAVEL].tolist():
            yield t, select_sweep(self.recording, self.e, t)

    def _build_planes(self, center: int) -> _core.NdtMap3D:
        """Submap of plane cells around a sweep."""
        planes = lidar_odometry.make_local_map(_SUBMAP_LEVELS)
        for t, sweep in self._sweeps_around(center):
            twist = self.odometry.twists[t]
            planes.add(sweep.deskew(twist), sweep.weights, self.odometry.poses[t])
        return planes

    def _build_grid(self, center: int) -> tuple[_core.OccupancyGrid3D, float]:
        """Submap of occupancy around a sweep, and the occluded share of that sweep."""
        odometry = self.odometry
        grid = _core.OccupancyGrid3D(_GRID_CELL, 0.0)
        for t, dense in self._sweeps_around(center):
            sweep = downsample_sweep(dense)
            X = self.recording.T_base_sensor[self.recording.sensor[t]]
            points = sweep.deskew(odometry.twists[t]) @ X[:3, :3] - X[:3, 3] @ X[:3, :3]
            _core.add_beams(
                grid,
                np.ascontiguousarray(points, dtype=np.float32),
                np.ones(len(points), np.bool_),
                sweep.weights,
                np.array([0, len(points)]),
                (odometry.poses[t] @ X)[None],
            )
        state = State(odometry.poses[center], odometry.twists[center], np.zeros((12, 12)))
        sweep = downsample_sweep(select_sweep(self.recording, self.e, center))
        return grid, self._occluded_share(grid, sweep, center, state)

    def _occluded_share(
        self, grid: _core.OccupancyGrid3D, sweep: Sweep, t: int, state: State
    ) -> float:
        """Share of the beams of sweep t, at a state, that pass through occupied cells."""
        return _core.occluded_share(
            grid,
            sweep.deskew(state.twist),
            sweep.weights,
            state.T_map_base,
            self.recording.T_base_sensor[self.recording.sensor[t]],
            margin=_WALL_MARGIN,
            min_occupancy=WALL_OCCUPANCY,
        )


def plane_overlap(
    points: Float, own: _core.NdtMap3D, T_own: Float, planes: _core.NdtMap3D, T: Float
) -> float:
    """Share of the planes that a sweep meets in its own map which another map has, too.

    Most of what a lidar sees in a street is the street, which fits any other. So every beam
    counts by its leverage n^T (sum n n^T)^-1 n with the normal n at its end in its own map:
    planes of every direction count the same.

    Args:
        points: (N, 3) of the sweep in the base frame.
        own, planes: its own map, and the other one.
        T_own, T: (4, 4) pose of the base in each.
    """
    normals, known = lidar_odometry.match_planes(own, points, T_own)
    n = normals[known]
    if len(n) < 10:
        return 0.0
    spread = n.T @ n + 1e-6 * len(n) * np.eye(3)
    leverage = np.einsum("ni,ij,nj->n", n, np.linalg.inv(spread), n)
    _, met = lidar_odometry.match_planes(planes, points[known], T)
    return float(leverage[met].sum() / leverage.sum())
