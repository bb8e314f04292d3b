#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/occupancy/line_support.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap::bindings {
namespace {

constexpr double kMaxRadius = 64.0;  // cells

auto line_support(const SurfelMap<2>& surfel_map, const Flat<float>& p_static, double radius,
                  double gap, double half_width, int threads) {
  const size_t n = surfel_map.size();
  require(surfel_map.fitted(), "surfel_map: fit it first");
  require(p_static.shape(0) == n, "p_static: expected one per surfel");
  for (size_t k = 0; k < n; ++k)
    require(p_static.data()[k] >= 0.0f && p_static.data()[k] <= 1.0f, "p_static: expected 0 to 1");
  require(radius >= 1.0 && radius <= kMaxRadius, "radius: expected 1 to 64 cells");
  require(gap >= 0.0 && gap <= radius, "gap: expected 0 to radius");
  require(half_width > 0.0 && half_width <= radius, "half_width: expected more than 0, to radius");
  std::vector<float> out;
  {
    nb::gil_scoped_release released;
    out = LineSupport(surfel_map, p_static.data(), {radius, gap, half_width}).compute(threads);
  }
  return to_numpy(std::move(out), {n});
}

}  // namespace

void bind_line_support(nb::module_& m) {
  m.def("line_support", &line_support, nb::arg("surfel_map"), nb::arg("p_static").noconvert(),
        nb::kw_only(), nb::arg("radius"), nb::arg("gap"), nb::arg("half_width"),
        nb::arg("threads") = 1,
        "(E,) float32: of the 12 lines through each surfel's cell, the largest sum of p_static "
        "(E,) float32 of other surfels on one. Those `gap` to `radius` cells away count whose "
        "cells' centres are less than `half_width` cells off the line.");
}

}  // namespace stillmap::bindings
