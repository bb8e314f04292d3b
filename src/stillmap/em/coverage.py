"""Observation counts of the cells of a map: which cells are known from few observations."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_beams
from stillmap.core.recording import Recording
from stillmap.em.observations import time_bin_index
from stillmap.em.occupancy_grid import OccupancyMap
from stillmap.em.options import EmOptions
from stillmap.em.types import DYNAMIC_BELOW, Float, NoReturnModel

MIN_OBSERVATIONS = 3  # unobstructed observations of a well-observed cell
MOVER_RADIUS = 0.3  # m around a dynamic end point within which observations are obstructed


@dataclass(frozen=True, eq=False)
class Coverage:
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
    thinly_observed: NDArray[np.bool_]
    min_observations: int
    mover_radius: float


def count_observations(
    recording: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
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
        counts.add(points, hit, is_dynamic, offset, T, time_bin[scans], threads)
    window = occupancy.window
    observations, unobstructed = counts.dense(window.first_cell.tolist(), window.shape)
    thin = (unobstructed < MIN_OBSERVATIONS) & ~np.isnan(occupancy.p_occupied)
    return Coverage(observations, unobstructed, thin, MIN_OBSERVATIONS, MOVER_RADIUS)
