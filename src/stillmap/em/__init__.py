"""What is static: the E-steps, the map that follows from them, and the likelihood. No I/O."""

from stillmap.em.estimator import (
    Estimator,
    add_believed_first,
    add_recording,
    changed_share,
    e_step,
    fixed_iterations,
    initial_expectations,
    iterations,
)
from stillmap.em.expectations import CellProbabilities, Expectations, Likelihood, NoReturn
from stillmap.em.held_out import held_out_log_likelihood
from stillmap.em.occupancy import Box, OccupancyMap, Seen, occupancy_map
from stillmap.em.options import DwellOptions, EmOptions

__all__ = [
    "Box",
    "CellProbabilities",
    "DwellOptions",
    "EmOptions",
    "Estimator",
    "Expectations",
    "Likelihood",
    "NoReturn",
    "OccupancyMap",
    "Seen",
    "add_believed_first",
    "add_recording",
    "changed_share",
    "e_step",
    "fixed_iterations",
    "held_out_log_likelihood",
    "initial_expectations",
    "iterations",
    "occupancy_map",
]
