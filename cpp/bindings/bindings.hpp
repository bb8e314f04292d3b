#pragma once

#include <nanobind/nanobind.h>

namespace stillmap::bindings {

void bind_grid(nanobind::module_& m);
void bind_beam_counting(nanobind::module_& m);
void bind_scan_registration(nanobind::module_& m);
void bind_surfel_map(nanobind::module_& m);
void bind_occupancy_filter(nanobind::module_& m);
void bind_occupancy_hmm(nanobind::module_& m);
void bind_tsdf(nanobind::module_& m);
void bind_mean_field(nanobind::module_& m);
void bind_line_support(nanobind::module_& m);
void bind_cluster_pooling(nanobind::module_& m);
void bind_ground_contact(nanobind::module_& m);
void bind_held_out_likelihood(nanobind::module_& m);
void bind_observation_counts(nanobind::module_& m);
void bind_plane_projection(nanobind::module_& m);
void bind_plane_registration(nanobind::module_& m);
void bind_pose_refinement(nanobind::module_& m);
void bind_shortest_paths(nanobind::module_& m);
void bind_texel_raster(nanobind::module_& m);
void bind_z_buffer(nanobind::module_& m);

}  // namespace stillmap::bindings
