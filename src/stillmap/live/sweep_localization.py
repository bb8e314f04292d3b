"""Global localization in 3D: the planar search proposes poses, which the last sweep refines and
verifies."""

from typing import Any

import numpy as np

from stillmap.core import se2
from stillmap.core.array_types import Float
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter
from stillmap.live.global_localization import GlobalLocalizer
from stillmap.live.known_cloud import KnownCloud, KnownPlanes
from stillmap.live.known_map import LOG_RATIO, KeptMap, KnownMap, overlay
from stillmap.live.local_map import MappedScan
from stillmap.live.sweep_view import SweepView, project_obstacles
from stillmap.pipeline.options import Options, resolve_resolution
from stillmap.slam import lidar_odometry
from stillmap.slam.constant_velocity import State
from stillmap.slam.lidar_odometry import Sweep
from stillmap.slam.loop_closure_3d import MIN_PLANE_OVERLAP, plane_overlap

# std of a pose that the planar search proposes: m, rad; m/s and rad/s, which are known by then
_STD = np.repeat([0.3, 0.05, 0.05], [3, 3, 6])
_GONE_WEIGHT = 1.0  # of a surface of the map where the view is free: a car may have left
_FEW_POINTS = 600  # of the last sweep, about, which are registered at every place that is proposed


class SweepLocalizer:
    """A known map in 3D, and the search in it by what the robot saw since it was lost.

    Args:
        known: the map.
        extends: whether sweeps are added to it.
        options: see Options.
        threads: the result does not depend on it.

    Attributes:
        origin, is_lost, is_ambiguous: see PlanarLocalizer.
    """

    is_lost, is_ambiguous = True, False

    def __init__(self, known: KnownCloud, extends: bool, options: Options, threads: int) -> None:
        self.origin, self._extends, output = known.planar.origin, extends, options.output
        self._known, self._threads = known, threads
        self._band = output.min_obstacle_height, output.max_obstacle_height
        self._edge = resolve_resolution(options, 3).slam.resolution
        self._voxels = known.find_voxels(self._edge, self._band)
        self._planar = GlobalLocalizer(known.planar, gone_weight=_GONE_WEIGHT)
        self._local_map = KnownPlanes(known.make_local_map(), extends)
        self._poses = known.poses  # from where it was mapped, and extended
        # labels of all voxels when the robot was carried, in a map that is extended
        self._left: OccupancyFilter | None = None
        self._begin_search()

    def _begin_search(self) -> None:
        self._view = SweepView(self._band)
        self._seen = lidar_odometry.make_local_map()

    @property
    def route(self) -> Float:
        """(T, 3) positions from where it was mapped, and extended before the robot was carried,
        once the robot is found."""
        return self._route[:0] if self.is_lost else self._route

    @property
    def _route(self) -> Float:
        return self._poses[:, :3, 3]

    def forget(self, labels: CausalLabels) -> None:
        """The robot was carried. A map that is extended is searched with what the labels added, and
        they go on with it once the robot is found."""
        self._begin_search()
        if not self._extends:
            labels.clear()
            return
        if not self.is_lost:
            self._left = labels.filter
            self._poses = np.concatenate([self._known.poses, self._local_map.route])
            known, now = self._known.planar, labels.known_cells()
            seen = project_obstacles(now, self._route, self._band, self._edge)
            extended = KnownMap(overlay(known.grid, seen))
            self._planar = GlobalLocalizer(extended, gone_weight=_GONE_WEIGHT)
        labels.filter = labels.filter.sibling()

    def make_local_map(self, _local_map: Any, _T: Float) -> KnownPlanes:
        """The map that sweeps are registered to: one and the same."""
        return self._local_map

    def known_filter(self, empty: OccupancyFilter) -> OccupancyFilter:
        """Filters of voxels with what the map knows; `empty`: such of the same kind."""
        if self._left is not None:
            return self._left
        empty.prime(*self._voxels, LOG_RATIO)
        return empty

    def keep(self, labels: CausalLabels) -> KeptMap:
        """The part of the map that an extended one keeps, as of now; `labels`: so far."""
        if self.is_lost and self._left is None:  # it was never found
            return self._known.keep(None, 1.0, self._edge, self._band)
        now = labels.known_cells(self._left if self.is_lost else None)
        return self._known.keep(now, _p_unseen(labels), self._edge, self._band)

    def localize(self, labels: CausalLabels, scan: MappedScan, pose: Float) -> Float | None:
        """Search what was seen since the robot was lost, with the last sweep."""
        beams, in_plane = scan.beams, se2.project_to_plane(pose[None])[0]
        dense, _ = lidar_odometry.make_sweep(
            beams.points, beams.hit, scan.e, None, beams.T_base_sensor
        )
        self._seen.add(dense.points, dense.weights, pose)
        self._view.add(labels, scan, pose)
        sweep = lidar_odometry.downsample_sweep(dense)
        thin = sweep.select(np.arange(0, len(sweep.points), len(sweep.points) // _FEW_POINTS + 1))

        def refine(T: Float) -> Float:
            registered = se2.project_to_plane(self._register(thin, T @ in_plane)[None])[0]
            return np.asarray(registered @ se2.inverse(in_plane))

        T = self._planar.search(self._view.draw(labels), refine)
        self.is_ambiguous = self._planar.is_ambiguous
        if T is None:
            return None
        T_map_base = self._register(sweep, T @ in_plane)
        points = sweep.points.astype(np.float64)
        overlap = plane_overlap(points, self._seen, pose, self._local_map.planes, T_map_base)
        return None if overlap < MIN_PLANE_OVERLAP else T_map_base @ se2.inverse(pose)

    def _register(self, sweep: Sweep, in_plane: Float) -> Float:
        """(4, 4) T_map_base of a sweep at a planar pose (3, 3) of the robot."""
        prior = State(self._lift(in_plane), np.zeros(6), np.diag(np.square(_STD)))
        state, _ = lidar_odometry.register_sweep(
            self._local_map.planes, sweep, prior, self._threads
        )
        return state.T_map_base

    def _lift(self, in_plane: Float) -> Float:
        """(4, 4) a planar pose (3, 3), as high and inclined as the route where it is nearest."""
        offset = in_plane[:2, 2] - self._route[:, :2]
        nearest = int(np.argmin(np.square(offset).sum(axis=1)))
        up = self._poses[nearest, :3, 2]
        slope = -up[:2] / up[2]
        x = np.append(in_plane[:2, 0], slope @ in_plane[:2, 0])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([x, np.cross(up, x), up])
        T[:3, 3] = [*in_plane[:2, 2], self._route[nearest, 2] + slope @ offset[nearest]]
        return T


def _p_unseen(labels: CausalLabels) -> float:
    """P(static and occupied) of a voxel of which only the known map speaks."""
    empty = labels.filter.sibling()
    empty.prime(np.zeros((1, 3), np.int64), np.ones(1, np.bool_), LOG_RATIO)
    return float(labels.known_cells(empty).p_occupied[0])
