"""What is kept while the loop runs: the numbers of all iterations, the arrays of the best alone."""

import logging
from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap import em, slam
from stillmap.core.recording import Recording
from stillmap.mapping.beam_statistics import dynamic_points
from stillmap.pipeline.em_loop import Iteration, Reached
from stillmap.pipeline.options import Options
from stillmap.pipeline.snapshots import Snapshot, Window, choose_window, snapshot

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
class Best:
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
    changed: em.Changed | None = None
    ground: em.Ground | None = None

    @classmethod
    def of(cls, iteration: Iteration) -> "Best":
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
            iteration.changed,
            iteration.ground,
        )


@dataclass
class Loop:
    """How far a run has come.

    No grid is kept: poses and weights make it again, to the bit.

    Attributes:
        closed: whether the first E-step is the last: at given poses the default one is closed.
    """

    options: Options
    records: list[IterationRecord] = field(default_factory=list)
    snapshots: dict[int, Snapshot] = field(default_factory=dict)
    window: Window | None = None
    best: "Best | None" = None
    finished: bool = False
    reached: Reached | None = None
    closed: bool = False

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
            self.best = Best.of(iteration)
        self._remember(iteration)
        self.reached = iteration.reached
        options = self.options.em
        settled = 0.0 <= gain < options.tolerance * recording.n_beams
        if self.options.estimator == "stillmap":  # the printed labels creep
            settled |= iteration.number > 1 and iteration.changed_share < options.settled
        stuck = iteration.number - self.kept.number >= options.patience
        self.finished = iteration.number == fixed if fixed else settled or stuck or self.closed

    @property
    def kept(self) -> "Best":
        if self.best is None:
            raise RuntimeError("no iteration has been run")
        return self.best

    def _remember(self, iteration: Iteration) -> None:
        """A part of the map for Fig. 8: where the first iteration saw most movers."""
        if not isinstance(iteration.grid, _core.Grid2D):
            return
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
