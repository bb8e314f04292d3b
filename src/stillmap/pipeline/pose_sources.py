"""Poses compared with their sources: odometry alone, and scans alone.

EM starts from odometry and improves on it scan by scan. Where most of what the robot sees is people
it may end farther from the truth than odometry was, and odometry that is often at fault may do
harm. Held-out scans tell: they are predicted by the map of the other scans (`em.quality`).
"""

import dataclasses
import time

import numpy as np
from numpy.typing import NDArray

from stillmap import em, slam
from stillmap.core import se2
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer
from stillmap.core.recording import Recording
from stillmap.pipeline.em_loop import label_poses
from stillmap.pipeline.estimate import EmState, Iteration
from stillmap.pipeline.options import Options

Float = NDArray[np.float64]

# odometry gets an E-step of its own if its score with the labels so far falls short of the best
# one by less than this share of it; labels of its own raise it
_MAX_SHORTFALL = 0.4
_MIN_FAULT_SHARE = 0.05  # of the scans at which odometry is at fault: scans alone are worth a try


def better_source(
    recording: Recording,
    state: EmState,
    progress: Progress,
    stages: StageTimer,
) -> Iteration | None:
    """The source of poses that predicts held-out scans best, if better than the best iteration.

    Args:
        recording: as recorded.
        state: of an EM that has converged.
        progress: called with the stage, the iteration, scans done, and of how many.
        stages: where time and memory per stage are noted.

    Returns:
        An iteration at its poses, numbered after the last one; None where the best iteration is
        better than odometry alone and scans alone, where there is no odometry, or where iterations
        are not compared by held-out scans.
    """
    best, options = state.require_best(), state.options
    score = state.records[best.number - 1].held_out_log_likelihood
    is_compared = options.estimator == "stillmap" and recording.dimension == 2
    if not is_compared or recording.T_odom_base is None or score is None:
        return None
    number, found = len(state.records) + 1, None
    for name, m_step in _sources(recording, state, score, progress, stages):
        started = time.perf_counter()
        progress("comparing with odometry and scans alone", number, 0, 0)
        tried = label_poses(recording, options, number, best.p_static, m_step, stages, started)
        reached = tried.record.held_out_log_likelihood
        if reached is not None and reached > score:
            record = dataclasses.replace(tried.record, source=name)
            found, score = dataclasses.replace(tried, record=record), reached
    return found


def _sources(
    recording: Recording,
    state: EmState,
    score: float,
    progress: Progress,
    stages: StageTimer,
) -> list[tuple[str, slam.MStepResult]]:
    """Names of sources that may be better, and their poses."""
    best, options = state.require_best(), state.options
    out = []
    with stages.measure("held_out"):
        odometry = _poses_by_odometry(recording)
        alone = _held_out(recording, odometry, best.p_static, options)
    if alone is not None and alone > score - _MAX_SHORTFALL * abs(score):
        empty = em.make_grid(2, options.slam.resolution)
        T = recording.n_scans
        m_step = slam.MStepResult(odometry, np.zeros((T, 3, 3)), empty, np.ones(T))
        out.append(("odometry", m_step))
    diagnostics = best.m_step.diagnostics
    n_faults = len(diagnostics.odometry_faults) + len(diagnostics.breaks)
    if n_faults > _MIN_FAULT_SHARE * recording.n_scans:
        with stages.measure("m_step"), limit_blas_threads():
            m_step = slam.m_step(
                recording.without_odometry(),
                best.p_static,
                options.slam,
                None,
                resolve_threads(options.threads),
                lambda stage, done, total: progress(stage, len(state.records) + 1, done, total),
                earlier_poses=best.poses,
                with_grid=False,
            )
        out.append(("scans", m_step))
    return out


def _poses_by_odometry(recording: Recording) -> Float:
    """(T, 3, 3) T_map_base; the first scan is the origin of the map."""
    T_odom_base = recording.T_odom_base
    assert T_odom_base is not None
    return se2.normalize(se2.inverse(T_odom_base[0]) @ T_odom_base)


def _held_out(
    recording: Recording, poses: Float, e: NDArray[np.float32], options: Options
) -> float | None:
    """Nats per beam of held-out scans at some poses with given labels."""
    threads = resolve_threads(options.threads)
    deskewed = slam.deskew_recording(recording, poses, options.slam, threads)
    return em.score_held_out_scans(
        deskewed, poses, e, options.slam.resolution, options.em.held_out, threads
    )
