"""Dispatch of the E-step by estimator, and the counts (10) of whole recordings."""

from typing import Literal

import numpy as np

import stillmap._core as _core
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.arrays import iter_blocks
from stillmap.core.chunks import iter_beams, iter_chunks
from stillmap.core.parallel import counting_threads
from stillmap.core.recording import Recording
from stillmap.em import beam_counting, occupancy_hmm
from stillmap.em.occupancy_grid import ObservedCells, observed_cells
from stillmap.em.options import EmOptions
from stillmap.em.people_tracker import label_people
from stillmap.em.types import EStepResult, Grid, NoReturnModel, fill_beams
from stillmap.prepare.floor_detection import find_floor_returns

Estimator = Literal["stillmap", "paper", "hit-ratio", "tracker"]

ESTIMATORS_3D: tuple[Estimator, ...] = ("stillmap", "paper")

# Iterations of estimators without a likelihood: counting has nothing to iterate; tracking runs
# once to register without people, and once more on those better poses.
_FIXED_ITERATIONS: dict[Estimator, int] = {"hit-ratio": 1, "tracker": 2}

_P_FLOOR = 0.0  # a scan of nothing but floor has no weight, and follows odometry

# change of P(static) that counts in `changed_share`; the margin is for rounding, since the labels
# of walls change from the default prior, 0.9, to 1
_LABEL_CHANGE = 0.1 + 1e-6
_TOUCHED = 0.2  # of the hits of a scan, whose change may change its pose


def initial_p_static(recording: Recording, estimator: Estimator, options: EmOptions) -> Float32:
    """(M,) e := p(c = 1) for every beam (start of Fig. 2); 1 for estimators that count.

    In 2D the default estimator begins with a lower prior for what is floor by odometry: with floor
    in it the first map would bend, and later labels with it.
    """
    prior = 1.0 if estimator in _FIXED_ITERATIONS else options.prior
    e = recording.allocate_per_beam(np.float32)
    for block in iter_blocks(e):
        e[block] = prior
    odometry = recording.T_odom_base
    if estimator == "stillmap" and recording.dimension == 2 and odometry is not None:
        e[find_floor_returns(recording, odometry)] = _P_FLOOR
    return e


def max_iterations(estimator: Estimator, options: EmOptions) -> int:
    """Maximum number of EM iterations."""
    return min(fixed_iterations(estimator) or options.max_iterations, options.max_iterations)


def fixed_iterations(estimator: Estimator) -> int | None:
    """Number of iterations of estimators without a likelihood; None for the others."""
    return _FIXED_ITERATIONS.get(estimator)


def make_grid(dimension: int, resolution: float, approach: float = 0.0) -> Grid:
    """An empty grid."""
    kind = _core.OccupancyGrid2D if dimension == 2 else _core.OccupancyGrid3D
    return kind(resolution, approach)


def needs_counts(estimator: Estimator) -> bool:
    """True if an estimator computes its labels from the counts (10) of the M-step."""
    return estimator in ("paper", "hit-ratio")


def e_step(
    recording: Recording,
    poses: Float,
    grid: Grid,
    estimator: Estimator,
    options: EmOptions,
    threads: int = 1,
) -> EStepResult:
    """Labels of all beams at given poses, and their likelihood.

    Args:
        recording: M beams.
        poses: (T, D+1, D+1) T_map_base.
        grid: counts (10); the occupancy HMM and the tracker need its resolution only.
        estimator: how beams are labelled.
        options: see EmOptions.
        threads: does not change the result.

    Raises:
        ValueError: the estimator does not know 3D recordings.
    """
    if estimator == "paper":
        return beam_counting.paper_e_step(recording, poses, grid, options.prior, threads)
    if estimator == "stillmap":
        occupancy_e_step = (
            occupancy_hmm.e_step if recording.dimension == 2 else occupancy_hmm.e_step_3d
        )
        return occupancy_e_step(recording, poses, grid.resolution, options, threads)
    if not isinstance(grid, _core.OccupancyGrid2D):
        raise ValueError(f"estimator: {estimator} knows 2D recordings only")
    if estimator == "hit-ratio":
        return beam_counting.hit_ratio_e_step(recording, poses, grid, threads)
    return _tracker_e_step(recording, poses, grid.resolution, options, threads)


def _tracker_e_step(
    recording: Recording, poses: Float, resolution: float, options: EmOptions, threads: int
) -> EStepResult:
    """Labels hits on tracked people dynamic, all others static; the map counts the others."""
    on_people, e = label_people(recording, poses), recording.allocate_per_beam(np.float32)
    for _, beams, _ in iter_chunks(recording, release=[on_people, e]):
        labels = (~on_people[beams]).astype(np.float32)
        e[beams] = fill_beams(recording.points[beams], recording.hit[beams], labels, options.prior)
    grid = _core.OccupancyGrid2D(resolution)
    add_recording(grid, recording, poses, e, threads)
    likelihood = beam_counting.log_likelihood(recording, poses, grid, e, options.prior, threads)
    occupied = beam_counting.threshold_hit_ratio(grid)
    return EStepResult(e, likelihood, occupied)


def add_recording(
    grid: Grid,
    recording: Recording,
    poses: Float,
    e: Float32 | None,
    threads: int = 1,
    *,
    hits_only: bool = False,
) -> None:
    """Adds the counts (10) of all scans to a grid.

    Args:
        grid: to add to.
        recording: M beams.
        poses: (T, D+1, D+1) T_map_base.
        e: (M,) weights; None counts every hit as static.
        threads: does not change the result.
        hits_only: leaves out beams without a return.
    """
    release = [] if e is None else [e]
    for _, beams, (points, hit, offset, T) in iter_beams(recording, poses, release=release):
        weights = np.ones(len(hit), np.float32) if e is None else e[beams]
        used = counting_threads(len(hit), threads)
        _core.add_beams(grid, points, hit, weights, offset, T, used, hits_only=hits_only)


def recount_as_static(grid: Grid, recording: Recording, poses: Float, e: Float32) -> None:
    """Turns counts that were added with e into those with e = 1, to the bit."""
    for _, beams, (points, hit, offset, T) in iter_beams(recording, poses, release=[e]):
        _core.add_end_points(grid, points, hit, e[beams], offset, T, remove=True)
        _core.add_end_points(grid, points, hit, np.ones(len(hit), np.float32), offset, T)


def add_trusted_beams(
    grid: _core.OccupancyGrid2D,
    recording: Recording,
    poses: Float,
    e: Float32,
    no_return: NoReturnModel | None,
    threads: int = 1,
    places: Float | None = None,
) -> ObservedCells | None:
    """Adds the same counts as `add_recording` to an empty grid, and finds the observed cells.

    Beams without a return observe cells as far as `no_return` says. Returns None where they all
    count at full length. `places`: see `map_window`.
    """
    if no_return is None:
        add_recording(grid, recording, poses, e, threads)
        return None
    add_recording(grid, recording, poses, e, threads, hits_only=True)
    trust = no_return.stop_cells, no_return.end_margin
    for *_, data in iter_beams(recording, poses):
        used = counting_threads(len(data.hit), threads)
        _core.add_no_return_beams(grid, None, *data, *trust, used)
    observed = observed_cells(grid, recording.scratch, places)
    # beams once more rather than another grid, as large as this one
    for *_, data in iter_beams(recording, poses):
        used = counting_threads(len(data.hit), threads)
        _core.add_no_return_beams(None, grid, *data, *trust, used)
    return observed


def changed_share(before: Float32, after: Float32, hit: Bool) -> float:
    """Share of the hits whose P(static) changed by more than 0.1 between two iterations."""
    n_changed = n_hits = 0
    for block in iter_blocks(before, after, hit):
        changed = np.abs(after[block] - before[block])[hit[block]] > _LABEL_CHANGE
        n_changed += int(np.count_nonzero(changed))
        n_hits += int(np.count_nonzero(hit[block]))
    return n_changed / max(n_hits, 1)


def touched_share(recording: Recording, before: Float32, after: Float32) -> float:
    """Share of the scans of whose hits a fifth or more changed P(static) between two iterations.

    Only these can be matched differently in the next M-step.

    Args:
        recording: 2D or 3D.
        before, after: (M,) P(c = 1) of every beam.
    """
    n_touched = 0
    for t in recording.iter_scans(range(recording.n_scans), before, after):
        beams = recording.beams_of(t)
        hit = recording.hit[beams]
        changed = np.abs(after[beams] - before[beams])[hit] > _LABEL_CHANGE
        n_touched += bool(changed.sum() >= _TOUCHED * max(hit.sum(), 1))
    return n_touched / max(recording.n_scans, 1)
