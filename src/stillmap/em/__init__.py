"""What is static: the E-steps, the map that follows from them, and the likelihood. No I/O."""

from stillmap.em.changepoints import Courses
from stillmap.em.coverage import Evidence, evidence
from stillmap.em.estimator import (
    IN_SPACE,
    Estimator,
    add_believed_first,
    add_recording,
    changed_share,
    count_as_static,
    e_step,
    empty_grid,
    fixed_iterations,
    initial_expectations,
    iterations,
    needs_sums,
)
from stillmap.em.ground import Ground, ground_of
from stillmap.em.held_out import held_out_log_likelihood
from stillmap.em.observations import look_numbers
from stillmap.em.occupancy_grid import Box, OccupancyMap, Seen, occupancy_map
from stillmap.em.occupancy_hmm import last_e_step
from stillmap.em.options import ChangeOptions, DwellOptions, EmOptions, EvidenceOptions, MapState
from stillmap.em.types import CellProbabilities, Changed, Expectations, Grid, Likelihood, NoReturn

__all__ = [
    "IN_SPACE",
    "Box",
    "CellProbabilities",
    "ChangeOptions",
    "Changed",
    "Courses",
    "DwellOptions",
    "EmOptions",
    "Estimator",
    "Evidence",
    "EvidenceOptions",
    "Expectations",
    "Grid",
    "Ground",
    "Likelihood",
    "MapState",
    "NoReturn",
    "OccupancyMap",
    "Seen",
    "add_believed_first",
    "add_recording",
    "changed_share",
    "count_as_static",
    "e_step",
    "empty_grid",
    "evidence",
    "fixed_iterations",
    "ground_of",
    "held_out_log_likelihood",
    "initial_expectations",
    "iterations",
    "last_e_step",
    "look_numbers",
    "needs_sums",
    "occupancy_map",
]
