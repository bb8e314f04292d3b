"""The main job and its result: EM to convergence, then all that follows from the best estimate."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from stillmap import em, slam
from stillmap.core.array_types import Float, Float32
from stillmap.core.parallel import limit_blas_threads, resolve_threads, trim_heap, work_beside
from stillmap.core.profiling import Progress, StageTimer, no_progress
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.mapping import Change, Door
from stillmap.pipeline.calibration import correct_recording
from stillmap.pipeline.diagnostics import find_map_warnings, find_warnings
from stillmap.pipeline.em_loop import EmState, Estimate, Iteration, IterationRecord, iterate
from stillmap.pipeline.final_map import FinalEstimate, Maps, final_estimate, find_objects, make_maps
from stillmap.pipeline.map_frame import enter_local_frame, leave_local_frame, move_odometry
from stillmap.pipeline.options import DEFAULTS, Options, resolve_options
from stillmap.pipeline.quality import Quality, rate_quality
from stillmap.pipeline.snapshots import Snapshot
from stillmap.slam.mount_calibration import Calibration
from stillmap.tracking import FlowMap, MovingObject, compute_flow_map


@dataclass(frozen=True, eq=False)
class MappingResult(ShortRepr):
    """A mapped recording of T scans with M beams; `stillmap.Result` adds saving.

    Attributes:
        recording: the input, calibrated.
        options: every option as resolved.
        iterations: the numbers of every iteration.
        snapshots: a part of the map at the first, second, best and last iteration (Fig. 8).
        estimate: the best iteration, with the labels of a last E-step at `maps.filtered`.
        maps: of what is static, of every hit counted as static, and the observation counts.
        converged: whether the loop stopped by itself.
        warnings: one sentence each.
        objects: moving objects, in the order in which they were first observed.
        traffic: how often objects crossed each square of the floor.
        changes: places where something appeared, disappeared, or comes and goes.
        doors: those that swung, which are changes, too, and those seen in one position only.
        stages: seconds and peak memory.
        calibration: poses of the lasers and errors of odometry, as the motion shows them.
        quality: of labels and geometry, from 0 to 100.
        origin: (3,) m, of the frame in which it was computed; all here is in the map frame.
        local: the same in that frame; None: it is the map frame.
    """

    recording: Recording
    options: Options
    iterations: list[IterationRecord]
    snapshots: list[Snapshot]
    estimate: Estimate
    maps: Maps
    converged: bool
    warnings: list[str]
    objects: list[MovingObject]
    traffic: FlowMap
    changes: list[Change]
    doors: list[Door]
    stages: Mapping[str, Mapping[str, Any]]
    calibration: Calibration = field(default_factory=Calibration)
    quality: Quality = field(default_factory=Quality)
    origin: Float = field(default_factory=lambda: np.zeros(3))
    local: "MappingResult | None" = field(default=None, repr=False)

    @property
    def near(self) -> "MappingResult":
        """The same in a frame near the robot, where coordinates of 32 bits are precise."""
        return self if self.local is None else self.local

    @property
    def poses(self) -> Float:
        """(T, D+1, D+1) T_map_base."""
        return self.estimate.poses

    @property
    def p_static(self) -> Float32:
        """(M,) P(c = 1); NaN: unusable, the prior at maximum range."""
        return self.estimate.p_static

    @property
    def map(self) -> em.OccupancyMap:
        """The map of what is static."""
        return self.maps.filtered

    @property
    def raw_map(self) -> em.OccupancyMap:
        """The same cells with every hit counted as static."""
        return self.maps.raw

    @property
    def evidence(self) -> em.Coverage:
        """Observation counts of the same cells."""
        return self.maps.evidence

    @property
    def best_iteration(self) -> int:
        """Number of the iteration that was kept."""
        return self.estimate.number

    @property
    def learned(self) -> dict[str, object]:
        """Parameters that the E-step fitted to the recording, as JSON values."""
        return self.estimate.e_step.learned

    @property
    def loops(self) -> list[slam.LoopClosure]:
        """Attempts at closing loops, accepted or rejected."""
        return self.estimate.m_step.loops

    @property
    def doubts(self) -> slam.Diagnostics:
        """Scans where odometry and scan matching disagree."""
        return self.estimate.m_step.diagnostics

    @property
    def graph(self) -> slam.PoseGraph | None:
        """The pose graph; None where poses were given or loops were not looked for."""
        return self.estimate.m_step.graph

    @property
    def deskewed(self) -> Recording:
        """The recording without the motion during its scans, computed at every call.

        Where beams have no times it is `recording` itself.
        """
        return slam.deskew_recording(self.recording, self.poses, self.options.slam)


@limit_blas_threads()
def map_recording(
    recording: Recording,
    options: Options = DEFAULTS,
    *,
    poses: Float | None = None,
    origin: Float | None = None,
    progress: Progress = no_progress,
    stages: StageTimer | None = None,
    scratch: Path | None = None,
    resume: EmState | None = None,
    checkpoint: Callable[[EmState], None] | None = None,
) -> MappingResult:
    """Maps a recording: EM until the bound stops improving, then maps, changes and objects.

    First, sweeps without beam times get some where they are distorted, and without given poses,
    mounts of the lasers and errors of odometry are calibrated. All is computed in a frame near the
    robot, the one of the first scan where poses are estimated.

    Args:
        recording, options, poses, progress, stages, scratch: see `stillmap.iterate`.
        origin: (3,) m, of the frame near the robot, with poses; None: the first of them.
        resume: state of an interrupted run with the same arguments.
        checkpoint: called with the state, in the frame near the robot, after every iteration.

    Raises:
        ValueError: a recording without scans, or poses of another shape.
        OSError: the disk of `scratch` is full.
    """
    if recording.n_scans == 0:
        raise ValueError("recording: expected at least one scan")
    if scratch is not None:
        recording = dataclasses.replace(recording, scratch=scratch)
    stages = stages or StageTimer()
    options = resolve_options(options, recording)
    origin, odometry, recording, poses = enter_local_frame(recording, poses, origin)
    progress("calibrating", 0, 0, 0)
    with stages.measure("calibration"):
        recording, options, calibration, notes = correct_recording(recording, options, poses)
    state = resume or EmState(options)
    state.options = options  # a checkpoint has those from before the direction of spin was found
    # given poses leave nothing to iterate on in 3D, where the E-step does not depend on the labels
    is_3d = recording.dimension == 3
    state.single_pass = is_3d and poses is not None and options.estimator == "stillmap"
    steps = iterate(
        recording,
        options,
        poses=poses,
        progress=progress,
        stages=stages,
        previous=state.latest,
    )
    _run_em(steps, state, checkpoint)
    result = _finish(state, recording, progress, stages)
    warnings = [*result.warnings, *notes]
    recording = move_odometry(recording, odometry)
    result = dataclasses.replace(
        result, recording=recording, calibration=calibration, warnings=warnings
    )
    parts = ("snapshots", "estimate", "maps", "objects", "traffic", "changes", "doors")
    fields: dict[type, dict[str, str]] = {MappingResult: dict.fromkeys(parts, "part")}
    moved = leave_local_frame(result, origin, result.map, fields)
    return dataclasses.replace(moved, origin=origin)


def _run_em(
    steps: Iterator[Iteration], state: EmState, checkpoint: Callable[[EmState], None] | None
) -> None:
    """Iterates until a stopping rule holds."""
    while not state.converged and (iteration := next(steps, None)) is not None:
        state.update(iteration)
        del iteration  # its grid is large
        trim_heap()
        if checkpoint is not None:
            checkpoint(state)


def _finish(
    state: EmState, recording: Recording, progress: Progress, stages: StageTimer
) -> MappingResult:
    """Computes final labels, maps, objects and changes from the best estimate."""
    options = state.options
    progress("labelling beams", 0, 0, 0)
    with stages.measure("changes"):
        final = final_estimate(recording, state.require_best(), options)
    trim_heap()
    estimate = final.estimate
    maps = make_maps(final, options, progress, stages)
    trim_heap()
    objects, quality = _track_and_rate(final, maps, options, progress, stages)
    changes, doors = final.changes, final.doors
    del final
    trim_heap()
    return MappingResult(
        recording=recording,
        options=options,
        iterations=state.records,
        snapshots=[state.snapshots[n] for n in sorted(state.snapshots)],
        estimate=estimate,
        maps=maps,
        converged=state.converged,
        warnings=[
            *find_warnings(estimate, recording),
            *find_map_warnings(maps, recording, estimate.poses),
        ],
        objects=objects,
        traffic=compute_flow_map(objects),
        changes=changes,
        doors=doors,
        stages=stages.to_dict(),
        quality=quality,
    )


def _track_and_rate(
    final: FinalEstimate, maps: Maps, options: Options, progress: Progress, stages: StageTimer
) -> tuple[list[MovingObject], Quality]:
    """Moving objects, and the quality of the result.

    Both are mostly serial. In 3D, where little of it holds Python's lock, they share the
    processors; the stage "quality" is then what is left of it after the objects.
    """
    progress("tracking objects", 0, 0, 0)
    threads = resolve_threads(options.threads)
    deskewed, estimate = final.deskewed, final.estimate
    labels = (estimate.poses, estimate.p_static, maps.filtered)
    rate = partial(rate_quality, deskewed, *labels, threads)
    with work_beside(rate, threads if deskewed.dimension == 3 else 1) as rated:
        with stages.measure("objects"):
            objects = find_objects(final, maps, options)
        progress("rating the map", 0, 0, 0)
        with stages.measure("quality"):
            return objects, rated()
