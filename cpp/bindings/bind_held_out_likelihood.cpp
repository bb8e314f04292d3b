#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/occupancy/held_out_likelihood.hpp"

namespace stillmap::bindings {
namespace {

const bool* per_scan(const Flat<bool>& is_held_out, size_t n_scans) {
  require(is_held_out.shape(0) == n_scans, "is_held_out: expected one entry per scan");
  return is_held_out.data();
}

template <int D>
void add(StaticFractionGrid<D>& fractions, const Points<D>& points, const Flat<bool>& hit,
         const Flat<float>& e, const Flat<int64_t>& offset, const Poses<D>& poses,
         const Flat<bool>& is_held_out) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const float* weights = per_beam(e, points.shape(0), "e");
  const bool* held_out = per_scan(is_held_out, scans.n_scans);
  nb::gil_scoped_release released;
  fractions.add(scans, weights, held_out);
}

BeamModel checked(double stopping_rate, double range_std, double late_share, double mean_delay,
                  double outlier_share) {
  require(stopping_rate > 0.0 && std::isfinite(stopping_rate),
          "stopping_rate: expected a positive rate");
  require(range_std > 0.0 && range_std <= 1e3, "range_std: expected a positive length in metres");
  require(mean_delay > 0.0 && mean_delay <= 1e3,
          "mean_delay: expected a positive length in metres");
  require_probability(late_share, "late_share");
  require(outlier_share > 0.0 && outlier_share < 1.0,
          "outlier_share: expected a share between 0 and 1");
  return {stopping_rate, range_std, late_share, mean_delay, outlier_share};
}

template <int D>
auto scores(const StaticFractionGrid<D>& fractions, const Points<D>& points, const Flat<bool>& hit,
            const Flat<int64_t>& offset, const Poses<D>& poses, const Flat<bool>& is_held_out,
            double stopping_rate, double range_std, double late_share, double mean_delay,
            double outlier_share, int threads) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const bool* held_out = per_scan(is_held_out, scans.n_scans);
  const BeamModel model = checked(stopping_rate, range_std, late_share, mean_delay, outlier_share);
  std::vector<HeldOutScore> sums(scans.n_scans);
  {
    nb::gil_scoped_release released;
    score_held_out<D>(fractions, scans, held_out, model, threads, sums.data());
  }
  std::vector<double> out;
  out.reserve(2 * sums.size());
  for (const auto& s : sums) out.insert(out.end(), {s.log_likelihood_gain, s.beam_count});
  return to_numpy(std::move(out), {scans.n_scans, 2});
}

template <int D>
void bind(nb::module_& m, const char* name) {
  using S = StaticFractionGrid<D>;
  nb::class_<S>(m, name, "Mean e of the returns in each cell, and the rates at which beams end.")
      .def(nb::init<double>(), nb::arg("resolution"))
      .def_prop_ro("resolution", &S::resolution, "metres")
      .def_prop_ro("end_rate", &S::end_rate, "beam ends per metre")
      .def_prop_ro("dynamic_rate", &S::dynamic_rate, "beam ends on moving objects, per metre")
      .def("add", &add<D>, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::arg("is_held_out").noconvert(),
           "Adds the beams of the scans that are not held out; e (M,) float32, is_held_out (T,) "
           "bool.");
  m.def("score_held_out", &scores<D>, nb::arg("fractions"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("is_held_out").noconvert(), nb::kw_only(),
        nb::arg("stopping_rate"), nb::arg("range_std"), nb::arg("late_share"),
        nb::arg("mean_delay"), nb::arg("outlier_share"), nb::arg("threads") = 1,
        "(T, 2) float64 per held-out scan, zeros for the others: log likelihood ratio of its "
        "ranges against a model that ends beams at one rate everywhere, in nats; number of beams. "
        "stopping_rate: ends per metre in static cells; range_std in metres; late_share of the "
        "beams end mean_delay metres behind the surface on average; outlier_share of the density "
        "is that of the other model.");
}

}  // namespace

void bind_held_out_likelihood(nb::module_& m) {
  bind<2>(m, "StaticFractionGrid2D");
  bind<3>(m, "StaticFractionGrid3D");
}

}  // namespace stillmap::bindings
