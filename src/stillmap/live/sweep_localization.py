"""Global localization in 3D: the planar search proposes poses, which the last sweep refines and
verifies."""

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.live.causal_labels import CausalLabels, OccupancyFilter
from stillmap.live.global_localization import GlobalLocalizer, Localization
from stillmap.live.known_cloud import KnownCloud
from stillmap.live.local_map import MappedScan
from stillmap.live.sweep_view import SweepView
from stillmap.pipeline.options import Options, resolve_resolution
from stillmap.slam import lidar_odometry
from stillmap.slam.constant_velocity import State
from stillmap.slam.lidar_odometry import Sweep
from stillmap.slam.loop_closure_3d import MIN_PLANE_OVERLAP, plane_overlap

Float = NDArray[np.float64]

# std of a pose that the planar search proposes: m, rad; m/s and rad/s, which are known by then
_STD = np.repeat([0.3, 0.05, 0.05], [3, 3, 6])
_GONE_WEIGHT = 1.0  # of a surface of the map where the view is free: a car may have left
_FEW_POINTS = 600  # of the last sweep, about, which are registered at every place that is proposed


class SweepLocalizer:
    """Searches a known map in 3D by what the robot saw since it was lost.

    Args:
        known: the map.
        options: see Options.
        threads: the result does not depend on it.
    """

    def __init__(self, known: KnownCloud, options: Options, threads: int) -> None:
        output = options.output
        self._known, self._threads = known, threads
        self._band = output.min_obstacle_height, output.max_obstacle_height
        edge = resolve_resolution(options, 3).slam.resolution
        self._voxels = known.find_voxels(edge, self._band)
        self._planar = GlobalLocalizer(known.planar, gone_weight=_GONE_WEIGHT)
        self._planes = known.make_local_map()
        self.route = known.poses[:, :3, 3]
        self.forget()

    def forget(self) -> None:
        """The robot was carried: what it saw before was elsewhere."""
        self._view = SweepView(self._band)
        self._seen = lidar_odometry.make_local_map()

    def make_local_map(self) -> _core.NdtMap3D:
        """The map that sweeps are registered to: one and the same, which they are not added to."""
        return self._planes

    def prime(self, labels: OccupancyFilter) -> None:
        """Tell the filters of voxels what the map knows."""
        assert isinstance(labels, _core.SweepFilter3D)
        self._voxels.prime(labels)

    def localize(self, labels: CausalLabels, scan: MappedScan, pose: Float) -> Localization:
        """(4, 4) of the frame of the labels in the known map, if the evidence is clear.

        Args:
            labels: of what was seen since the robot was lost.
            scan: the last sweep.
            pose: (4, 4) of the robot in the frame of the labels.
        """
        beams, in_plane = scan.beams, se2.project_to_plane(pose[None])[0]
        dense, _ = lidar_odometry.make_sweep(
            beams.points, beams.hit, scan.e, None, beams.T_base_sensor
        )
        self._seen.add(dense.points, dense.weights, pose)
        self._view.add(labels, scan, pose)
        sweep = lidar_odometry.downsample_sweep(dense)
        thin = sweep.select(np.arange(0, len(sweep.points), len(sweep.points) // _FEW_POINTS + 1))

        def refine(T: Float) -> Float:
            found = se2.project_to_plane(self._register(thin, T @ in_plane)[None])[0]
            return np.asarray(found @ se2.inverse(in_plane))

        found = self._planar.search(self._view.draw(labels), refine)
        if found.T is None:
            return found
        T_map_base = self._register(sweep, found.T @ in_plane)
        points = sweep.points.astype(np.float64)
        overlap = plane_overlap(points, self._seen, pose, self._planes, T_map_base)
        if overlap < MIN_PLANE_OVERLAP:
            return Localization(None)
        return Localization(T_map_base @ se2.inverse(pose))

    def _register(self, sweep: Sweep, in_plane: Float) -> Float:
        """(4, 4) T_map_base of a sweep at a planar pose (3, 3) of the robot."""
        prior = State(self._lift(in_plane), np.zeros(6), np.diag(np.square(_STD)))
        state, _ = lidar_odometry.register_sweep(self._planes, sweep, prior, self._threads)
        return state.T_map_base

    def _lift(self, in_plane: Float) -> Float:
        """(4, 4) a planar pose (3, 3), as high and inclined as the route where it is nearest."""
        offset = in_plane[:2, 2] - self.route[:, :2]
        nearest = int(np.argmin(np.square(offset).sum(axis=1)))
        up = self._known.poses[nearest, :3, 2]
        slope = -up[:2] / up[2]
        x = np.append(in_plane[:2, 0], slope @ in_plane[:2, 0])
        x /= np.linalg.norm(x)
        T = np.eye(4)
        T[:3, :3] = np.column_stack([x, np.cross(up, x), up])
        T[:3, 3] = [*in_plane[:2, 2], self.route[nearest, 2] + slope @ offset[nearest]]
        return T
