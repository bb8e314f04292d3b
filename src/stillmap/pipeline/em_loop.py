"""The loop of Fig. 2: M-step, E-step, bound, repeat."""

import dataclasses
import time
from collections.abc import Iterator
from pathlib import Path

from stillmap import em, slam
from stillmap.core.array_types import Float, Float32
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.core.recording import Recording
from stillmap.pipeline.estimate import Estimate, Iteration, IterationRecord
from stillmap.pipeline.options import DEFAULTS, Options, resolve_options

_MAX_REFINED_SHARE = 0.2  # of the scans with changed labels: if more, all are matched anew


def iterate(
    recording: Recording,
    options: Options = DEFAULTS,
    *,
    poses: Float | None = None,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
    scratch: Path | None = None,
    previous: Estimate | None = None,
) -> Iterator[Iteration]:
    """Alternates the M-step and the E-step; the caller decides when to stop.

    Args:
        recording: at least one scan.
        options: see Options.
        poses: (T, D+1, D+1) T_map_base to keep instead of estimating them; near the origin.
        progress: called with the stage, the iteration, scans done, and of how many.
        stages: where time and memory per stage are noted.
        scratch: folder for per-beam arrays too large for memory, in anonymous files that the
            process's end deletes. None: the system's temporary folder.
        previous: estimate of an earlier iteration with the same arguments, to continue from.

    Yields:
        at most `options.em.max_iterations` iterations.

    Raises:
        ValueError: poses of another shape.
    """
    D = recording.dimension
    if poses is not None and poses.shape != (recording.n_scans, D + 1, D + 1):
        wanted = (recording.n_scans, D + 1, D + 1)
        raise ValueError(f"poses: expected {wanted}, got {poses.shape}")
    if scratch is not None:
        recording = dataclasses.replace(recording, scratch=scratch)
    stages, options = stages or StageTimer(), resolve_options(options, recording)
    first = 1 if previous is None else previous.number + 1
    for number in range(first, em.max_iterations(options.estimator, options.em) + 1):
        started = time.perf_counter()
        e = (  # e := p(c = 1)
            em.initial_p_static(recording, options.estimator, options.em)
            if previous is None
            else previous.p_static
        )
        with stages.measure("m_step"), limit_blas_threads():  # (9)-(15)
            m_step = _m_step(recording, e, previous, options, poses, progress)
        progress("labelling beams", number, 0, 0)
        iteration = label_poses(recording, options, number, e, m_step, stages, started)
        previous = iteration.estimate.for_next_iteration()
        del m_step  # grids are large: only the caller decides how long one lives
        yield iteration
        del iteration


def label_poses(
    recording: Recording,
    options: Options,
    number: int,
    e: Float32,
    m_step: slam.MStepResult,
    stages: StageTimer,
    started: float,
) -> Iteration:
    """The E-step at the poses of an M-step, and the numbers of the iteration.

    Args:
        recording: as recorded.
        options: resolved.
        number: of the iteration, from 1.
        e: (M,) weights of the beams in the M-step.
        m_step: its result.
        stages: where time and memory per stage are noted.
        started: `time.perf_counter()` before the M-step.
    """
    threads = resolve_threads(options.threads)
    deskewed = slam.deskew_recording(recording, m_step.poses, options.slam, threads)
    with stages.measure("e_step"):  # (6), and (8) or the occupancy HMM; the bound
        e_step = em.e_step(
            deskewed, m_step.poses, m_step.grid, options.estimator, options.em, threads
        )
    with stages.measure("held_out"):
        held_out = em.score_held_out_scans(
            deskewed,
            m_step.poses,
            e_step.p_static,
            options.slam.resolution,
            options.em.held_out if recording.dimension == 2 else 0,  # in 3D too much memory
            threads,
        )
    record = IterationRecord(
        number=number,
        expected_log_likelihood=e_step.likelihood.expected,  # (5)
        bound=e_step.likelihood.bound,
        changed_share=em.changed_share(e, e_step.p_static, recording.hit),
        seconds=time.perf_counter() - started,
        held_out_log_likelihood=held_out,
        touched_share=em.touched_share(recording, e, e_step.p_static),
    )
    return Iteration(Estimate(number, e, m_step, e_step), record, deskewed)


def _m_step(
    recording: Recording,
    e: Float32,
    before: Estimate | None,
    options: Options,
    poses: Float | None,
    progress: Progress,
) -> slam.MStepResult:
    """The most likely poses given e (9), and the sums of the map (10)-(15)."""
    number = 1 if before is None else before.number + 1
    return slam.m_step(
        recording,
        e,
        options.slam,
        poses,
        resolve_threads(options.threads),
        lambda stage, done, total: progress(stage, number, done, total),
        initial=before.m_step if before and _needs_refinement_only(recording, before) else None,
        earlier_poses=None if before is None else before.poses,
        with_grid=em.needs_counts(options.estimator),
        # (10) as printed counts beams up to their end
        free_space_margin=0.0 if options.estimator == "paper" else slam.FREE_SPACE_MARGIN,
    )


def _needs_refinement_only(recording: Recording, before: Estimate) -> bool:
    """True if the next M-step refines the poses of an iteration instead of matching all scans anew.

    So it does after two M-steps, if the labels of few scans changed since.
    """
    if before.number < 2 or before.m_step.graph is None:
        return False
    touched = em.touched_share(recording, before.weights, before.p_static)
    return touched < _MAX_REFINED_SHARE
