"""One pass over all scans: each registered against the map that all the others make."""

import dataclasses
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam import local_map, motion_model, scan_matching
from stillmap.slam.motion_model import MotionPrior
from stillmap.slam.odometry_2d import MStepResult, SlamOptions
from stillmap.slam.scan_matching import add_scan, select_hits

Float = NDArray[np.float64]


def refine_poses(
    recording: Recording,
    e: NDArray[np.float32],
    options: SlamOptions,
    mapped: MStepResult,
    progress: Callable[[int, int], None],
) -> MStepResult:
    """Poses, covariances and explained shares after a pass; the first pose stays.

    Args:
        recording: 2D.
        e: (M,) probability that each beam was reflected by something static.
        options: see SlamOptions.
        mapped: where to begin; its grid is not looked at.
        progress: called with the number of scans done and their total.
    """
    poses = mapped.poses.copy()
    T = len(poses)
    covariance, explained = np.zeros((T, 3, 3)), np.ones(T)
    increments = _increments(recording, poses)
    grid = _core.OccupancyGrid2D(options.resolution, options.registration.approach)
    kept = local_map.select_keyframes_per_sensor(
        poses, recording.sensor, options.spacing, options.spacing
    )
    for t in recording.iter_scans(kept, e):
        add_scan(grid, recording, e, t, poses[t], options.surface)
    is_in_map = np.zeros(T, np.bool_)
    is_in_map[kept] = True
    for t in recording.iter_scans(range(1, T), e):
        if is_in_map[t]:
            add_scan(grid, recording, e, t, poses[t], options.surface, remove=True)
        prior = _between_neighbours(recording, poses, increments, mapped.breaks, t, options)
        scan = select_hits(recording, e, t)
        found = scan_matching.search_pose(
            grid, scan, prior, options.registration, 0.0, 0.0, start=poses[t]
        )
        poses[t] = se2.normalize(found.T_map_base)
        covariance[t], explained[t] = found.covariance, found.explained
        if is_in_map[t]:
            add_scan(grid, recording, e, t, poses[t], options.surface)
        progress(t + 1, T)
    return dataclasses.replace(mapped, poses=poses, covariance=covariance, explained=explained)


def _increments(recording: Recording, poses: Float) -> Float:
    odometry = poses if recording.T_odom_base is None else recording.T_odom_base
    return se2.inverse(odometry[:-1]) @ odometry[1:]


def _between_neighbours(
    recording: Recording,
    poses: Float,
    increments: Float,
    breaks: list[int],
    t: int,
    options: SlamOptions,
) -> MotionPrior:
    """What the motion from the scan before and to the scan after says of a pose."""
    known = recording.T_odom_base is not None
    one = motion_model.increment_prior(poses[t - 1], increments[t - 1], options.motion, known)
    if t in breaks:  # nobody knows how it came here
        one = motion_model.increment_prior(poses[t], np.eye(3), options.motion, is_odometry=False)
    if t + 1 == len(poses) or t + 1 in breaks:
        return one
    back = se2.inverse(increments[t])
    return motion_model.fuse_priors(
        one, motion_model.increment_prior(poses[t + 1], back, options.motion, known)
    )
