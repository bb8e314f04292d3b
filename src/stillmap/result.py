"""Runs the loop to its end and keeps the best iterate."""

import dataclasses
import logging
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from stillmap import _core, em, pipeline, slam
from stillmap.cautions import cautions
from stillmap.changes import Change, beams_on_things, changed_places, relabelled
from stillmap.objects import MovingObject, Traffic, moving_objects, traffic
from stillmap.output.crops import Snapshot, Window, choose_window, snapshot
from stillmap.output.points import dynamic_points
from stillmap.output.save import save
from stillmap.pipeline import DEFAULTS, Iteration, Options, Progress
from stillmap.recording.model import Recording
from stillmap.stages import Stages
from stillmap.threads import resolved_threads

log = logging.getLogger(__name__)
Float = NDArray[np.float64]


@dataclass(frozen=True)
class IterationRecord:
    """The numbers of one iteration; see Iteration."""

    number: int
    expected_log_likelihood: float
    bound: float
    changed_share: float
    seconds: float
    held_out_log_likelihood: float | None = None


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

    def save(self, path: str | Path, *, overwrite: bool = False) -> None:
        """Writes the result folder, complete or not at all."""
        save(self, Path(path), overwrite)


def build(
    recording: Recording,
    options: Options = DEFAULTS,
    *,
    poses: Float | None = None,
    progress: Progress = pipeline.silent,
    stages: Stages | None = None,
    scratch: Path | None = None,
) -> Result:
    """The main job: iterates until the bound stops improving and keeps the best iterate.

    Args: see `stillmap.iterate`.

    Raises:
        OSError: the disk of `scratch` is full.
    """
    if recording.dimension != 2:
        raise ValueError(f"recording: expected 2 dimensions, got {recording.dimension}")
    if recording.n_scans == 0:
        raise ValueError("recording: expected at least one scan")
    if scratch is not None:
        recording = dataclasses.replace(recording, scratch=scratch)
    stages = stages or Stages()
    options = pipeline.resolved(options)
    run = _Run(options)
    iterations = pipeline.iterate(recording, options, poses=poses, progress=progress, stages=stages)
    while not run.finished and run.take_next(iterations, recording):
        pass
    return run.result(recording, stages)


@dataclass
class _Run:
    """What is kept while the loop runs: numbers of all iterations, arrays of the best alone.

    No grid is kept: poses and weights make it again, to the bit.
    """

    options: Options
    records: list[IterationRecord] = field(default_factory=list)
    snapshots: dict[int, Snapshot] = field(default_factory=dict)
    window: Window | None = None
    best: "_Best | None" = None
    finished: bool = False

    def take_next(self, iterations: Iterator[Iteration], recording: Recording) -> bool:
        """Runs one iteration; False when there is none left."""
        iteration = next(iterations, None)
        if iteration is None:
            return False
        self._take(iteration, recording)
        log.info(
            "iteration %d: bound %.6g, %.2f %% of the beams changed",
            iteration.number,
            iteration.likelihood.bound,
            100.0 * iteration.changed_share,
        )
        return True

    def _take(self, iteration: Iteration, recording: Recording) -> None:
        bound = iteration.likelihood.bound
        self.records.append(
            IterationRecord(
                iteration.number,
                iteration.likelihood.expected,
                bound,
                iteration.changed_share,
                iteration.seconds,
                iteration.held_out,
            )
        )
        gain = np.inf if self.best is None else bound - self.best.bound
        fixed = em.fixed_iterations(self.options.estimator)
        if gain > 0.0 or fixed:
            self.best = _Best.of(iteration)
        self._remember(iteration)
        options = self.options.em
        settled = 0.0 <= gain < options.tolerance * recording.n_beams
        if self.options.estimator == "stillmap":  # the printed labels creep
            settled |= iteration.number > 1 and iteration.changed_share < options.settled
        stuck = iteration.number - self.kept.number >= options.patience
        self.finished = iteration.number == fixed if fixed else settled or stuck

    @property
    def kept(self) -> "_Best":
        if self.best is None:
            raise RuntimeError("no iteration has been run")
        return self.best

    def _remember(self, iteration: Iteration) -> None:
        """A part of the map for Fig. 8: where the first iteration saw most movers."""
        points = dynamic_points(iteration.seen, iteration.poses, iteration.p_static)
        dynamic = np.zeros(len(points), dtype=np.float32)
        resolution = self.options.slam.resolution
        if self.window is None:
            self.window = choose_window(_extent(iteration.grid), resolution, points, dynamic)
        shown = {1, 2, self.kept.number}  # and the last, whichever that will be
        self.snapshots = {n: s for n, s in self.snapshots.items() if n in shown}
        part = iteration.part(_cells(self.window, resolution))
        self.snapshots[iteration.number] = snapshot(
            iteration.number, part, points, dynamic, self.window
        )

    def result(self, recording: Recording, stages: Stages) -> Result:
        threads = resolved_threads(self.options.threads)
        with stages.measure("changes"):
            seen = slam.deskewed(recording, self.kept.poses, self.options.slam)
            changes = self._settle(seen, threads)
        kept = self.kept
        with stages.measure("maps"):
            filtered = self._map(seen, threads)
            raw = _raw_map(seen, kept.poses, filtered, threads)
        with stages.measure("evidence"):
            evidence = em.evidence(
                seen,
                kept.poses,
                kept.p_static,
                filtered,
                kept.no_return,
                self.options.em,
                threads,
            )
        with stages.measure("objects"):
            moving = moving_objects(seen, kept.poses, kept.p_static, self.options.objects)
            things = beams_on_things(seen, kept.poses, kept.p_static, changes, filtered.resolution)
            moving = _without(moving, things)
            crossed = traffic(moving)
            del seen
        return Result(
            recording=recording,
            options=self.options,
            iterations=self.records,
            snapshots=[self.snapshots[n] for n in sorted(self.snapshots)],
            poses=kept.poses,
            covariance=kept.covariance,
            p_static=kept.p_static,
            map=filtered,
            raw_map=raw,
            evidence=evidence,
            best_iteration=kept.number,
            converged=self.finished,
            warnings=cautions(
                self.records,
                kept.number,
                kept.explained,
                kept.doubts,
                recording,
                self.options,
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

    def _settle(self, recording: Recording, threads: int) -> list[Change]:
        """The last E-step: labels of the map as it is shown, and the places that changed."""
        kept, options, cell = self.kept, self.options.em, self.options.slam.resolution
        if self.options.estimator != "stillmap" or not options.changes.enabled:
            return []
        if kept.occupied is None:
            raise RuntimeError("the default estimator knows its cells")
        courses = em.last_e_step(recording, kept.poses, cell, options, threads)
        changes = changed_places(courses, recording, cell, options.dwell.look, options.changes)
        p_static, occupied = relabelled(
            recording,
            kept.poses,
            kept.p_static,
            kept.occupied,
            courses,
            changes,
            self.options.output.map_state,
            threads,
        )
        learned = {**kept.learned, "changing": round(courses.share, 6)}
        self.best = dataclasses.replace(kept, p_static=p_static, occupied=occupied, learned=learned)
        return changes

    def _map(self, recording: Recording, threads: int) -> em.OccupancyMap:
        """Labels that follow from sums are beside those they were made from, others make them."""
        kept = self.kept
        makes = self.options.estimator in ("stillmap", "tracker")
        weights = kept.p_static if makes else kept.weights
        grid = _core.Grid2D(self.options.slam.resolution)
        seen = em.add_believed_first(grid, recording, kept.poses, weights, kept.no_return, threads)
        return em.occupancy_map(grid, kept.occupied, seen)


@dataclass(frozen=True, eq=False)
class _Best:
    """The best iteration so far, without its grid; see Iteration."""

    number: int
    bound: float
    poses: Float
    covariance: Float
    weights: NDArray[np.float32]
    p_static: NDArray[np.float32]
    occupied: em.CellProbabilities | None
    learned: dict[str, object]
    explained: Float
    doubts: slam.Doubts
    loops: list[slam.Closure]
    graph: slam.Graph | None
    no_return: em.NoReturn | None

    @classmethod
    def of(cls, iteration: Iteration) -> "_Best":
        return cls(
            iteration.number,
            iteration.likelihood.bound,
            iteration.poses,
            iteration.covariance,
            iteration.weights,
            iteration.p_static,
            iteration.occupied,
            iteration.learned,
            iteration.explained,
            iteration.doubts,
            iteration.loops,
            iteration.graph,
            iteration.no_return,
        )


def _without(objects: list[MovingObject], things: NDArray[np.intp]) -> list[MovingObject]:
    """The objects that are more than what stood somewhere, which is listed as a change."""
    moved = [one for one in objects if 2 * _common(one.beams, things) <= len(one.beams)]
    return [dataclasses.replace(one, id=k) for k, one in enumerate(moved)]


def _common(one: NDArray[np.intp], other: NDArray[np.intp]) -> int:
    """How many numbers two rising arrays have in common."""
    at = np.searchsorted(other, one)
    return int(np.count_nonzero(one[at < len(other)] == other[at[at < len(other)]]))


def _extent(grid: _core.Grid2D) -> Window:
    """x0, y0, x1, y1 in metres of all cells that beams crossed."""
    first_cell, (height, width) = grid.box()
    last = first_cell + np.array([width, height])
    x0, y0, x1, y1 = (np.concatenate([first_cell, last]) * grid.resolution).tolist()
    return x0, y0, x1, y1


def _cells(window: Window, resolution: float) -> em.Box:
    """The cells of a window whose edges lie between cells."""
    x0, y0, x1, y1 = np.round(np.array(window) / resolution).astype(np.int64).tolist()
    return em.Box(np.array([x0, y0], np.int64), (y1 - y0, x1 - x0))


def _raw_map(
    recording: Recording, poses: Float, filtered: em.OccupancyMap, threads: int
) -> em.OccupancyMap:
    grid = _core.Grid2D(filtered.resolution)
    em.add_recording(grid, recording, poses, None, threads)
    return em.occupancy_map(grid, box=filtered.box)
