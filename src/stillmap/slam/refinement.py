"""Refinement pass: each scan is matched against the map of all other scans."""

import dataclasses
from collections.abc import Callable
from functools import partial

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
    breaks = initial.diagnostics.breaks
    increments, step_prior = _model_steps(recording, poses, options)
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
        prior = _neighbor_prior(t, poses, increments, breaks, step_prior)
        match = scan_matching.refine_pose(grid, scan, prior, poses[t])
        poses[t] = se2.normalize(match.T_map_base)
        covariance[t], explained[t] = match.covariance, match.explained
        if is_in_map[t]:
            add_scan(grid, recording, e, t, poses[t])
        progress(t + 1, T)
    return dataclasses.replace(initial, poses=poses, covariance=covariance, explained=explained)


def _model_steps(
    recording: Recording, poses: Float, options: SlamOptions
) -> tuple[Float, Callable[[Float, Float], MotionPrior]]:
    """Increments (T - 1, 3, 3) between scans, and the prior after one from a pose (3, 3).

    Those of odometry with the noise that it has about the poses; of the poses where odometry is
    missing or at fault.
    """
    motion = se2.inverse(poses[:-1]) @ poses[1:]
    if recording.T_odom_base is None:
        return motion, motion_model.increment_prior
    measured = se2.inverse(recording.T_odom_base[:-1]) @ recording.T_odom_base[1:]
    noise, is_fault = motion_model.fit_odometry_noise(measured, motion, options.odometry)
    increments = np.where(is_fault[:, None, None], motion, measured)
    return increments, partial(motion_model.odometry_prior, options=options.odometry, noise=noise)


def _neighbor_prior(
    t: int,
    poses: Float,
    increments: Float,
    breaks: list[int],
    step_prior: Callable[[Float, Float], MotionPrior],
) -> MotionPrior:
    """Prior of scan t from the motion since the scan before and until the scan after.

    Args:
        t: the scan.
        poses: (T, 3, 3).
        increments: (T - 1, 3, 3) between scans.
        breaks: scans before which the motion is unknown.
        step_prior: the prior after an increment from a pose.
    """
    if t in breaks:
        prior = motion_model.increment_prior(poses[t], np.eye(3))
    else:
        prior = step_prior(poses[t - 1], increments[t - 1])
    if t + 1 == len(poses) or t + 1 in breaks:
        return prior
    after = step_prior(poses[t + 1], se2.inverse(increments[t]))
    return motion_model.fuse_priors(prior, after)
