"""NumPy twins of the kernels of stillmap._core, in 2D and 3D.

They have the names and arguments of `stillmap._core`, follow the equations literally and make no
attempt at speed; tests/agreement compares the two. Arguments that describe beams:

- `points` (M, D) float32 are end points in the sensor frame, metres; beams with NaN points are
  unusable and skipped;
- `hit` (M,) bool is False for maximum-range beams (zeta = 1), whose point is the free range;
- scan t owns the beams `offset[t]:offset[t + 1]`, and `T_map_sensor[t]` (D+1, D+1) is its pose.
"""

from reference.beam_counting import add_beams, add_end_points, e_step, log_likelihood
from reference.change_hmm import ChangeModel, ChangeSummary, summarise_changes
from reference.cluster_pooling import ClusterPooling3D, relabel_ground_contact
from reference.correlative_search import Lattice, search_lattice
from reference.em import EmStep, em_fixed_poses, m_step_map
from reference.endpoint_interpolation import interpolate_end_points
from reference.held_out_likelihood import (
    StaticFractionGrid,
    StaticFractionGrid2D,
    StaticFractionGrid3D,
    score_held_out,
)
from reference.likelihood_field import (
    ends_of_surfaces,
    registration_cost,
    registration_curvature,
    registration_gradient,
    smoothed_occupancy,
)
from reference.line_support import line_support
from reference.mean_field import smooth_mean_field
from reference.ndt_map import (
    NdtMap3D,
    linearise_sweep,
    register_sweep,
    transform_by_twist,
    voxel_downsample,
)
from reference.no_return_beams import add_no_return_beams
from reference.observation import MeasurementModel, observe
from reference.observation_counts import ObservationCounts, ObservationCounts2D, ObservationCounts3D
from reference.occupancy_filter import OccupancyFilter, OccupancyFilter2D
from reference.occupancy_grid import OccupancyGrid, OccupancyGrid2D, OccupancyGrid3D, occupancy
from reference.occupancy_hmm import OccupancyHmm, OccupancyHmm2D, OccupancyHmm3D
from reference.ray_traversal import cell_of, traverse
from reference.surfel_map import SurfelMap, SurfelMap2D, SurfelMap3D
from reference.sweep_filter import SweepFilter3D
from reference.texel_raster import rasterise_texels
from reference.tsdf import TsdfVolume
from reference.z_buffer import render_z_buffer

__all__ = [
    "ChangeModel",
    "ChangeSummary",
    "ClusterPooling3D",
    "EmStep",
    "Lattice",
    "MeasurementModel",
    "NdtMap3D",
    "ObservationCounts",
    "ObservationCounts2D",
    "ObservationCounts3D",
    "OccupancyFilter",
    "OccupancyFilter2D",
    "OccupancyGrid",
    "OccupancyGrid2D",
    "OccupancyGrid3D",
    "OccupancyHmm",
    "OccupancyHmm2D",
    "OccupancyHmm3D",
    "StaticFractionGrid",
    "StaticFractionGrid2D",
    "StaticFractionGrid3D",
    "SurfelMap",
    "SurfelMap2D",
    "SurfelMap3D",
    "SweepFilter3D",
    "TsdfVolume",
    "add_beams",
    "add_end_points",
    "add_no_return_beams",
    "cell_of",
    "e_step",
    "em_fixed_poses",
    "ends_of_surfaces",
    "interpolate_end_points",
    "line_support",
    "linearise_sweep",
    "log_likelihood",
    "m_step_map",
    "observe",
    "occupancy",
    "rasterise_texels",
    "register_sweep",
    "registration_cost",
    "registration_curvature",
    "registration_gradient",
    "relabel_ground_contact",
    "render_z_buffer",
    "score_held_out",
    "search_lattice",
    "smooth_mean_field",
    "smoothed_occupancy",
    "summarise_changes",
    "transform_by_twist",
    "traverse",
    "voxel_downsample",
]
