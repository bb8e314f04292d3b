"""EM: its state and history, and the loop of Fig. 2: M-step, E-step, bound, repeat."""

import dataclasses
import logging
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np

from stillmap import em, slam
from stillmap.core.array_types import Float, Float32
from stillmap.core.parallel import limit_blas_threads, resolve_threads
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.mapping.labelled_recording import sample_points
from stillmap.pipeline.options import DEFAULTS, Options, resolve_options
from stillmap.pipeline.snapshots import Snapshot, Window, choose_window, snapshot

log = logging.getLogger(__name__)

_MAX_REFINED_SHARE = 0.2  # of the scans with changed labels: if more, all are matched anew
# of the scans: if fewer are touched by a change of labels, the next M-step finds the same poses
_TOUCHED_SCANS = 0.1
_MAX_SNAPSHOT_SCANS = 500  # whose beams show free space; what is occupied the E-step has found


@dataclass(frozen=True, eq=False)
class Estimate(ShortRepr):
    """Estimate of one EM iteration: the results of its M-step and of its E-step.

    Attributes:
        number: iteration, from 1.
        weights: (M,) float32, the e that weighted the beams in the M-step; with the poses they
            reproduce the grid to the bit.
        m_step: poses, their covariance and diagnostics, loops, pose graph, and the sums of (10).
        e_step: P(c = 1) of every beam, the likelihood, and what the estimator learned.
    """

    number: int
    weights: Float32
    m_step: slam.MStepResult
    e_step: em.EStepResult

    @property
    def poses(self) -> Float:
        """(T, D+1, D+1) T_map_base."""
        return self.m_step.poses

    @property
    def p_static(self) -> Float32:
        """(M,) P(c = 1)."""
        return self.e_step.p_static

    @property
    def bound(self) -> float:
        """Lower bound of the log likelihood, nats."""
        return self.e_step.likelihood.bound

    def without_grid(self) -> "Estimate":
        """The same with an empty grid: grids are large, and poses and weights reproduce them."""
        return dataclasses.replace(self, m_step=self.m_step.without_grid())

    def for_next_iteration(self) -> "Estimate":
        """The initial state of the next iteration: poses and labels, without grid and cells."""
        labels = em.EStepResult(self.p_static, self.e_step.likelihood)
        return dataclasses.replace(self.without_grid(), e_step=labels)

    def with_labels(self, **changes: object) -> "Estimate":
        """The same with fields of the E-step replaced."""
        return dataclasses.replace(self, e_step=dataclasses.replace(self.e_step, **changes))  # type: ignore[arg-type]


@dataclass(frozen=True)
class IterationRecord:
    """The numbers of one iteration, as `run.json` lists them.

    Attributes:
        number: from 1.
        expected_log_likelihood: (5), nats.
        bound: expected_log_likelihood + entropy of the labels, nats.
        changed_share: share of the hits whose e changed by more than 0.1.
        seconds: wall clock.
        held_out_log_likelihood: nats per beam of scans left out of the map; None: not computed.
        touched_share: share of the scans that the next M-step may match differently.
    """

    number: int
    expected_log_likelihood: float
    bound: float
    changed_share: float
    seconds: float
    held_out_log_likelihood: float | None = None
    touched_share: float = 1.0


@dataclass(frozen=True, eq=False)
class Iteration(ShortRepr):
    """One M-step and one E-step.

    Attributes:
        estimate: see Estimate; its grid is filled where the estimator uses it.
        record: its numbers.
        deskewed: the recording without the motion during its scans, at these poses.
    """

    estimate: Estimate
    record: IterationRecord
    deskewed: Recording

    @property
    def occupancy(self) -> em.OccupancyMap:
        """The map of this iteration, computed at every call; every beam counts. 2D only."""
        estimate = self.estimate
        grid = em.make_grid(self.deskewed.dimension, estimate.m_step.grid.resolution)
        em.add_recording(grid, self.deskewed, estimate.poses, estimate.weights)
        return em.make_occupancy_map(grid, estimate.e_step.occupied)


@dataclass
class EmState(ShortRepr):
    """The history of a run: the numbers of all iterations, the arrays of the best and the last.

    Attributes:
        options: resolved.
        records: one per iteration.
        snapshots: a part of the map at the first, second, best and last iteration (Fig. 8).
        window: the part of the map that snapshots show, metres.
        best: estimate with the highest score so far, without its grid.
        latest: what the next iteration starts from.
        converged: whether a stopping rule holds.
        single_pass: stop after the first iteration: given poses leave nothing to iterate on.
    """

    options: Options
    records: list[IterationRecord] = field(default_factory=list)
    snapshots: dict[int, Snapshot] = field(default_factory=dict)
    window: Window | None = None
    best: Estimate | None = None
    latest: Estimate | None = None
    converged: bool = False
    single_pass: bool = False

    def update(self, iteration: Iteration) -> None:
        """Records an iteration, keeps its estimate if it is the best, checks convergence."""
        estimate, record, options = iteration.estimate, iteration.record, self.options.em
        n_beams, fixed = iteration.deskewed.n_beams, em.fixed_iterations(self.options.estimator)
        self.records.append(record)
        gain = np.inf
        if self.best is not None:
            kept = self.records[self.best.number - 1]
            gain = self._score(record, n_beams) - self._score(kept, n_beams)
        if gain > 0.0 or fixed:
            self.best = estimate.without_grid()
        self._take_snapshot(iteration)
        self.latest = estimate.for_next_iteration()
        converged = 0.0 <= gain < options.tolerance
        if self.options.estimator == "stillmap":  # the labels of (8) keep changing slightly
            converged |= record.touched_share < _TOUCHED_SCANS and options.label_tolerance > 0.0
            converged |= record.number > 1 and record.changed_share < options.label_tolerance
        out_of_patience = record.number - self.require_best().number >= options.patience
        self.converged = (
            record.number == fixed if fixed else converged or out_of_patience or self.single_pass
        )
        log.info(
            "iteration %d: bound %.6g, %.2f %% of the beams changed",
            record.number,
            record.bound,
            100.0 * record.changed_share,
        )

    def _score(self, record: IterationRecord, n_beams: int) -> float:
        """Nats per beam by which iterations are compared.

        The held-out likelihood, which means the same whatever the poses are; the bound without it,
        and for the printed method.
        """
        if self.options.estimator == "stillmap" and record.held_out_log_likelihood is not None:
            return record.held_out_log_likelihood
        return record.bound / max(n_beams, 1)

    def require_best(self) -> Estimate:
        """The best estimate; RuntimeError before the first iteration."""
        if self.best is None:
            raise RuntimeError("no iteration has been run")
        return self.best

    def _take_snapshot(self, iteration: Iteration) -> None:
        """Crops the map of Fig. 8 where the first iteration labelled most beams dynamic."""
        estimate, deskewed = iteration.estimate, iteration.deskewed
        if deskewed.dimension != 2:
            return
        resolution, poses = self.options.slam.resolution, estimate.poses
        boxes = em.beam_boxes(deskewed, poses)
        points = sample_points(deskewed, poses, estimate.p_static).astype(np.float32)
        if self.window is None:
            self.window = choose_window(_extent(boxes, resolution), resolution, points)
        shown = {1, 2, self.require_best().number}  # and the last, whichever that will be
        self.snapshots = {n: s for n, s in self.snapshots.items() if n in shown}
        occupied = estimate.e_step.occupied
        max_scans = None if occupied is None else _MAX_SNAPSHOT_SCANS
        grid = em.count_in_window(
            deskewed, poses, estimate.weights, boxes, self.window, resolution, max_scans
        )
        cells = _cells(self.window, resolution)
        part = em.make_occupancy_map(grid, occupied, window=cells)
        self.snapshots[estimate.number] = snapshot(estimate.number, part, points, self.window)


def _extent(boxes: Float, resolution: float) -> Window:
    """x0, y0, x1, y1 in metres of all cells that beams crossed; `boxes` (T, 4) around them."""
    low, high = boxes[:, :2].min(axis=0), boxes[:, 2:].max(axis=0)
    cells = np.concatenate([np.floor(low / resolution), np.floor(high / resolution) + 1.0])
    x0, y0, x1, y1 = (cells * resolution).tolist()
    return x0, y0, x1, y1


def _cells(window: Window, resolution: float) -> em.GridWindow:
    """The cells of a window whose edges lie between cells."""
    x0, y0, x1, y1 = np.round(np.array(window) / resolution).astype(np.int64).tolist()
    return em.GridWindow(np.array([x0, y0], np.int64), (y1 - y0, x1 - x0))


def iterate(
    recording: Recording,
    options: Options = DEFAULTS,
    *,
    poses: Float | None = None,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
    previous: Estimate | None = None,
) -> Iterator[Iteration]:
    """Alternates the M-step and the E-step; the caller decides when to stop.

    Args:
        recording: at least one scan.
        options: see Options.
        poses: (T, D+1, D+1) T_map_base to keep instead of estimating them; near the origin.
        progress: called with the stage, the iteration, scans done, and of how many.
        stages: where time and memory per stage are noted.
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
        iteration = _label_poses(recording, options, number, e, m_step, stages, started)
        previous = iteration.estimate.for_next_iteration()
        del m_step  # grids are large: only the caller decides how long one lives
        yield iteration
        del iteration


def _label_poses(
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
        earlier=None if before is None else before.m_step,
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
