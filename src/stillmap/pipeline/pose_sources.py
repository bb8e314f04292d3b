"""Poses compared with those of odometry, alone or in stretches.

EM starts from odometry and improves on it scan by scan. Where most of what the robot sees is people
it may end farther from the truth than odometry was. Held-out scans tell: they are predicted by the
map of the other scans (`em.quality`).
"""

import dataclasses
import time
from collections.abc import Iterator

import numpy as np

from stillmap import em, slam
from stillmap.core import se2
from stillmap.core.array_types import Float, Float32
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer
from stillmap.core.recording import Recording
from stillmap.pipeline.em_loop import EmState, Iteration, IterationRecord, label_poses
from stillmap.pipeline.options import Options
from stillmap.slam.odometry_faults import replace_stretches

# odometry gets an E-step of its own if its score with the labels so far falls short of the best
# one by less than this share of it; labels of its own raise it
_MAX_SHORTFALL = 0.4
# likewise in stretches, before the scans are matched with the labels found there
_MAX_STRETCH_SHORTFALL = 0.15
_STRETCHES, _SAME_SCORE = "odometry_in_stretches", 0.01


def better_source(
    recording: Recording, state: EmState, progress: Progress, stages: StageTimer
) -> Iteration | None:
    """The source of poses that predicts held-out scans best, if better than the best iteration.

    Sources are odometry alone, and scan matching after labels were estimated with
    the motion of odometry in the stretches in which both differ.

    Args:
        recording: as recorded.
        state: of an EM that has converged.
        progress: called with the stage, the iteration, scans done, and of how many.
        stages: where time and memory per stage are noted.

    Returns:
        An iteration at its poses, numbered after the last one; None where the best iteration is
        better than all of them, where there is no odometry, or where iterations are not compared
        by held-out scans.
    """
    best, options = state.require_best(), state.options
    record = state.records[best.number - 1]
    score = record.held_out_log_likelihood
    is_compared = options.estimator == "stillmap" and recording.dimension == 2
    if not is_compared or recording.T_odom_base is None or score is None:
        return None
    number, found = len(state.records) + 1, None
    for name, e, m_step in _sources(recording, state, score, progress, stages):
        started = time.perf_counter()
        progress("comparing with odometry and scans alone", number, 0, 0)
        tried = label_poses(recording, options, number, e, m_step, stages, started)
        if _is_better(tried.record, record, name):
            record = dataclasses.replace(tried.record, source=name)
            found = dataclasses.replace(tried, record=record)
    return found


def _is_better(tried: IterationRecord, best: IterationRecord, source: str) -> bool:
    """True if a source is better than the best iteration.

    A stretch is predicted by the scans between the ones that are held out, which lie wrong with
    them. There, about the same prediction is enough if the bound, which is over all scans, rises.
    """
    reached, score = tried.held_out_log_likelihood, best.held_out_log_likelihood
    if reached is None or score is None:
        return False
    if source == _STRETCHES:
        return reached > score - _SAME_SCORE * abs(score) and tried.bound > best.bound
    return reached > score


def _sources(
    recording: Recording, state: EmState, score: float, progress: Progress, stages: StageTimer
) -> Iterator[tuple[str, Float32, slam.MStepResult]]:
    """Names of sources that may be better, the weights of their beams, and their poses."""
    best, options = state.require_best(), state.options
    assert recording.T_odom_base is not None
    with stages.measure("held_out"):
        odometry = _poses_by_odometry(recording)
        alone = _held_out(recording, odometry, best.p_static, options)
    if alone is not None and alone > score - _MAX_SHORTFALL * abs(score):
        yield "odometry", best.p_static, _keep_poses(odometry, options)
    diagnostics = best.m_step.diagnostics
    mixed = replace_stretches(
        best.poses, recording.T_odom_base, recording.stamp_ns, diagnostics, options.slam.odometry
    )
    if mixed is not None:
        number, started = len(state.records) + 1, time.perf_counter()
        m_step = _keep_poses(mixed, options)
        tried = label_poses(recording, options, number, best.p_static, m_step, stages, started)
        alone = tried.record.held_out_log_likelihood
        if alone is not None and alone > score - _MAX_STRETCH_SHORTFALL * abs(score):
            e = tried.estimate.p_static  # those who walked along with the robot are dynamic
            yield _STRETCHES, e, _match_scans(recording, e, mixed, state, progress, stages)


def _keep_poses(poses: Float, options: Options) -> slam.MStepResult:
    """An M-step at given poses (T, 3, 3)."""
    T = len(poses)
    empty = em.make_grid(2, options.slam.resolution)
    return slam.MStepResult(poses, np.zeros((T, 3, 3)), empty, np.ones(T))


def _match_scans(
    recording: Recording,
    e: Float32,
    earlier_poses: Float,
    state: EmState,
    progress: Progress,
    stages: StageTimer,
) -> slam.MStepResult:
    """An M-step over all scans given e (M,)."""
    options = state.options
    with stages.measure("m_step"), limit_blas_threads():
        return slam.m_step(
            recording,
            e,
            options.slam,
            None,
            resolve_threads(options.threads),
            lambda stage, done, total: progress(stage, len(state.records) + 1, done, total),
            earlier_poses=earlier_poses,
            with_grid=False,
        )


def _poses_by_odometry(recording: Recording) -> Float:
    """(T, 3, 3) T_map_base; the first scan is the origin of the map."""
    T_odom_base = recording.T_odom_base
    assert T_odom_base is not None
    return se2.normalize(se2.inverse(T_odom_base[0]) @ T_odom_base)


def _held_out(recording: Recording, poses: Float, e: Float32, options: Options) -> float | None:
    """Nats per beam of held-out scans at some poses with given labels."""
    threads = resolve_threads(options.threads)
    deskewed = slam.deskew_recording(recording, poses, options.slam, threads)
    return em.score_held_out_scans(
        deskewed, poses, e, options.slam.resolution, options.em.held_out, threads
    )
