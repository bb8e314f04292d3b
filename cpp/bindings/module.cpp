#include "bindings.hpp"

namespace nb = nanobind;

NB_MODULE(_core, m) {
  // a grid held by a traceback at exit is no leak that a user could act on
  nb::set_leak_warnings(false);
  m.doc() =
      "Kernels on plain arrays. points (M, D) float32 in the sensor frame, hit (M,) bool, offset "
      "(T+1,) int64, T_map_sensor (T, D+1, D+1) float64, D = 2 or 3; NaN points are unusable "
      "beams, finite points that are not hits are maximum-range beams. Wrong types raise "
      "TypeError, wrong lengths and values ValueError.";
  stillmap::border::bind_grid(m);
  stillmap::border::bind_beams(m);
  stillmap::border::bind_register(m);
  stillmap::border::bind_dwell(m);
  stillmap::border::bind_fusing(m);
  stillmap::border::bind_beside(m);
  stillmap::border::bind_bodies(m);
  stillmap::border::bind_held_out(m);
  stillmap::border::bind_look_counts(m);
  stillmap::border::bind_near_faces(m);
  stillmap::border::bind_sweep(m);
  stillmap::border::bind_texels(m);
  stillmap::border::bind_z_buffer(m);
}
