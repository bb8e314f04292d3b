#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/occupancy/held_out_likelihood.hpp"

namespace stillmap::bindings {
namespace {

const bool* per_scan(const Flat<bool>& held, size_t n_scans) {
  require(held.shape(0) == n_scans, "held: expected one entry per scan");
  return held.data();
}

template <int D>
void add_others(StaticFractionGrid<D>& shares, const Points<D>& points, const Flat<bool>& hit,
                const Flat<float>& e, const Flat<int64_t>& offset, const Poses<D>& poses,
                const Flat<bool>& held) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const float* weights = per_beam(e, points.shape(0), "e");
  const bool* left_out = per_scan(held, scans.n_scans);
  nb::gil_scoped_release released;
  shares.add(scans, weights, left_out);
}

BeamModel checked(double stopping, double noise, double late, double delay, double outliers) {
  require(stopping > 0.0 && std::isfinite(stopping), "stopping: expected a positive rate");
  require(noise > 0.0 && noise <= 1e3, "noise: expected a positive length in metres");
  require(delay > 0.0 && delay <= 1e3, "delay: expected a positive length in metres");
  require_probability(late, "late");
  require(outliers > 0.0 && outliers < 1.0, "outliers: expected a share between 0 and 1");
  return {stopping, noise, late, delay, outliers};
}

template <int D>
auto gains(const StaticFractionGrid<D>& shares, const Points<D>& points, const Flat<bool>& hit,
           const Flat<int64_t>& offset, const Poses<D>& poses, const Flat<bool>& held,
           double stopping, double noise, double late, double delay, double outliers, int threads) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const bool* left_out = per_scan(held, scans.n_scans);
  const BeamModel model = checked(stopping, noise, late, delay, outliers);
  std::vector<HeldOutScore> sums(scans.n_scans);
  {
    nb::gil_scoped_release released;
    score_held_out<D>(shares, scans, left_out, model, threads, sums.data());
  }
  std::vector<double> out;
  out.reserve(2 * sums.size());
  for (const auto& s : sums) out.insert(out.end(), {s.log_likelihood_gain, s.beam_count});
  return to_numpy(std::move(out), {scans.n_scans, 2});
}

template <int D>
void bind(nb::module_& m, const char* name) {
  using S = StaticFractionGrid<D>;
  nb::class_<S>(m, name, "Mean e of the beams that ended in each cell; rates at which beams end.")
      .def(nb::init<double>(), nb::arg("resolution"))
      .def_prop_ro("resolution", &S::resolution, "metres")
      .def_prop_ro("end_rate", &S::end_rate, "ends of beams per metre")
      .def_prop_ro("dynamic_rate", &S::dynamic_rate, "ends at what moves, per metre")
      .def("add", &add_others<D>, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::arg("held").noconvert(),
           "Adds the beams of the scans that are not held (T,); e (M,) float32.");
  m.def("held_out", &gains<D>, nb::arg("shares"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("held").noconvert(), nb::kw_only(),
        nb::arg("stopping"), nb::arg("noise"), nb::arg("late"), nb::arg("delay"),
        nb::arg("outliers"), nb::arg("threads") = 1,
        "(T, 2) float64 per scan, zeros where it is not held: log likelihood of its ranges above "
        "that of a world in which beams end at the same rate everywhere, in nats; beams.");
}

}  // namespace

void bind_held_out_likelihood(nb::module_& m) {
  bind<2>(m, "StaticShares2D");
  bind<3>(m, "StaticShares3D");
}

}  // namespace stillmap::bindings
