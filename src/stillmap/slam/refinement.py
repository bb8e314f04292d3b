"""Refinement pass: each scan is matched against the map of all other scans."""

import dataclasses

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, scan_matching
from stillmap.slam.local_map import SCAN_SPACING, select_keyframes_per_sensor
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_matching import add_scan, select_hits
from stillmap.slam.types import MStepResult, ScanProgress

Float = NDArray[np.float64]


def refine_poses(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    initial: MStepResult,
    progress: ScanProgress,
) -> MStepResult:
    """Poses, covariances and explained shares after one pass; the first pose is fixed.

    Args:
        recording: 2D.
        e: (M,) P(static) of every beam.
        options: see SlamOptions.
        initial: poses to refine; its grid is not used.
        progress: called with the number of scans done and their total.
    """
    poses = initial.poses.copy()
    T = len(poses)
    covariance, explained = np.zeros((T, 3, 3)), np.ones(T)
    prior = _NeighborPrior(recording, poses, initial.diagnostics.breaks, options)
    grid = _core.OccupancyGrid2D(options.resolution, scan_matching.FREE_SPACE_MARGIN)
    kept = select_keyframes_per_sensor(poses, recording.sensor, SCAN_SPACING, SCAN_SPACING)
    for t in recording.iter_scans(kept, e):
        add_scan(grid, recording, e, t, poses[t])
    is_in_map = np.zeros(T, np.bool_)
    is_in_map[kept] = True
    for t in recording.iter_scans(range(1, T), e):
        if is_in_map[t]:
            add_scan(grid, recording, e, t, poses[t], remove=True)
        scan = select_hits(recording, e, t)
        match = scan_matching.refine_pose(grid, scan, prior.at(t), poses[t])
        poses[t] = se2.normalize(match.T_map_base)
        covariance[t], explained[t] = match.covariance, match.explained
        if is_in_map[t]:
            add_scan(grid, recording, e, t, poses[t])
        progress(t + 1, T)
    return dataclasses.replace(initial, poses=poses, covariance=covariance, explained=explained)


class _NeighborPrior:
    """Prior of a pose from the motion since the scan before and until the scan after.

    Args:
        recording: its odometry, if there is one, gives the increments.
        poses: (T, 3, 3) current poses, which the caller refines in place.
        breaks: scans before which the motion is unknown.
        options: see SlamOptions.
    """

    def __init__(
        self, recording: Recording, poses: Float, breaks: list[int], options: SlamOptions
    ) -> None:
        odometry = recording.T_odom_base
        source = poses if odometry is None else odometry
        self._increments = se2.inverse(source[:-1]) @ source[1:]
        self._is_odometry = odometry is not None
        self._poses, self._breaks, self._options = poses, breaks, options.odometry

    def at(self, t: int) -> MotionPrior:
        """The prior of scan t."""
        poses, increments = self._poses, self._increments
        if t in self._breaks:
            prior = motion_model.increment_prior(poses[t], np.eye(3))
        else:
            prior = self._from(poses[t - 1], increments[t - 1])
        if t + 1 == len(poses) or t + 1 in self._breaks:
            return prior
        after = self._from(poses[t + 1], se2.inverse(increments[t]))
        return motion_model.fuse_priors(prior, after)

    def _from(self, T_map_base: Float, increment: Float) -> MotionPrior:
        if self._is_odometry:
            return motion_model.odometry_prior(T_map_base, increment, self._options)
        return motion_model.increment_prior(T_map_base, increment)
