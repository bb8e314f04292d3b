"""Quality of a map: which cells are known from few observations, and its held-out score.

The score is the likelihood of scans that the map was not made from (`docs/estimator.md`).
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core import tiles
from stillmap.core.array_types import Bool, Float, Float32
from stillmap.core.chunks import iter_beams
from stillmap.core.parallel import counting_threads
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.em.observations import time_bin_index
from stillmap.em.occupancy_grid import BLOCK_CELLS, OccupancyMap
from stillmap.em.options import EmOptions
from stillmap.em.types import DYNAMIC_BELOW, NoReturnModel

MIN_OBSERVATIONS = 3  # unobstructed observations of a well-observed cell
MOVER_RADIUS = 0.3  # m around a dynamic end point within which observations are obstructed

# The same for every recording: learned rates and widths would excuse a blurred map.
BEAM_MODEL = {
    "stopping_rate": 15.0,  # per metre, of surely static cells
    "range_std": 0.1,  # m, of range and pose: less would measure little but pose errors
    "late_share": 0.6,  # of the beams that graze or pass an edge and end somewhere behind it
    "mean_delay": 0.3,  # m, how far behind
    "outlier_share": 0.01,
}


@dataclass(frozen=True, eq=False)
class Coverage(ShortRepr):
    """Observation counts, laid out as the map.

    Attributes:
        observations: (H, W) uint16, time bins in which a beam crossed the cell or ended in it,
            65535 at most.
        unobstructed: (H, W) uint16, those in which no beam ended on something dynamic within
            `mover_radius`: where a mover stood, the cell itself was not observed.
        thinly_observed: (H, W) bool, known cells with fewer than `min_observations` of these.
        min_observations: unobstructed observations that a cell should have.
        mover_radius: metres.
    """

    observations: NDArray[np.uint16]
    unobstructed: NDArray[np.uint16]
    thinly_observed: Bool
    min_observations: int
    mover_radius: float


def count_observations(
    recording: Recording,
    poses: Float,
    p_static: Float32,
    occupancy: OccupancyMap,
    no_return: NoReturnModel | None,
    options: EmOptions,
    threads: int = 1,
) -> Coverage:
    """Counts the observations of every cell of a map.

    Args:
        recording: 2D, deskewed.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1) of every beam.
        occupancy: the map.
        no_return: free space shown by beams without a return.
        options: gives the time bins.
        threads: does not change the result.
    """
    counts = _core.ObservationCounts2D(
        occupancy.resolution,
        radius=MOVER_RADIUS,
        stop_cells=None if no_return is None else no_return.stop_cells,
        end_margin=0.0 if no_return is None else no_return.end_margin,
    )
    time_bin = time_bin_index(recording, options.time_bin)
    chunks = iter_beams(recording, poses, time_bin, release=[p_static])
    for scans, beams, (points, hit, offset, T) in chunks:
        is_dynamic = p_static[beams] < DYNAMIC_BELOW
        used = counting_threads(len(hit), threads)
        counts.add(points, hit, is_dynamic, offset, T, time_bin[scans], used)
    layers = _dense_counts(counts, occupancy, recording.scratch)
    observations, unobstructed, thin = map(tiles.compact, layers)
    return Coverage(observations, unobstructed, thin, MIN_OBSERVATIONS, MOVER_RADIUS)


def _dense_counts(
    counts: _core.ObservationCounts2D, occupancy: OccupancyMap, scratch: Path | None
) -> tuple[tiles.TiledArray, tiles.TiledArray, tiles.TiledArray]:
    """Observations, unobstructed ones and thinly observed cells, laid out as the map."""
    first_cell, shape = occupancy.window
    observations, unobstructed = (tiles.TiledArray(shape, np.uint16, 0, scratch) for _ in range(2))
    thin = tiles.TiledArray(shape, np.bool_, False, scratch)
    blocks = tiles.tiles_around(counts.block_cells - first_cell, BLOCK_CELLS, shape)
    layers = observations, unobstructed, thin, occupancy.p_occupied
    for k, (i, j) in enumerate(sorted({*blocks, *tiles.tile_numbers(occupancy.p_occupied)})):
        if k % tiles.TILES_PER_RELEASE == 0:
            for layer in layers:
                tiles.release(layer)
        rows = slice(i * tiles.TILE, min((i + 1) * tiles.TILE, shape[0]))
        columns = slice(j * tiles.TILE, min((j + 1) * tiles.TILE, shape[1]))
        first = (first_cell + np.array([columns.start, rows.start])).tolist()
        all_of, clear = counts.dense(first, (rows.stop - rows.start, columns.stop - columns.start))
        p_occupied = tiles.crop(occupancy.p_occupied, (rows, columns))
        observations.set_tile(i, j, all_of)
        unobstructed.set_tile(i, j, clear)
        thin.set_tile(i, j, (clear < MIN_OBSERVATIONS) & ~np.isnan(p_occupied))
    return observations, unobstructed, thin


def select_held_out_scans(n_scans: int, every: int) -> Bool:
    """(T,) mask of held-out scans: the middle one of every `every`; 0: none."""
    if every == 0:
        return np.zeros(n_scans, dtype=np.bool_)
    return np.asarray(np.arange(n_scans) % every == every // 2, dtype=np.bool_)


def score_held_out_scans(
    recording: Recording, poses: Float, e: Float32, resolution: float, every: int, threads: int = 1
) -> float | None:
    """Log likelihood of held-out ranges given the map of the other scans, in nats per beam.

    Args:
        recording: 2D or 3D.
        poses: (T, D+1, D+1) T_map_base.
        e: (M,) P(c = 1) of every beam.
        resolution: edge of a cell, metres.
        every: one scan in so many is held out; 0: none.
        threads: does not change the result.

    Returns:
        mean over beams of ln p(z) - ln q(z); None where there are fewer than `every` scans or no
        usable beams.

    With s_j the mean e of the other scans' hits in cell j, static surface stops a beam at the rate
    h_j = stopping_rate * s_j per metre, and movers at lambda = sum (1 - e) / sum of lengths. At
    distance r the density of the stop is H(r) = (h_j + lambda) exp(-integral of it up to r); static
    surface is measured at z = r + noise, or at r + Exp(mean_delay). q is the density of a world
    without a map, in which beams end at the same rate everywhere; a share `outlier_share` of p is
    q. Both integrate to one over z, together with the probability that nothing stops the beam.
    """
    if every == 0 or recording.n_scans < every:
        return None
    held_out = select_held_out_scans(recording.n_scans, every)
    kind = _core.StaticFractionGrid2D if recording.dimension == 2 else _core.StaticFractionGrid3D
    fractions = kind(resolution)
    for scans, beams, (points, hit, offset, T) in iter_beams(recording, poses, release=[e]):
        fractions.add(points, hit, e[beams], offset, T, held_out[scans])
    gain, count = 0.0, 0.0
    for scans, _, (points, hit, offset, T) in iter_beams(recording, poses):
        per_scan = _core.score_held_out(
            fractions, points, hit, offset, T, held_out[scans], threads=threads, **BEAM_MODEL
        )
        gain += float(per_scan[:, 0].sum())
        count += float(per_scan[:, 1].sum())
    return gain / count if count else None
