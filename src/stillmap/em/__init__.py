"""What is static: the E-step, the map that follows from it, and the likelihood. No I/O."""

from stillmap.em.estimator import (
    EmOptions,
    Likelihood,
    add_recording,
    changed_share,
    e_step,
    initial_expectations,
    log_likelihood,
)
from stillmap.em.occupancy import OccupancyMap, occupancy_map

__all__ = [
    "EmOptions",
    "Likelihood",
    "OccupancyMap",
    "add_recording",
    "changed_share",
    "e_step",
    "initial_expectations",
    "log_likelihood",
    "occupancy_map",
]
