"""Refinement pass: each scan is matched against the map of all other scans."""

import dataclasses

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

_SCANS_PER_CALL = 200  # of the kernel, between which an interrupt is noticed


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
    increments, step_std, has_step = _model_steps(recording, poses, options, breaks)
    grid = _core.OccupancyGrid2D(options.resolution, scan_hits.FREE_SPACE_MARGIN)
    kept = select_keyframes_per_sensor(poses, recording.sensor, SCAN_SPACING, SCAN_SPACING)
    for t in recording.iter_scans(kept, e):
        add_scan(grid, recording, e, t, poses[t])
    is_in_map = np.zeros(T, np.bool_)
    is_in_map[kept] = True
    for first in recording.iter_scans(range(1, T, _SCANS_PER_CALL), e):
        scans = slice(first, min(first + _SCANS_PER_CALL, T))
        beams = slice(int(recording.offset[first]), int(recording.offset[scans.stop]))
        # the step beyond the last scan is none
        around = np.concatenate([poses[first - 1 : scans.stop + 1], poses[-1:]])
        poses[scans], covariance[scans], explained[scans] = _core.refine_scans(
            grid,
            recording.points[beams],
            recording.hit[beams],
            e[beams],
            recording.offset[first : scans.stop + 1] - beams.start,
            recording.T_base_sensor[recording.sensor[scans]],
            is_in_map[scans],
            around[: scans.stop - first + 2],
            increments[first - 1 : scans.stop],
            step_std[first - 1 : scans.stop],
            has_step[first - 1 : scans.stop],
            np.array(motion_model.INCREMENT_STD),
            **scan_matching.refinement_options(grid),
        )
        progress(scans.stop, T)
    return dataclasses.replace(initial, poses=poses, covariance=covariance, explained=explained)


def _model_steps(
    recording: Recording, poses: Float, options: SlamOptions, breaks: list[int]
) -> tuple[Float, Float, NDArray[np.bool_]]:
    """Increments (T, 3, 3) from each scan to the next, their standard deviations (T, 2), and which
    are known (T,).

    Those of odometry with the noise that it has about the poses; of the poses where odometry is
    missing or at fault. The last one is none, and neither are those across breaks.
    """
    motion = se2.inverse(poses[:-1]) @ poses[1:]
    increments, std = motion, np.tile(motion_model.INCREMENT_STD, (len(motion), 1))
    if recording.T_odom_base is not None:
        measured = se2.inverse(recording.T_odom_base[:-1]) @ recording.T_odom_base[1:]
        noise, is_fault = motion_model.fit_odometry_noise(measured, motion, options.odometry)
        increments = np.where(is_fault[:, None, None], motion, measured)
        std = motion_model.learned_odometry_std(increments, options.odometry, noise)
    is_known = np.append(np.ones(len(motion), np.bool_), False)
    is_known[np.array(breaks, np.intp) - 1] = False
    none = np.eye(3)[None], np.array([motion_model.INCREMENT_STD])
    return np.concatenate([increments, none[0]]), np.concatenate([std, none[1]]), is_known
