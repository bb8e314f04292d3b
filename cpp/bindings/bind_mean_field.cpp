#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/occupancy/mean_field.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap::bindings {
namespace {

MeanFieldOptions checked(double radius, double coplanar_std, double static_coupling,
                         double dynamic_coupling, double min_log_odds, double max_log_odds,
                         double tolerance, int max_iterations) {
  require(radius >= 1.0 && radius <= 8.0, "radius: expected 1 to 8 cells");
  require(coplanar_std > 0.0 && std::isfinite(coplanar_std),
          "coplanar_std: expected a positive length");
  for (const double odds : {static_coupling, dynamic_coupling})
    require(odds >= 0.0 && std::isfinite(odds),
            "static_coupling, dynamic_coupling: expected log odds of at least 0");
  require(
      std::isfinite(min_log_odds) && std::isfinite(max_log_odds) && min_log_odds <= max_log_odds,
      "min_log_odds, max_log_odds: expected min_log_odds <= max_log_odds");
  require_probability(tolerance, "tolerance");
  require(max_iterations >= 0, "max_iterations: expected a number of at least 0");
  return {radius,       coplanar_std, static_coupling, dynamic_coupling,
          min_log_odds, max_log_odds, tolerance,       max_iterations};
}

template <int D>
auto infer_p_static(const SurfelMap<D>& surfel_map, const Flat<float>& log_odds, double radius,
                    double coplanar_std, double static_coupling, double dynamic_coupling,
                    double min_log_odds, double max_log_odds, double tolerance, int max_iterations,
                    int threads) {
  const size_t n = surfel_map.size();
  require(surfel_map.fitted(), "surfel_map: fit it first");
  require(surfel_map.hit_spans().size() == n, "surfel_map: expected end points with time bins");
  require(log_odds.shape(0) == n, "log_odds: expected one per surfel");
  for (size_t k = 0; k < n; ++k) require(!std::isnan(log_odds.data()[k]), "log_odds: not a number");
  const MeanFieldOptions options = checked(radius, coplanar_std, static_coupling, dynamic_coupling,
                                           min_log_odds, max_log_odds, tolerance, max_iterations);
  std::vector<float> out;
  {
    nb::gil_scoped_release released;
    out = MeanField<D>(surfel_map, log_odds.data(), options, threads).infer();
  }
  return to_numpy(std::move(out), {n});
}

template <int D>
void bind(nb::module_& m) {
  m.def("smooth_mean_field", &infer_p_static<D>, nb::arg("surfel_map"),
        nb::arg("log_odds").noconvert(), nb::kw_only(), nb::arg("radius"), nb::arg("coplanar_std"),
        nb::arg("static_coupling"), nb::arg("dynamic_coupling"), nb::arg("min_log_odds"),
        nb::arg("max_log_odds"), nb::arg("tolerance"), nb::arg("max_iterations"),
        nb::arg("threads") = 1,
        "(E,) float32: P(static) of each surfel by mean-field inference in a Markov random field, "
        "from its own log_odds (E,) float32 and its neighbours within `radius` cells. "
        "coplanar_std: standard deviation of the distance between coplanar surfels, in cells; "
        "static_coupling, dynamic_coupling: log odds of static and of dynamic neighbours; own log "
        "odds are clipped to min_log_odds, max_log_odds; surfels are updated while a neighbour "
        "changed by more than tolerance.");
}

}  // namespace

void bind_mean_field(nb::module_& m) { bind<3>(m); }

}  // namespace stillmap::bindings
