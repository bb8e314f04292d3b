"""The E-step: labels of beams, the occupancy map and the likelihood. No I/O."""

from stillmap.em.beam_counting import beam_boxes, count_in_window
from stillmap.em.change_hmm import CellHistories
from stillmap.em.estimator import (
    ESTIMATORS_3D,
    Estimator,
    add_recording,
    add_trusted_beams,
    changed_share,
    e_step,
    fixed_iterations,
    initial_p_static,
    make_grid,
    max_iterations,
    needs_counts,
    recount_as_static,
    touched_share,
)
from stillmap.em.final_labels import final_e_step
from stillmap.em.ground import estimate_ground
from stillmap.em.occupancy_grid import (
    GridWindow,
    OccupancyMap,
    find_hits_beyond,
    make_occupancy_map,
)
from stillmap.em.options import EmOptions, MapState
from stillmap.em.quality import Coverage, count_observations, score_held_out_scans
from stillmap.em.types import (
    CellProbabilities,
    ChangedCells,
    EStepResult,
    Grid,
    GroundMap,
    Likelihood,
)

__all__ = [
    "ESTIMATORS_3D",
    "CellHistories",
    "CellProbabilities",
    "ChangedCells",
    "Coverage",
    "EStepResult",
    "EmOptions",
    "Estimator",
    "Grid",
    "GridWindow",
    "GroundMap",
    "Likelihood",
    "MapState",
    "OccupancyMap",
    "add_recording",
    "add_trusted_beams",
    "beam_boxes",
    "changed_share",
    "count_in_window",
    "count_observations",
    "e_step",
    "estimate_ground",
    "final_e_step",
    "find_hits_beyond",
    "fixed_iterations",
    "initial_p_static",
    "make_grid",
    "make_occupancy_map",
    "max_iterations",
    "needs_counts",
    "recount_as_static",
    "score_held_out_scans",
    "touched_share",
]
