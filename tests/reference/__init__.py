"""NumPy twins of the kernels of stillmap._core, in 2D and 3D.

They have the names and arguments of `stillmap._core`, follow the equations literally and make no
attempt at speed; tests/agreement compares the two. Arguments that describe beams:

- `points` (M, D) float32 are end points in the sensor frame, metres; beams with NaN points are
  unusable and skipped;
- `hit` (M,) bool is False for maximum-range beams (zeta = 1), whose point is the free range;
- scan t owns the beams `offset[t]:offset[t + 1]`, and `T_map_sensor[t]` (D+1, D+1) is its pose.
"""

# ruff: noqa: F401

from reference.beam_counting import add_beams, add_end_points, e_step, log_likelihood
from reference.change_hmm import ChangeModel, summarise_changes
from reference.cluster_pooling import ClusterPooling3D, relabel_ground_contact
from reference.correlative_search import search_lattice
from reference.em import em_fixed_poses, m_step_map
from reference.endpoint_interpolation import interpolate_end_points
from reference.held_out_likelihood import (
    StaticFractionGrid2D,
    StaticFractionGrid3D,
    score_held_out,
)
from reference.likelihood_field import (
    registration_cost,
    registration_curvature,
    registration_gradient,
    smoothed_occupancy,
)
from reference.line_support import line_support
from reference.mean_field import smooth_mean_field
from reference.ndt_map import (
    NdtMap3D,
    register_sweep,
    transform_by_twist,
    voxel_downsample,
)
from reference.no_return_beams import add_no_return_beams
from reference.observation import observe
from reference.observation_counts import ObservationCounts2D, ObservationCounts3D
from reference.occupancy_filter import OccupancyFilter2D
from reference.occupancy_grid import OccupancyGrid2D, OccupancyGrid3D, occupancy
from reference.occupancy_hmm import OccupancyHmm2D, OccupancyHmm3D
from reference.ray_traversal import traverse
from reference.surfel_map import SurfelMap2D, SurfelMap3D
from reference.sweep_filter import SweepFilter3D
from reference.texel_raster import rasterise_texels
from reference.tsdf import TsdfVolume
from reference.z_buffer import render_z_buffer
