#include "bindings.hpp"

namespace nb = nanobind;

NB_MODULE(_core, m) {
  // grids held by a traceback at exit would be reported as leaks
  nb::set_leak_warnings(false);
  m.doc() =
      "Kernels on plain arrays. points (M, D) float32 in the sensor frame, hit (M,) bool, offset "
      "(T+1,) int64, T_map_sensor (T, D+1, D+1) float64, D = 2 or 3; NaN points are unusable "
      "beams, finite points that are not hits are maximum-range beams. Wrong types raise "
      "TypeError, wrong lengths and values ValueError.";
  stillmap::bindings::bind_grid(m);
  stillmap::bindings::bind_beam_counting(m);
  stillmap::bindings::bind_scan_registration(m);
  stillmap::bindings::bind_surfel_map(m);
  stillmap::bindings::bind_occupancy_filter(m);
  stillmap::bindings::bind_occupancy_hmm(m);
  stillmap::bindings::bind_tsdf(m);
  stillmap::bindings::bind_mean_field(m);
  stillmap::bindings::bind_line_support(m);
  stillmap::bindings::bind_cluster_pooling(m);
  stillmap::bindings::bind_ground_contact(m);
  stillmap::bindings::bind_held_out_likelihood(m);
  stillmap::bindings::bind_observation_counts(m);
  stillmap::bindings::bind_plane_projection(m);
  stillmap::bindings::bind_plane_registration(m);
  stillmap::bindings::bind_pose_refinement(m);
  stillmap::bindings::bind_shortest_paths(m);
  stillmap::bindings::bind_texel_raster(m);
  stillmap::bindings::bind_z_buffer(m);
}
