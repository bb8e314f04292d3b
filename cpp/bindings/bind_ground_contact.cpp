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
                            const Flat<bool>& stands, const Flat<float>& p_static,
                            const Flat<float>& ground, int column, double low, double least,
                            int threads) {
  const auto scans = scans_from<3>(points, hit, offset, poses);
  const size_t n = surfel_map.size(), beams = points.shape(0);
  require(surfel_map.fitted(), "surface: fit it first");
  require(surfel.shape(0) == beams, "element: expected one per beam");
  bool in_range = true, usable_ones = true;
  for (size_t i = 0; i < beams; ++i) {
    const int32_t k = surfel.data()[i];
    in_range = in_range && k >= kNoSurfel && k < static_cast<int32_t>(n);
    usable_ones = usable_ones && (k == kNoSurfel || usable<3>(points.data() + i * 3));
  }
  require(in_range, "element: out of range");
  require(usable_ones, "element: of an unusable beam");
  require(stands.shape(0) == n, "stands: expected one per element");
  require(p_static.shape(0) == n, "p_static: expected one per element");
  require(ground.shape(0) == n, "ground: expected one per element");
  bool probable = true, high = true;
  for (size_t k = 0; k < n; ++k) {
    probable = probable && p_static.data()[k] >= 0.0f && p_static.data()[k] <= 1.0f;
    high = high && std::isfinite(ground.data()[k]);
  }
  require(probable, "p_static: expected a probability in [0, 1]");
  require(high, "ground: not finite");
  require(column >= 1 && column <= kMaxColumnCells, "column: expected 1 to 1048576 cells");
  require(std::isfinite(low), "low: not finite");
  require(least >= 0.0 && std::isfinite(least), "least: expected a height of at least 0");
  std::vector<float> out(beams);
  {
    nb::gil_scoped_release released;
    const GroundContact contact(
        surfel_map, {stands.data(), p_static.data(), ground.data(), column, low, least});
    contact.relabel(scans, surfel.data(), threads, out.data());
  }
  return to_numpy(std::move(out), {beams});
}

}  // namespace

void bind_ground_contact(nb::module_& m) {
  m.def("feet", &relabel_ground_contact, nb::arg("surface"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("element").noconvert(), nb::kw_only(),
        nb::arg("stands").noconvert(), nb::arg("p_static").noconvert(),
        nb::arg("ground").noconvert(), nb::arg("column"), nb::arg("low"), nb::arg("least"),
        nb::arg("threads") = 1,
        "(M,) float32 of beams that end more than `least` metres above static elements (M,) of the "
        "ground: mean probability of being static of what stands in the same column in the same "
        "sweep; NaN where that is half or more, and for all others. stands (E,) bool, p_static and "
        "ground (E,) float32: metres below each.");
}

}  // namespace stillmap::bindings
