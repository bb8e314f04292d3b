"""Refinement pass: each scan is matched against the map of all other scans."""

import dataclasses
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import se2
from stillmap.core.recording import Recording
from stillmap.slam import motion_model, scan_hits, scan_matching
from stillmap.slam.local_map import SCAN_SPACING, select_keyframes_per_sensor
from stillmap.slam.options import SlamOptions
from stillmap.slam.scan_hits import add_scan
from stillmap.slam.types import MStepResult, ScanProgress

Float = NDArray[np.float64]

_SCANS_PER_CALL = 200  # of the kernel; interrupts are noticed in between


class _MotionSteps(NamedTuple):
    """The motion from each scan to the next.

    Attributes:
        increments: (T, 3, 3).
        std: (T, 2) standard deviations in m and rad.
        known: (T,) False across breaks, and after the last scan.
    """

    increments: Float
    std: Float
    known: NDArray[np.bool_]


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
    steps = _motion_steps(recording, poses, options, initial.diagnostics.breaks)
    grid = _core.OccupancyGrid2D(options.resolution, scan_hits.FREE_SPACE_MARGIN)
    kept = select_keyframes_per_sensor(poses, recording.sensor, SCAN_SPACING, SCAN_SPACING)
    for t in recording.iter_scans(kept, e):
        add_scan(grid, recording, e, t, poses[t])
    is_in_map = np.zeros(T, np.bool_)
    is_in_map[kept] = True
    for first in recording.iter_scans(range(1, T, _SCANS_PER_CALL), e):
        scans = slice(first, min(first + _SCANS_PER_CALL, T))
        beams = slice(int(recording.offset[first]), int(recording.offset[scans.stop]))
        before_to_after = np.clip(np.arange(first - 1, scans.stop + 1), 0, T - 1)
        to_each_and_beyond = slice(first - 1, scans.stop)
        poses[scans], covariance[scans], explained[scans] = _core.refine_scans(
            grid,
            recording.points[beams],
            recording.hit[beams],
            e[beams],
            recording.offset[first : scans.stop + 1] - beams.start,
            recording.T_base_sensor[recording.sensor[scans]],
            is_in_map[scans],
            poses[before_to_after],
            steps.increments[to_each_and_beyond],
            steps.std[to_each_and_beyond],
            steps.known[to_each_and_beyond],
            np.array(motion_model.MIN_INCREMENT_STD),
            **scan_matching.refinement_options(grid),
        )
        progress(scans.stop, T)
    return dataclasses.replace(initial, poses=poses, covariance=covariance, explained=explained)


def _motion_steps(
    recording: Recording, poses: Float, options: SlamOptions, breaks: list[int]
) -> _MotionSteps:
    """The steps of odometry, with the noise that it has about the poses (T, 3, 3).

    Those of the poses where odometry is missing or at fault.
    """
    motion = se2.inverse(poses[:-1]) @ poses[1:]
    increments, std = motion, np.tile(motion_model.MIN_INCREMENT_STD, (len(motion), 1))
    if recording.T_odom_base is not None:
        measured = se2.inverse(recording.T_odom_base[:-1]) @ recording.T_odom_base[1:]
        noise, is_fault = motion_model.fit_odometry_noise(measured, motion, options.odometry)
        increments = np.where(is_fault[:, None, None], motion, measured)
        std = motion_model.increment_std(increments, options.odometry, noise)
    known = np.ones(len(poses), np.bool_)
    known[[*(t - 1 for t in breaks), -1]] = False
    return _MotionSteps(
        np.concatenate([increments, np.eye(3)[None]]), np.concatenate([std, np.ones((1, 2))]), known
    )
