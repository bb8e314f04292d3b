"""The E-step by whichever estimator was chosen, and the sums of (10) over whole recordings."""

import dataclasses
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from stillmap import _core
from stillmap.em import dwell, hit_ratio, paper
from stillmap.em.chunks import chunks
from stillmap.em.expectations import Expectations, NoReturn
from stillmap.em.occupancy import Seen
from stillmap.em.options import EmOptions
from stillmap.recording.model import Recording

Float = NDArray[np.float64]
Estimator = Literal["stillmap", "paper", "hit-ratio"]


def initial_expectations(
    recording: Recording, estimator: Estimator, options: EmOptions
) -> NDArray[np.float32]:
    """(M,) e := p(c = 1) for every beam: the start of Fig. 2. Mappers that count believe all."""
    prior = 1.0 if estimator == "hit-ratio" else options.prior
    return np.full(recording.n_beams, prior, dtype=np.float32)


def iterations(estimator: Estimator, options: EmOptions) -> int:
    """How often to iterate at most; counting has nothing to iterate."""
    return 1 if estimator == "hit-ratio" else options.max_iterations


def e_step(
    recording: Recording,
    poses: Float,
    grid: _core.Grid2D,
    estimator: Estimator,
    options: EmOptions,
    threads: int = 1,
) -> Expectations:
    """What is static at these poses, and the likelihood of that."""
    if estimator == "paper":
        return paper.e_step(recording, poses, grid, options.prior, threads)
    if estimator == "hit-ratio":
        return hit_ratio.e_step(recording, poses, grid, options.hit_ratio, threads)
    return dwell.e_step(recording, poses, grid.resolution, options, threads)


def add_recording(
    grid: _core.Grid2D,
    recording: Recording,
    poses: Float,
    e: NDArray[np.float32] | None,
    threads: int = 1,
) -> None:
    """Adds the sums of (10) of all scans at given poses; e = None counts every hit as static."""
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in chunks(recording):
        points, hit = recording.points[beams], recording.hit[beams]
        weights = np.ones(len(hit), np.float32) if e is None else e[beams]
        _core.add_beams(grid, points, hit, weights, offset, T_map_sensor[scans], threads)


def add_believed_first(
    grid: _core.Grid2D,
    recording: Recording,
    poses: Float,
    e: NDArray[np.float32],
    no_return: NoReturn | None,
    threads: int = 1,
) -> Seen | None:
    """Adds the same sums as `add_recording` to an empty grid; says which cells beams tell of.

    Beams without a return only count as far as they are believed; None where all of them are.
    """
    if no_return is None:
        add_recording(grid, recording, poses, e, threads)
        return None
    hits = np.where(recording.hit[:, None], recording.points, np.float32(np.nan))
    add_recording(grid, dataclasses.replace(recording, points=hits), poses, e, threads)
    del hits
    rest = _core.Grid2D(grid.resolution, grid.approach)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in chunks(recording):
        _core.add_lost(
            grid,
            rest,
            recording.points[beams],
            recording.hit[beams],
            offset,
            T_map_sensor[scans],
            no_return.stops,
            no_return.beyond,
            threads,
        )
    first_cell, cells = grid.seen()
    grid.merge(rest)
    return Seen(first_cell, cells.view(np.bool_))


def changed_share(
    before: NDArray[np.float32], after: NDArray[np.float32], hit: NDArray[np.bool_]
) -> float:
    """Share of the hits whose e moved by more than 0.1 between two iterations."""
    changed = int(np.count_nonzero(np.abs(after - before)[hit] > 0.1))
    return changed / max(int(np.count_nonzero(hit)), 1)
