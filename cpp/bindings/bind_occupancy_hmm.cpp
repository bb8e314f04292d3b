#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <optional>

#include "arrays.hpp"
#include "bindings.hpp"
#include "row_slice.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/occupancy/change_hmm.hpp"
#include "stillmap/occupancy/observation.hpp"
#include "stillmap/occupancy/occupancy_hmm.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/occupancy/two_state_chains.hpp"

namespace stillmap::bindings {
namespace {

template <int D>
void add_observations(OccupancyHmm<D>& hmm, const Points<D>& points, const Flat<bool>& hit,
                      const Flat<int64_t>& offset, const Poses<D>& poses,
                      const Flat<int64_t>& time_bin, int threads,
                      const std::optional<Positions<D>>& positions) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  require(time_bin.shape(0) == scans.n_scans, "time_bin: expected one number per scan");
  require(!positions || positions->shape(0) == scans.n_scans, "positions: expected one per scan");
  nb::gil_scoped_release released;
  hmm.add(scans, time_bin.data(), positions ? positions->data() : nullptr, threads);
}

template <int D>
auto likelihoods(OccupancyHmm<D>& hmm, const std::optional<Flat<bool>>& selected,
                 const std::optional<Slice>& rows, int threads) {
  std::vector<size_t> classes;
  require(!selected || selected->shape(0) == hmm.classes(), "classes: expected one per class");
  for (size_t c = 0; c < hmm.classes(); ++c)
    if (!selected || selected->data()[c]) classes.push_back(c);
  require(!classes.empty(), "classes: expected at least one");
  const auto [first, step, n] = rows_from(rows, hmm.surfel_map().size());
  const size_t C = classes.size();
  std::vector<float> relative(n * C);
  std::vector<double> log_best(n);
  {
    nb::gil_scoped_release released;
    hmm.likelihood(classes, first, step, n, threads, relative.data(), log_best.data());
  }
  return std::make_tuple(to_numpy(std::move(relative), {n, C}), to_numpy(std::move(log_best), {n}));
}

// Columns of `changes`, see its docstring.
template <int D>
auto describe_changes(const OccupancyHmm<D>& hmm, const std::optional<Slice>& rows) {
  const ChangeHmm& changes = hmm.change_hmm();
  require(changes.has_paths(), "changes: expected track_changes with paths before");
  const auto [first, step, n] = rows_from(rows, changes.members());
  std::vector<double> log_likelihood(n);
  std::vector<float> p_last(n * 2), share(n);
  std::vector<int32_t> count(n * 2), change_bins(n * 8);
  {
    nb::gil_scoped_release released;
    for (size_t i = 0; i < n; ++i) {
      const size_t k = first + i * step;
      const StatePath& path = changes.most_probable_path(k);
      log_likelihood[i] = changes.log_likelihood(k);
      share[i] = changes.occupied_fraction(k);
      p_last[2 * i] = changes.p_final(k, ChangeHmm::kObject);
      p_last[2 * i + 1] = 1.0f - changes.p_final(k, ChangeHmm::kEmpty);
      for (const auto& [summary, j] :
           {std::pair{&path.object_changes, 2 * i}, {&path.occupancy_changes, 2 * i + 1}}) {
        count[j] = summary->count;
        change_bins[4 * j] = summary->first.before;
        change_bins[4 * j + 1] = summary->first.after;
        change_bins[4 * j + 2] = summary->last.before;
        change_bins[4 * j + 3] = summary->last.after;
      }
    }
  }
  return std::make_tuple(to_numpy(std::move(log_likelihood), {n}), to_numpy(std::move(share), {n}),
                         to_numpy(std::move(p_last), {n, 2}), to_numpy(std::move(count), {n, 2}),
                         to_numpy(std::move(change_bins), {n, 2, 2, 2}));
}

template <int D>
auto change_log_likelihood(const OccupancyHmm<D>& hmm, const std::optional<Slice>& rows) {
  const ChangeHmm& changes = hmm.change_hmm();
  const auto [first, step, n] = rows_from(rows, changes.members());
  std::vector<double> values(n);
  for (size_t i = 0; i < n; ++i) values[i] = changes.log_likelihood(first + i * step);
  return to_numpy(std::move(values), {n});
}

template <int D>
auto no_return_stats(const OccupancyHmm<D>& hmm, const Points<D>& points, const Flat<bool>& hit,
                     const Flat<int64_t>& offset, const Poses<D>& poses, int threads) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  nb::gil_scoped_release released;
  const NoReturnStats stats = hmm.no_return_stats(scans, threads);
  return std::make_tuple(stats.beam_count, stats.through_solid);
}

template <int D>
auto solid_cells(const OccupancyHmm<D>& hmm) {
  std::vector<int64_t> out;
  for (const Cell<D>& cell : hmm.solid_cells()) out.insert(out.end(), cell.data(), cell.data() + D);
  const size_t n = out.size() / D;
  return to_numpy(std::move(out), {n, static_cast<size_t>(D)});
}

OccupancyClasses checked_classes(std::vector<double> rho, std::vector<double> tau,
                                 std::vector<double> view_angle, double p_detection) {
  if (view_angle.empty()) view_angle.assign(rho.size(), std::numeric_limits<double>::infinity());
  require(!rho.empty() && rho.size() == tau.size() && rho.size() == view_angle.size(),
          "rho, tau, view_angle: expected one number per class");
  require(rho.size() <= kMaxClasses, "rho, tau, view_angle: too many classes");
  for (const double r : rho) require(r > 0.0 && r < 1.0, "rho: expected shares between 0 and 1");
  for (const double t : tau) require(t > 0.0, "tau: expected positive times");
  for (const double v : view_angle) require(v > 0.0, "view_angle: expected positive angles");
  require(p_detection > 0.0 && p_detection < 1.0, "p_detection: expected a probability below 1");
  return {std::move(rho), std::move(tau), std::move(view_angle), p_detection};
}

auto miss_counts(const OccupancyHmm<3>& hmm, const std::optional<Slice>& rows) {
  const std::vector<MissCounts>& counts = hmm.miss_counts();
  const auto [first, step, n] = rows_from(rows, counts.size());
  std::vector<float> out;
  out.reserve(2 * n);
  for (size_t i = 0; i < n; ++i) {
    const MissCounts& of = counts[first + i * step];
    out.insert(out.end(), {of.all(), of.surrounded()});
  }
  return to_numpy(std::move(out), {n, 2});
}

void bind_surroundings(nb::class_<OccupancyHmm<3>>& c) {
  using W = OccupancyHmm<3>;
  c.def(
       "track_surroundings",
       [](W& w, double edge) {
         const double cells = edge / w.surfel_map().resolution();
         require(cells > 0.0 && cells < 1e6, "edge: expected a length in metres");
         w.track_surroundings(std::max(1, static_cast<int32_t>(std::lround(cells))));
       },
       nb::arg("edge"),
       "Enables `miss_counts`; to be called before the first observation. edge: metres, of the "
       "coarse cells that surroundings are made of, rounded to cells.")
      .def("miss_counts", &miss_counts, nb::arg("rows") = nb::none(),
           "(E, 2) float32: misses of each surfel, and misses in time bins in which beams ended in "
           "its surroundings, on surfels without a plane; summed by reliability, without those one "
           "time bin before or after a hit of it. rows (first, last, step) selects surfels.");
}

template <int D>
nb::class_<OccupancyHmm<D>> bind(nb::module_& m, const char* name) {
  using W = OccupancyHmm<D>;
  nb::class_<W> c(
      m, name,
      "Occupancy HMM of each surfel: likelihood of its observations under classes of two-state "
      "Markov chains with stationary occupancy rho, correlation time tau (seconds) and correlation "
      "angle view_angle of the line of sight (radians; inf or none given: independent of it).");
  c.def(
       "__init__",
       [](W* self, const SurfelMap<D>& s, std::vector<double> rho, std::vector<double> tau,
          std::vector<double> view_angle, double p_detection, double bin_seconds,
          double lateral_std, double margin, double hit_radius, double end_margin, bool use_normals,
          int threads) {
         for (const double x : {bin_seconds, lateral_std, margin, hit_radius, end_margin})
           require(x > 0.0 && std::isfinite(x),
                   "bin_seconds, lateral_std, margin, hit_radius, end_margin: expected positive "
                   "numbers");
         const double r = s.resolution();
         new (self) W(
             s, checked_classes(std::move(rho), std::move(tau), std::move(view_angle), p_detection),
             {bin_seconds, lateral_std / r, margin / r, hit_radius / r, end_margin / r, 1.0,
              use_normals},
             threads);
       },
       nb::arg("surfel_map"), nb::kw_only(), nb::arg("rho"), nb::arg("tau"),
       nb::arg("view_angle") = std::vector<double>{}, nb::arg("p_detection"),
       nb::arg("bin_seconds"), nb::arg("lateral_std"), nb::arg("margin"), nb::arg("hit_radius"),
       nb::arg("end_margin"), nb::arg("use_normals") = true, nb::arg("threads") = 1,
       nb::keep_alive<1, 2>())
      .def("add", &add_observations<D>, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("offset").noconvert(), nb::arg("T_map_sensor").noconvert(),
           nb::arg("time_bin").noconvert(), nb::arg("threads") = 1,
           nb::arg("positions").noconvert() = nb::none(),
           "Adds scans; time_bin (T,) int64 must not decrease, and all scans of one bin belong in "
           "one call. positions (T, D): robot positions in metres, from which the change of the "
           "line of sight is computed; default: the sensor positions.")
      .def("count_no_return_beams", &no_return_stats<D>, nb::arg("points").noconvert(),
           nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::arg("threads") = 1,
           "Number of beams without a return in runs of at least three, and how many of them cross "
           "a solid surfel.")
      .def("solid_cells", &solid_cells<D>,
           "(S, D) int64: cells of solid surfels, planar ones with many returns.")
      .def(
          "set_trust_beyond_solid",
          [](W& w, double trust) {
            require(trust >= 0.0 && trust <= 1.0, "trust: expected a share between 0 and 1");
            w.set_trust_beyond_solid(trust);
          },
          nb::arg("trust"),
          "Trust in beams without a return beyond the first solid surfel they cross, from 0 to 1 "
          "(initially 1).")
      .def(
          "track_changes",
          [](W& w, double tau, double passer_by_rho, double passer_by_tau, double p_detection,
             bool with_paths) {
            for (const double t : {tau, passer_by_tau})
              require(t > 0.0 && std::isfinite(t), "tau, passer_by_tau: expected positive times");
            for (const double p : {passer_by_rho, p_detection})
              require(p > 0.0 && p < 1.0,
                      "passer_by_rho, p_detection: expected probabilities between 0 and 1");
            w.track_changes({tau, passer_by_rho, passer_by_tau, p_detection}, with_paths);
          },
          nb::kw_only(), nb::arg("tau"), nb::arg("passer_by_rho"), nb::arg("passer_by_tau"),
          nb::arg("p_detection"), nb::arg("with_paths") = true,
          "Enables the change HMM (object, empty, passer-by); to be called before the first "
          "observation. tau: correlation time of objects in seconds; passer_by_rho, passer_by_tau: "
          "stationary probability and correlation time of passers-by; without with_paths only "
          "`change_log_likelihood` is computed.")
      .def("change_log_likelihood", &change_log_likelihood<D>, nb::arg("rows") = nb::none(),
           "(E,) float64: the first result of `changes`.")
      .def("release_buffers", &W::release_buffers,
           "Frees the buffers that only `add` needs; it makes them anew.")
      .def("changes", &describe_changes<D>, nb::arg("rows") = nb::none(),
           "Change HMM of each surfel: (E,) float64 log likelihood of its observations given one "
           "return; (E,) float32 fraction of time in which the Viterbi path is not empty. Then, "
           "for objects alone and for anything present: (E, 2) float32 probability at the last "
           "observation; (E, 2) int32 number of changes on the Viterbi path; (E, 2, 2, 2) int32 "
           "time bins before and after the first and the last change, -1: none. rows (first, last, "
           "step) selects surfels.")
      .def("likelihood", &likelihoods<D>, nb::arg("classes") = nb::none(),
           nb::arg("rows") = nb::none(), nb::arg("threads") = 1,
           "Likelihood of the observations of each surfel given one return in its cell: (E, C) "
           "float32 relative to the best class, (E,) float64 logarithm of the best. classes (bool, "
           "one per class) selects classes, rows (first, last, step) surfels.");
  return c;
}

}  // namespace

void bind_occupancy_hmm(nb::module_& m) {
  bind<2>(m, "OccupancyHmm2D");
  auto in_3d = bind<3>(m, "OccupancyHmm3D");
  bind_surroundings(in_3d);
}

}  // namespace stillmap::bindings
