"""Every kernel of stillmap._core once more in plain NumPy, slowly, for 2 or 3 dimensions.

This is the oracle of the tests: same names and arguments as `stillmap._core`, written straight
from the equations of the paper, or of the chains in time that the default estimator fits, and
without a thought for speed. Where beams are taken:

- `points` (M, D) float32 are end points in the sensor frame, metres; a beam whose point is not
  finite is unusable and takes part in nothing;
- `hit` (M,) bool is False for maximum-range beams (zeta = 1), whose point is the free range;
- scan t owns the beams `offset[t]:offset[t + 1]`, and `T_map_sensor[t]` (D+1, D+1) is its pose.
"""

from reference.beams import add_beams, add_ends, e_step, log_likelihood
from reference.beside import settled
from reference.bodies import Bodies3D, feet
from reference.changes import ChangeModel, Course, course
from reference.dwell import Dwell, Dwell2D, Dwell3D, Reading, look_at
from reference.em import EmStep, em_fixed_poses, m_step_map
from reference.field import (
    field,
    registration_cost,
    registration_curvature,
    registration_gradient,
)
from reference.fill import fill_surfaces
from reference.fusing import SignedDistances
from reference.grid import Grid, Grid2D, Grid3D, occupancy
from reference.held_out import StaticShares, StaticShares2D, StaticShares3D, held_out
from reference.look_counts import LookCounts, LookCounts2D, LookCounts3D
from reference.near_faces import NearFaces
from reference.no_return import add_lost
from reference.search import Lattice, search_lattice
from reference.surface import Surface, Surface2D, Surface3D
from reference.sweep_map import SweepMap3D, carried, first_in_cells, linearise_sweep, register_sweep
from reference.texels import texels
from reference.traverse import cell_of, traverse
from reference.z_buffer import z_buffer

__all__ = [
    "Bodies3D",
    "ChangeModel",
    "Course",
    "Dwell",
    "Dwell2D",
    "Dwell3D",
    "EmStep",
    "Grid",
    "Grid2D",
    "Grid3D",
    "Lattice",
    "LookCounts",
    "LookCounts2D",
    "LookCounts3D",
    "NearFaces",
    "Reading",
    "SignedDistances",
    "StaticShares",
    "StaticShares2D",
    "StaticShares3D",
    "Surface",
    "Surface2D",
    "Surface3D",
    "SweepMap3D",
    "add_beams",
    "add_ends",
    "add_lost",
    "carried",
    "cell_of",
    "course",
    "e_step",
    "em_fixed_poses",
    "feet",
    "field",
    "fill_surfaces",
    "first_in_cells",
    "held_out",
    "linearise_sweep",
    "log_likelihood",
    "look_at",
    "m_step_map",
    "occupancy",
    "register_sweep",
    "registration_cost",
    "registration_curvature",
    "registration_gradient",
    "search_lattice",
    "settled",
    "texels",
    "traverse",
    "z_buffer",
]
