"""Runs the loop to its end and keeps the best iterate."""

import dataclasses
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap import em, slam
from stillmap.core.parallel import one_blas_thread, resolved_threads
from stillmap.core.profiling import Stages
from stillmap.core.recording import Recording
from stillmap.em import Ground, ground_of
from stillmap.mapping import Change, beams_on_things, changed_places, changed_things, relabelled
from stillmap.mapping.projection import columns_of, plan_of
from stillmap.pipeline import em_loop
from stillmap.pipeline.diagnostics import cautions
from stillmap.pipeline.em_loop import Progress
from stillmap.pipeline.options import DEFAULTS, Options, resolved
from stillmap.pipeline.progress import Best, IterationRecord, Loop
from stillmap.pipeline.snapshots import Snapshot
from stillmap.results.model_protocols import ModelsLike
from stillmap.results.save import save
from stillmap.tracking import MovingObject, Traffic, moving_objects, traffic
from stillmap.tracking.objects_3d import moving_in_space

Float = NDArray[np.float64]


__all__ = ["IterationRecord", "Result", "build"]


@dataclass(frozen=True, eq=False)
class Result:
    """What stillmap found out about a recording of T scans with M beams.

    Attributes:
        recording: what it was made from.
        options: every option as resolved.
        iterations: the numbers of every iteration.
        snapshots: a part of the map at the first, second, best and last iteration (Fig. 8).
        poses: (T, 3, 3) T_map_base of the best iteration.
        covariance: (T, 3, 3) of x, y, heading against the map so far.
        p_static: (M,) float32, P(c = 1); it follows from `map` by a last E-step. NaN: unusable.
        map: what stands still.
        raw_map: every hit counted as static, from the same poses; the same cells as `map`.
        evidence: the looks that each of these cells rests on.
        best_iteration: number of the iteration that was kept.
        converged: whether the loop stopped by itself.
        warnings: one sentence each.
        learned: what the estimator learned from the recording, JSON-able.
        loops: attempts at closing loops in the best iteration, accepted or refused.
        doubts: where odometry and scans do not agree.
        graph: the pose graph of these loops; None where poses were given or none were looked for.
        objects: what moved, in the order in which it was first seen.
        traffic: how often each square of the floor was crossed by them.
        changes: places where something came to stay, left, or comes and goes.
        stages: seconds and peak memory.
    """

    recording: Recording
    options: Options
    iterations: list[IterationRecord]
    snapshots: list[Snapshot]
    poses: Float
    covariance: Float
    p_static: NDArray[np.float32]
    map: em.OccupancyMap
    raw_map: em.OccupancyMap
    evidence: em.Evidence
    best_iteration: int
    converged: bool
    warnings: list[str]
    learned: dict[str, object]
    loops: list[slam.Closure]
    doubts: slam.Doubts
    graph: slam.Graph | None
    objects: list[MovingObject]
    traffic: Traffic
    changes: list[Change]
    stages: Mapping[str, Mapping[str, Any]]

    @property
    def seen(self) -> Recording:
        """The recording without the motion during its scans, made anew at every call.

        Its points with `poses` make the map; where beams have no times it is `recording` itself.
        """
        return slam.deskewed(self.recording, self.poses, self.options.slam)

    def save(
        self, path: str | Path, *, overwrite: bool = False, models: ModelsLike | None = None
    ) -> None:
        """Writes the result folder, complete or not at all; with what `models_of` made."""
        save(self, Path(path), overwrite, models=models)


@one_blas_thread()
def build(
    recording: Recording,
    options: Options = DEFAULTS,
    *,
    poses: Float | None = None,
    progress: Progress = em_loop.silent,
    stages: Stages | None = None,
    scratch: Path | None = None,
    go_on: Loop | None = None,
    keep: Callable[[Loop], None] | None = None,
) -> Result:
    """The main job: iterates until the bound stops improving and keeps the best iterate.

    Args:
        recording, options, poses, progress, stages, scratch: see `stillmap.iterate`.
        go_on: how far an earlier run of the same came.
        keep: called with how far this one has come, after every iteration.

    Raises:
        OSError: the disk of `scratch` is full.
    """
    if recording.n_scans == 0:
        raise ValueError("recording: expected at least one scan")
    if scratch is not None:
        recording = dataclasses.replace(recording, scratch=scratch)
    stages = stages or Stages()
    options = resolved(options, recording)
    loop = go_on or Loop(options)
    # with given poses nothing is left that an E-step in space could depend on
    loop.closed = recording.dimension == 3 and poses is not None and options.estimator == "stillmap"
    iterations = em_loop.iterate(
        recording, options, poses=poses, progress=progress, stages=stages, after=loop.reached
    )
    while not loop.finished and loop.take_next(iterations, recording):
        if keep is not None:
            keep(loop)
    return _result(loop, recording, progress, stages)


def _result(loop: Loop, recording: Recording, progress: Progress, stages: Stages) -> Result:
    """What follows from the best iteration."""
    options, threads = loop.options, resolved_threads(loop.options.threads)
    progress("labelling beams", 0, 0, 0)
    with stages.measure("changes"):
        seen = slam.deskewed(recording, loop.kept.poses, options.slam, threads)
        kept, changes = _settled(loop.kept, seen, options, threads)
    progress("making the map", 0, 0, 0)
    with stages.measure("maps"):
        flat, plan, ground = kept, seen, None
        if seen.dimension == 3:
            ground = kept.ground or ground_of(seen, kept.poses, kept.p_static, threads)
            flat, plan = _in_plan(kept, seen, ground, options, threads)
        filtered, raw = _maps(flat, plan, options, threads)
    progress("counting looks", 0, 0, 0)
    with stages.measure("evidence"):
        evidence = em.evidence(
            plan, flat.poses, flat.p_static, filtered, flat.no_return, options.em, threads
        )
    progress("following what moves", 0, 0, 0)
    with stages.measure("objects"):
        if ground is not None:
            moving = moving_in_space(
                seen, kept.poses, kept.p_static, ground, options.objects, threads
            )
        else:
            moving = moving_objects(seen, kept.poses, kept.p_static, options.objects)
            things = beams_on_things(seen, kept.poses, kept.p_static, changes, filtered.resolution)
            moving = _without(moving, things)
        crossed = traffic(moving)
        del seen, plan, flat
    return Result(
        recording=recording,
        options=options,
        iterations=loop.records,
        snapshots=[loop.snapshots[n] for n in sorted(loop.snapshots)],
        poses=kept.poses,
        covariance=kept.covariance,
        p_static=kept.p_static,
        map=filtered,
        raw_map=raw,
        evidence=evidence,
        best_iteration=kept.number,
        converged=loop.finished,
        warnings=cautions(
            loop.records, kept.number, kept.explained, kept.doubts, recording, options
        ),
        learned=kept.learned,
        loops=kept.loops,
        doubts=kept.doubts,
        graph=kept.graph,
        objects=moving,
        traffic=crossed,
        changes=changes,
        stages=stages.to_dict(),
    )


def _settled(
    kept: Best, recording: Recording, options: Options, threads: int
) -> tuple[Best, list[Change]]:
    """The last E-step: labels of the map as it is shown, and the places that changed.

    In space every E-step knows of them.
    """
    cell, look = options.slam.resolution, options.em.dwell.look
    if kept.changed is not None:
        seen = recording, kept.poses
        return kept, changed_things(kept.changed, *seen, cell, look, options.em.changes)
    if (
        recording.dimension == 3
        or options.estimator != "stillmap"
        or not (options.em.dwell.views or options.em.changes.enabled)
    ):
        return kept, []
    found, courses = em.last_e_step(recording, kept.poses, cell, options.em, threads)
    if found is not None:
        kept = dataclasses.replace(
            kept, p_static=found.p_static, occupied=found.occupied, learned=found.learned
        )
    if courses is None:
        return kept, []
    if kept.occupied is None:
        raise RuntimeError("the default estimator knows its cells")
    changes = changed_places(courses, recording, cell, look, options.em.changes)
    p_static, occupied = relabelled(
        recording,
        kept.poses,
        kept.p_static,
        kept.occupied,
        courses,
        changes,
        options.output.map_state,
        threads,
    )
    learned = {**kept.learned, "changing": round(courses.share, 6)}
    kept = dataclasses.replace(kept, p_static=p_static, occupied=occupied, learned=learned)
    return kept, changes


def _in_plan(
    kept: Best, recording: Recording, ground: Ground, options: Options, threads: int
) -> tuple[Best, Recording]:
    """The same as a planar recording: what is in the robot's way."""
    cell, band = options.slam.resolution, options.output.band
    plan = plan_of(recording, kept.poses, ground, band, cell, open_space=False, threads=threads)
    occupied = kept.occupied
    if occupied is not None:
        occupied = columns_of(occupied, ground, band, cell)
    flat = dataclasses.replace(
        kept,
        poses=plan.poses,
        weights=kept.weights[plan.beam],
        p_static=kept.p_static[plan.beam],
        occupied=occupied,
        no_return=None,
    )
    return flat, plan.recording


def _maps(
    kept: Best, recording: Recording, options: Options, threads: int
) -> tuple[em.OccupancyMap, em.OccupancyMap]:
    """The map, and the same with every hit counted as static.

    Labels that follow from sums are beside those they were made from, others make them.
    """
    makes = options.estimator in ("stillmap", "tracker")
    weights = kept.p_static if makes else kept.weights
    grid = _core.Grid2D(options.slam.resolution)
    seen = em.add_believed_first(grid, recording, kept.poses, weights, kept.no_return, threads)
    filtered = em.occupancy_map(grid, kept.occupied, seen)
    em.count_as_static(grid, recording, kept.poses, weights)
    return filtered, em.occupancy_map(grid, box=filtered.box)


def _without(objects: list[MovingObject], things: NDArray[np.intp]) -> list[MovingObject]:
    """The objects that are more than what stood somewhere, which is listed as a change."""
    moved = [one for one in objects if 2 * _common(one.beams, things) <= len(one.beams)]
    return [dataclasses.replace(one, id=k) for k, one in enumerate(moved)]


def _common(one: NDArray[np.intp], other: NDArray[np.intp]) -> int:
    """How many numbers two rising arrays have in common."""
    at = np.searchsorted(other, one)
    return int(np.count_nonzero(one[at < len(other)] == other[at[at < len(other)]]))
