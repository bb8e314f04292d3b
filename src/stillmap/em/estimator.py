"""The E-step by whichever estimator was chosen, and the sums of (10) over whole recordings."""

from typing import Literal

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.arrays import iter_blocks
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording
from stillmap.em import beam_counting, occupancy_hmm
from stillmap.em.beam_counting import hit_ratio_e_step, log_likelihood, paper_e_step
from stillmap.em.occupancy_grid import ObservedCells
from stillmap.em.occupancy_hmm import e_step_3d
from stillmap.em.options import EmOptions
from stillmap.em.people import label_people
from stillmap.em.types import EStepResult, Grid, NoReturnModel, fill_beams

Float = NDArray[np.float64]
Estimator = Literal["stillmap", "paper", "hit-ratio", "tracker"]

# iterations of those that do not follow a likelihood upwards: counting has nothing to iterate,
# tracking is done once to register without people, and once more on those better poses
_FIXED: dict[Estimator, int] = {"hit-ratio": 1, "tracker": 2}


ESTIMATORS_3D: tuple[Estimator, ...] = ("stillmap", "paper")  # those that know 3D recordings


def initial_p_static(
    recording: Recording, estimator: Estimator, options: EmOptions
) -> NDArray[np.float32]:
    """(M,) e := p(c = 1) for every beam: the start of Fig. 2. Mappers that count believe all."""
    prior = 1.0 if estimator in _FIXED else options.prior
    e = recording.allocate_per_beam(np.float32)
    for block in iter_blocks(e):
        e[block] = prior
    return e


def max_iterations(estimator: Estimator, options: EmOptions) -> int:
    """How often to iterate at most."""
    return min(fixed_iterations(estimator) or options.max_iterations, options.max_iterations)


def fixed_iterations(estimator: Estimator) -> int | None:
    """How often estimators iterate of which the last iterate counts; None: the likelihood tells."""
    return _FIXED.get(estimator)


def make_grid(dimension: int, resolution: float, approach: float = 0.0) -> Grid:
    """A grid without any sums."""
    kind = _core.OccupancyGrid2D if dimension == 2 else _core.OccupancyGrid3D
    return kind(resolution, approach)


def needs_sums(dimension: int, estimator: Estimator) -> bool:
    """Whether the M-step has to make the sums of (10): in 3D they are large."""
    return dimension == 2 or estimator == "paper"


def e_step(
    recording: Recording,
    poses: Float,
    grid: Grid,
    estimator: Estimator,
    options: EmOptions,
    threads: int = 1,
) -> EStepResult:
    """What is static at these poses, and the likelihood of that."""
    if estimator == "paper":
        return paper_e_step(recording, poses, grid, options.prior, threads)
    if estimator == "stillmap" and recording.dimension == 3:
        return e_step_3d(recording, poses, grid.resolution, options, threads)
    if estimator == "stillmap":
        return occupancy_hmm.e_step(recording, poses, grid.resolution, options, threads)
    if not isinstance(grid, _core.OccupancyGrid2D):
        raise ValueError(f"estimator: {estimator} knows 2D recordings alone")
    if estimator == "hit-ratio":
        return hit_ratio_e_step(recording, poses, grid, options.hit_ratio, threads)
    return _tracked(recording, poses, grid.resolution, options, threads)


def _tracked(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int
) -> EStepResult:
    """Hits on people who are tracked are dynamic, all others static; the map counts the others."""
    people, e = (
        label_people(recording, poses, options.tracker),
        recording.allocate_per_beam(np.float32),
    )
    for _, beams, _ in iter_chunks(recording, release=[people, e]):
        kept = (~people[beams]).astype(np.float32)
        e[beams] = fill_beams(recording.points[beams], recording.hit[beams], kept, options.prior)
    grid = _core.OccupancyGrid2D(resolution)
    add_recording(grid, recording, poses, e, threads)
    likelihood = log_likelihood(recording, poses, grid, e, options.prior, threads)
    return EStepResult(e, likelihood, beam_counting.threshold_hit_ratio(grid, options.hit_ratio))


def add_recording(
    grid: Grid,
    recording: Recording,
    poses: Float,
    e: NDArray[np.float32] | None,
    threads: int = 1,
    *,
    hits_only: bool = False,
) -> None:
    """Adds the sums of (10) of all scans at given poses; e = None counts every hit as static.

    With `hits_alone` beams without a return are left out.
    """
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(recording, release=[] if e is None else [e]):
        points, hit = recording.points[beams], recording.hit[beams]
        if hits_only:
            points = np.where(hit[:, None], points, np.float32(np.nan))
        weights = np.ones(len(hit), np.float32) if e is None else e[beams]
        _core.add_beams(grid, points, hit, weights, offset, T_map_sensor[scans], threads)


def recount_as_static(
    grid: Grid, recording: Recording, poses: Float, e: NDArray[np.float32]
) -> None:
    """Makes sums that were added with e those of every hit counted as static, to the bit."""
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(recording, release=[e]):
        points, hit, T = recording.points[beams], recording.hit[beams], T_map_sensor[scans]
        _core.add_end_points(grid, points, hit, e[beams], offset, T, remove=True)
        _core.add_end_points(grid, points, hit, np.ones(len(hit), np.float32), offset, T)


def add_trusted_beams(
    grid: _core.OccupancyGrid2D,
    recording: Recording,
    poses: Float,
    e: NDArray[np.float32],
    no_return: NoReturnModel | None,
    threads: int = 1,
) -> ObservedCells | None:
    """Adds the same sums as `add_recording` to an empty grid; says which cells beams tell of.

    Beams without a return only count as far as they are believed; None where all of them are.
    """
    if no_return is None:
        add_recording(grid, recording, poses, e, threads)
        return None
    add_recording(grid, recording, poses, e, threads, hits_only=True)
    rest = _core.OccupancyGrid2D(grid.resolution, grid.approach)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(recording):
        _core.add_no_return_beams(
            grid,
            rest,
            recording.points[beams],
            recording.hit[beams],
            offset,
            T_map_sensor[scans],
            no_return.stop_cells,
            no_return.end_margin,
            threads,
        )
    first_cell, cells = grid.observed_mask()
    grid.merge(rest)
    return ObservedCells(first_cell, cells.view(np.bool_))


def changed_share(
    before: NDArray[np.float32], after: NDArray[np.float32], hit: NDArray[np.bool_]
) -> float:
    """Share of the hits whose e moved by more than 0.1 between two iterations."""
    changed = hits = 0
    for block in iter_blocks(before, after, hit):
        moved = np.abs(after[block] - before[block])[hit[block]] > 0.1
        changed += int(np.count_nonzero(moved))
        hits += int(np.count_nonzero(hit[block]))
    return changed / max(hits, 1)
