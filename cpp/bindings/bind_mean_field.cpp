#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/occupancy/mean_field.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap::bindings {
namespace {

MeanFieldOptions checked(double radius, double coplanar, double for_static, double for_dynamic,
                         double least, double most, double moved, int rounds) {
  require(radius >= 1.0 && radius <= 8.0, "radius: expected 1 to 8 cells");
  require(coplanar > 0.0 && std::isfinite(coplanar), "coplanar: expected a positive length");
  for (const double odds : {for_static, for_dynamic})
    require(odds >= 0.0 && std::isfinite(odds), "expected log odds of at least 0");
  require(std::isfinite(least) && std::isfinite(most) && least <= most, "expected least <= most");
  require_probability(moved, "moved");
  require(rounds >= 0, "rounds: expected no negative number");
  return {radius, coplanar, for_static, for_dynamic, least, most, moved, rounds};
}

template <int D>
auto infer_p_static(const SurfelMap<D>& surfel_map, const Flat<float>& log_odds, double radius,
                    double coplanar, double for_static, double for_dynamic, double least,
                    double most, double moved, int rounds, int threads) {
  const size_t n = surfel_map.size();
  require(surfel_map.fitted(), "surface: fit it first");
  require(surfel_map.hit_spans().size() == n, "surface: expected the looks of its end points");
  require(log_odds.shape(0) == n, "log_odds: expected one per element");
  for (size_t k = 0; k < n; ++k) require(!std::isnan(log_odds.data()[k]), "log_odds: not a number");
  const MeanFieldOptions options =
      checked(radius, coplanar, for_static, for_dynamic, least, most, moved, rounds);
  std::vector<float> out;
  {
    nb::gil_scoped_release released;
    out = MeanField<D>(surfel_map, log_odds.data(), options, threads).infer();
  }
  return to_numpy(std::move(out), {n});
}

template <int D>
void bind(nb::module_& m) {
  m.def("settled", &infer_p_static<D>, nb::arg("surface"), nb::arg("log_odds").noconvert(),
        nb::kw_only(), nb::arg("radius"), nb::arg("coplanar"), nb::arg("for_static"),
        nb::arg("for_dynamic"), nb::arg("least"), nb::arg("most"), nb::arg("moved"),
        nb::arg("rounds"), nb::arg("threads") = 1,
        "(E,) float32 probability of being static, from log odds (E,) float32 that the looks at "
        "each element alone give and from the elements within a radius (cells) of it.");
}

}  // namespace

void bind_mean_field(nb::module_& m) { bind<3>(m); }

}  // namespace stillmap::bindings
