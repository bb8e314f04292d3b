"""The loop of Fig. 2: M-step, E-step, bound, repeat."""

import dataclasses
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from stillmap import em, slam
from stillmap.core.parallel import one_blas_thread, resolved_threads
from stillmap.core.profiling import Stages
from stillmap.core.recording import Recording
from stillmap.pipeline.options import DEFAULTS, Options, resolved

Float = NDArray[np.float64]

# what, iteration (0: after the last), scans done, of how many (0: not counted)
Progress = Callable[[str, int, int, int], None]


def silent(what: str, iteration: int, done: int, total: int) -> None:
    """Reports progress to nobody."""


@dataclass(frozen=True, eq=False)
class Reached:
    """What an iteration leaves to the next one.

    Attributes:
        number: of the iteration, 0 before the first.
        p_static: (M,) float32, e.
        mapped: its M-step without the grid; None before the first.
    """

    number: int
    p_static: NDArray[np.float32]
    mapped: slam.Mapped | None


@dataclass(frozen=True, eq=False)
class Iteration:
    """One M-step and one E-step.

    Attributes:
        number: from 1.
        seen: the recording without the motion during its scans, as `poses` have it.
        poses: (T, D+1, D+1) T_map_base.
        covariance: (T, 3, 3) of x, y, heading against the map so far.
        grid: the sums alpha, beta of (10).
        weights: (M,) float32, the e that this M-step used; with `poses` they make `grid` again.
        p_static: (M,) float32, e after this iteration's E-step.
        likelihood: of the recording after this E-step, for the printed method (5) and its bound.
        occupied: what the estimator knows of cells beyond the sums, see CellProbabilities.
        learned: what it learned from the recording.
        changed_share: share of hits whose e moved by more than 0.1.
        explained: (T,) share of each scan's beams that the map so far explained.
        doubts: scans where odometry and the map so far do not agree.
        loops: attempts at closing loops, accepted or refused.
        held_out: nats per beam, see `em.held_out_log_likelihood`; None where it is not computed.
        seconds: wall clock.
        graph: the pose graph of these loops; None where poses were given or none were looked for.
        no_return, changed, ground: see `em.Expectations`.
    """

    number: int
    seen: Recording
    poses: Float
    covariance: Float
    grid: em.Grid
    weights: NDArray[np.float32]
    p_static: NDArray[np.float32]
    likelihood: em.Likelihood
    occupied: em.CellProbabilities | None
    learned: dict[str, object]
    changed_share: float
    explained: Float
    doubts: slam.Doubts
    loops: list[slam.Closure]
    held_out: float | None
    seconds: float
    graph: slam.Graph | None = None
    no_return: em.NoReturn | None = None
    changed: em.Changed | None = None
    ground: em.Ground | None = None

    @property
    def reached(self) -> Reached:
        """What the next one begins with."""
        doubts = self.doubts
        mapped = slam.Mapped(
            self.poses,
            self.covariance,
            type(self.grid)(self.grid.resolution),  # grids are large
            self.explained,
            doubts.widened,
            doubts.disagreeing,
            doubts.breaks,
            doubts.apart,
            self.loops,
            self.graph,
        )
        return Reached(self.number, self.p_static, mapped)

    @property
    def occupancy(self) -> em.OccupancyMap:
        """The map of this iteration, made anew at every call; every beam is believed. 2D only."""
        return em.occupancy_map(self.grid, self.occupied)

    def part(self, box: em.Box) -> em.OccupancyMap:
        """The cells of a box of that map."""
        return em.occupancy_map(self.grid, self.occupied, box=box)


def iterate(
    recording: Recording,
    options: Options = DEFAULTS,
    *,
    poses: Float | None = None,
    progress: Progress = silent,
    stages: Stages | None = None,
    scratch: Path | None = None,
    after: Reached | None = None,
) -> Iterator[Iteration]:
    """Interleaves mapping and the estimation of what is static; the caller decides when to stop.

    Args:
        recording: at least one scan.
        options: see Options.
        poses: (T, D+1, D+1) T_map_base to keep instead of estimating them.
        progress: called with what is done, the iteration, scans done, and of how many; these are 0
            for what is not counted.
        stages: where time and memory per stage are noted.
        scratch: folder for what is known of each beam where that is too large for memory; such
            files have no name and are gone with the process. None: the system's temporary folder.
        after: an iteration of the same recording, options and poses, to go on from.

    Yields:
        one Iteration after the other, `options.em.max_iterations` of them at most.
    """
    D = recording.dimension
    if poses is not None and poses.shape != (recording.n_scans, D + 1, D + 1):
        wanted = (recording.n_scans, D + 1, D + 1)
        raise ValueError(f"poses: expected {wanted}, got {poses.shape}")
    if scratch is not None:
        recording = dataclasses.replace(recording, scratch=scratch)
    stages = stages or Stages()
    options = resolved(options, recording)
    threads = resolved_threads(options.threads)
    if after is None:  # e := p(c = 1)
        e = em.initial_expectations(recording, options.estimator, options.em)
        after = Reached(0, e, None)
    for number in range(after.number + 1, em.iterations(options.estimator, options.em) + 1):
        started = time.perf_counter()
        e, before = after.p_static, after.mapped
        # the first labels change most: from the second poses on, a sweep follows what is left
        start = before if after.number > 1 else None
        with stages.measure("m_step"), one_blas_thread():  # (9)-(15)
            mapped = slam.m_step(
                recording,
                e,
                options.slam,
                poses,
                threads,
                _at(progress, number),
                start=start,
                before=None if before is None else before.poses,
                sums=em.needs_sums(D, options.estimator),
            )
            seen = slam.deskewed(recording, mapped.poses, options.slam, threads)
        progress("labelling beams", number, 0, 0)
        with stages.measure("e_step"):  # (6), (8) or its successor, and the bound
            found = em.e_step(
                seen, mapped.poses, mapped.grid, options.estimator, options.em, threads
            )
        with stages.measure("held_out"):
            held_out = em.held_out_log_likelihood(
                seen,
                mapped.poses,
                found.p_static,
                options.slam.resolution,
                options.em.held_out if D == 2 else 0,  # lengths through all voxels: too large
                threads,
            )
        iteration = Iteration(
            number=number,
            seen=seen,
            poses=mapped.poses,
            covariance=mapped.covariance,
            grid=mapped.grid,
            weights=e,
            p_static=found.p_static,
            likelihood=found.likelihood,
            occupied=found.occupied,
            learned=found.learned,
            changed_share=em.changed_share(e, found.p_static, recording.hit),
            explained=mapped.explained,
            doubts=mapped.doubts,
            loops=mapped.loops,
            held_out=held_out,
            seconds=time.perf_counter() - started,
            graph=mapped.graph,
            no_return=found.no_return,
            changed=found.changed,
            ground=found.ground,
        )
        after = iteration.reached
        del mapped, found, seen  # grids are large: only the caller decides how long one lives
        yield iteration
        del iteration


def _at(progress: Progress, number: int) -> slam.Told:
    return lambda what, done, total: progress(what, number, done, total)
