"""How well the cells of a map are known: what few looks saw, or none while nothing moved there."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap.core.chunks import iter_chunks
from stillmap.core.recording import Recording
from stillmap.em.observations import (
    time_bin_index,
)
from stillmap.em.occupancy_grid import OccupancyMap
from stillmap.em.options import EmOptions
from stillmap.em.types import NoReturnModel

DYNAMIC_BELOW = 0.5  # P(c = 1) of what is taken for moving


@dataclass(frozen=True, eq=False)
class Coverage:
    """What the cells of a map rest on, laid out as the map is.

    Attributes:
        looks: (H, W) uint16, in how many looks a beam crossed the cell or ended in it, as far as
            beams are believed; they stop at 65535.
        clear: (H, W) uint16, those of them in which no beam ended on something that moves within
            `near` of the cell: where somebody stood at every look the place itself is not known.
        thin: (H, W) bool, the known cells with fewer than `least` clear looks.
        least: see EvidenceOptions.
        near: metres, see EvidenceOptions.
    """

    observations: NDArray[np.uint16]
    unobstructed: NDArray[np.uint16]
    thinly_observed: NDArray[np.bool_]
    min_observations: int
    mover_radius: float


def count_observations(
    recording: Recording,
    poses: NDArray[np.float64],
    p_static: NDArray[np.float32],
    occupancy: OccupancyMap,
    no_return: NoReturnModel | None,
    options: EmOptions,
    threads: int = 1,
) -> Coverage:
    """Counts the looks at every cell of a map.

    Args:
        recording: 2D, without the motion during its scans.
        poses: (T, 3, 3) T_map_base.
        p_static: (M,) P(c = 1) of every beam, whichever estimator it is of.
        occupancy: the map.
        no_return: how far beams without a return are believed, as the map has it.
        options: see EmOptions.
        threads: same result with any number.
    """
    least, near = options.evidence.least, options.evidence.near
    counts = _core.ObservationCounts2D(
        occupancy.resolution,
        radius=near,
        stop_cells=None if no_return is None else no_return.stop_cells,
        end_margin=0.0 if no_return is None else no_return.end_margin,
    )
    look = time_bin_index(recording, options.dwell.look)
    T_map_sensor = recording.T_map_sensor(poses)
    for scans, beams, offset in iter_chunks(recording, look, release=[p_static]):
        counts.add(
            recording.points[beams],
            recording.hit[beams],
            p_static[beams] < DYNAMIC_BELOW,
            offset,
            T_map_sensor[scans],
            look[scans],
            threads,
        )
    box = occupancy.window
    looks, clear = counts.dense(box.first_cell.tolist(), box.shape)
    thin = (clear < least) & ~np.isnan(occupancy.p_occupied)
    return Coverage(looks, clear, thin, least, near)
