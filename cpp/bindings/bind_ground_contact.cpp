#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/ground_contact.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap::bindings {
namespace {

constexpr int kMaxColumnCells = 1 << 20;

auto relabel_ground_contact(const SurfelMap<3>& surfel_map, const Points<3>& points,
                            const Flat<bool>& hit, const Flat<int64_t>& offset,
                            const Poses<3>& poses, const Flat<int32_t>& surfel,
                            const Flat<bool>& is_obstacle, const Flat<float>& p_static,
                            const Flat<float>& ground_height, const Flat<bool>& at_any_height,
                            int column_cells, double max_ground_height, double min_end_height,
                            int threads) {
  const auto scans = scans_from<3>(points, hit, offset, poses);
  const size_t n = surfel_map.size(), beams = points.shape(0);
  require(surfel_map.fitted(), "surfel_map: fit it first");
  require(surfel.shape(0) == beams, "surfel: expected one per beam");
  bool in_range = true, no_unusable = true;
  for (size_t i = 0; i < beams; ++i) {
    const int32_t k = surfel.data()[i];
    in_range = in_range && k >= kNoSurfel && k < static_cast<int32_t>(n);
    no_unusable = no_unusable && (k == kNoSurfel || usable<3>(points.data() + i * 3));
  }
  require(in_range, "surfel: out of range");
  require(no_unusable, "surfel: expected -1 for unusable beams");
  require(is_obstacle.shape(0) == n, "is_obstacle: expected one per surfel");
  require(p_static.shape(0) == n, "p_static: expected one per surfel");
  require(ground_height.shape(0) == n, "ground_height: expected one per surfel");
  require(at_any_height.shape(0) == n, "at_any_height: expected one per surfel");
  bool valid_p = true, finite_heights = true;
  for (size_t k = 0; k < n; ++k) {
    valid_p = valid_p && p_static.data()[k] >= 0.0f && p_static.data()[k] <= 1.0f;
    finite_heights = finite_heights && std::isfinite(ground_height.data()[k]);
  }
  require(valid_p, "p_static: expected a probability in [0, 1]");
  require(finite_heights, "ground_height: not finite");
  require(column_cells >= 1 && column_cells <= kMaxColumnCells,
          "column_cells: expected 1 to 1048576 cells");
  require(std::isfinite(max_ground_height), "max_ground_height: not finite");
  require(min_end_height >= 0.0 && std::isfinite(min_end_height),
          "min_end_height: expected a height of at least 0");
  std::vector<float> out(beams);
  {
    nb::gil_scoped_release released;
    const GroundContact contact(
        surfel_map, {is_obstacle.data(), p_static.data(), ground_height.data(),
                     at_any_height.data(), column_cells, max_ground_height, min_end_height});
    contact.relabel(scans, surfel.data(), threads, out.data());
  }
  return to_numpy(std::move(out), {beams});
}

}  // namespace

void bind_ground_contact(nb::module_& m) {
  m.def(
      "relabel_ground_contact", &relabel_ground_contact, nb::arg("surfel_map"),
      nb::arg("points").noconvert(), nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
      nb::arg("T_map_sensor").noconvert(), nb::arg("surfel").noconvert(), nb::kw_only(),
      nb::arg("is_obstacle").noconvert(), nb::arg("p_static").noconvert(),
      nb::arg("ground_height").noconvert(), nb::arg("at_any_height").noconvert(),
      nb::arg("column_cells"), nb::arg("max_ground_height"), nb::arg("min_end_height"),
      nb::arg("threads") = 1,
      "(M,) float32: P(static) of beams that end on static ground surfels below a moving object: "
      "the mean p_static of the obstacle surfels hit in the same column of column_cells x "
      "column_cells cells by the same sweep; NaN where it is 1/2 or more, and for all other beams. "
      "surfel (M,) int32 is the surfel of each beam, -1: none; is_obstacle (E,) bool; p_static "
      "(E,) float32; ground_height (E,) float32, metres, below each surfel. Ground surfels lie at "
      "most max_ground_height above the ground, the beams end more than min_end_height above it; "
      "where at_any_height (E,) bool, they may end lower.");
}

}  // namespace stillmap::bindings
