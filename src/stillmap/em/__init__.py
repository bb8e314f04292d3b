"""What is static: the E-steps, the map that follows from them, and the likelihood. No I/O."""

from stillmap.em.changepoints import CellHistories
from stillmap.em.coverage import Coverage, count_observations
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
    needs_sums,
    recount_as_static,
)
from stillmap.em.ground import GroundMap, estimate_ground
from stillmap.em.held_out import score_held_out_scans
from stillmap.em.observations import time_bin_index
from stillmap.em.occupancy_grid import GridWindow, ObservedCells, OccupancyMap, make_occupancy_map
from stillmap.em.occupancy_hmm import final_e_step
from stillmap.em.options import ChangeOptions, DwellOptions, EmOptions, EvidenceOptions, MapState
from stillmap.em.types import (
    CellProbabilities,
    ChangedCells,
    EStepResult,
    Grid,
    Likelihood,
    NoReturnModel,
)

__all__ = [
    "ESTIMATORS_3D",
    "GridWindow",
    "CellProbabilities",
    "ChangeOptions",
    "ChangedCells",
    "CellHistories",
    "DwellOptions",
    "EmOptions",
    "Estimator",
    "Coverage",
    "EvidenceOptions",
    "EStepResult",
    "Grid",
    "GroundMap",
    "Likelihood",
    "MapState",
    "NoReturnModel",
    "OccupancyMap",
    "ObservedCells",
    "add_trusted_beams",
    "add_recording",
    "changed_share",
    "recount_as_static",
    "e_step",
    "make_grid",
    "count_observations",
    "fixed_iterations",
    "estimate_ground",
    "score_held_out_scans",
    "initial_p_static",
    "max_iterations",
    "final_e_step",
    "time_bin_index",
    "needs_sums",
    "make_occupancy_map",
]
