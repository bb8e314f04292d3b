#pragma once

#include <nanobind/nanobind.h>

namespace stillmap::border {

void bind_grid(nanobind::module_& m);
void bind_beams(nanobind::module_& m);
void bind_register(nanobind::module_& m);
void bind_dwell(nanobind::module_& m);
void bind_fusing(nanobind::module_& m);
void bind_beside(nanobind::module_& m);
void bind_bodies(nanobind::module_& m);
void bind_held_out(nanobind::module_& m);
void bind_look_counts(nanobind::module_& m);
void bind_near_faces(nanobind::module_& m);
void bind_sweep(nanobind::module_& m);
void bind_texels(nanobind::module_& m);
void bind_z_buffer(nanobind::module_& m);

}  // namespace stillmap::border
