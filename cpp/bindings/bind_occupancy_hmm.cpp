#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <array>
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
                      const std::optional<Places<D>>& place) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  require(time_bin.shape(0) == scans.n_scans, "time_bin: expected one number per scan");
  require(!place || place->shape(0) == scans.n_scans, "positions: expected one per scan");
  nb::gil_scoped_release released;
  hmm.add(scans, time_bin.data(), place ? place->data() : nullptr, threads);
}

template <int D>
auto likelihoods(OccupancyHmm<D>& hmm, const std::optional<Flat<bool>>& among,
                 const std::optional<Slice>& rows, int threads) {
  std::vector<size_t> classes;
  require(!among || among->shape(0) == hmm.classes(), "classes: expected one per class");
  for (size_t c = 0; c < hmm.classes(); ++c)
    if (!among || among->data()[c]) classes.push_back(c);
  require(!classes.empty(), "classes: expected a class");
  const auto [first, stride, n] = rows_from(rows, hmm.surfel_map().size());
  const size_t C = classes.size();
  std::vector<float> relative(n * C);
  std::vector<double> log_best(n);
  {
    nb::gil_scoped_release released;
    hmm.likelihood(classes, first, stride, n, threads, relative.data(), log_best.data());
  }
  return std::make_tuple(to_numpy(std::move(relative), {n, C}), to_numpy(std::move(log_best), {n}));
}

// Columns of `changes`, see its docstring.
template <int D>
auto describe_changes(const OccupancyHmm<D>& hmm, const std::optional<Slice>& rows) {
  const ChangeHmm& changes = hmm.change_hmm();
  require(changes.has_paths(), "changes: expected track_changes with paths before");
  const auto [first, stride, n] = rows_from(rows, changes.members());
  std::vector<double> log_likelihood(n);
  std::vector<float> p_last(n * 2), share(n);
  std::vector<int32_t> count(n * 2), change_bins(n * 8);
  {
    nb::gil_scoped_release released;
    for (size_t i = 0; i < n; ++i) {
      const size_t k = first + i * stride;
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
  const auto [first, stride, n] = rows_from(rows, changes.members());
  std::vector<double> values(n);
  for (size_t i = 0; i < n; ++i) values[i] = changes.log_likelihood(first + i * stride);
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
                                 std::vector<double> turn, double detection) {
  if (turn.empty()) turn.assign(rho.size(), std::numeric_limits<double>::infinity());
  require(!rho.empty() && rho.size() == tau.size() && rho.size() == turn.size(),
          "rho, tau, view_angle: expected one number per class");
  require(rho.size() <= kMaxClasses, "rho, tau, view_angle: too many classes");
  for (const double r : rho) require(r > 0.0 && r < 1.0, "rho: expected shares between 0 and 1");
  for (const double t : tau) require(t > 0.0, "tau: expected positive times");
  for (const double v : turn) require(v > 0.0, "view_angle: expected positive angles");
  require(detection > 0.0 && detection < 1.0, "p_detection: expected a probability below 1");
  return {std::move(rho), std::move(tau), std::move(turn), detection};
}

template <int D>
void bind(nb::module_& m, const char* name) {
  using W = OccupancyHmm<D>;
  nb::class_<W>(m, name,
                "Likelihood of what was seen of each element, per class: occupied for a share rho, "
                "correlated over tau seconds and over turn radians of the view (inf or none given: "
                "however it turns).")
      .def(
          "__init__",
          [](W* self, const SurfelMap<D>& s, std::vector<double> rho, std::vector<double> tau,
             std::vector<double> turn, double detection, double seconds, double lateral,
             double margin, double reach, double beyond, bool normals, int threads) {
            for (const double x : {seconds, lateral, margin, reach, beyond})
              require(x > 0.0 && std::isfinite(x),
                      "bin_seconds, lateral_std, margin, hit_radius, end_margin: expected positive "
                      "numbers");
            const double r = s.resolution();
            new (self)
                W(s, checked_classes(std::move(rho), std::move(tau), std::move(turn), detection),
                  {seconds, lateral / r, margin / r, reach / r, beyond / r, 1.0, normals}, threads);
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
           "Adds scans; look (T,) int64 numbers their looks and must not fall. All scans of one "
           "look belong into one call. place (T, D): where the robot stood, metres; without, the "
           "sensors' places are asked how far the view turned.")
      .def("count_no_return_beams", &no_return_stats<D>, nb::arg("points").noconvert(),
           nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::arg("threads") = 1,
           "Beams without a return that have such beams beside them, and how many of these cross "
           "something solid.")
      .def("solid_cells", &solid_cells<D>,
           "(S, D) int64 cells of surfaces on which many beams ended: the solid things.")
      .def(
          "set_trust_beyond_solid",
          [](W& w, double trust) {
            require(trust >= 0.0 && trust <= 1.0, "trust: expected a share between 0 and 1");
            w.set_trust_beyond_solid(trust);
          },
          nb::arg("trust"),
          "How far to trust beams without a return beyond the first solid thing in their way; all "
          "the way at first.")
      .def(
          "track_changes",
          [](W& w, double tau, double passer_by_rho, double passer_by_tau, double detection,
             bool courses) {
            for (const double t : {tau, passer_by_tau})
              require(t > 0.0 && std::isfinite(t), "tau, passer_by_tau: expected positive times");
            for (const double p : {passer_by_rho, detection})
              require(p > 0.0 && p < 1.0,
                      "passer_by_rho, p_detection: expected probabilities between 0 and 1");
            w.track_changes({tau, passer_by_rho, passer_by_tau, detection}, courses);
          },
          nb::kw_only(), nb::arg("tau"), nb::arg("passer_by_rho"), nb::arg("passer_by_tau"),
          nb::arg("p_detection"), nb::arg("with_paths") = true,
          "Asks, before the first look, which elements are of things that come to stay or leave: "
          "correlation time in seconds; share of the time and correlation time of passers-by. "
          "Without courses only `change_log_likelihood` is known of them.")
      .def("change_log_likelihood", &change_log_likelihood<D>, nb::arg("rows") = nb::none(),
           "(E,) the first of `changes`.")
      .def("release_buffers", &W::release_buffers,
           "Lets go what only further looks would want; they make it anew.")
      .def(
          "changes", &describe_changes<D>, nb::arg("rows") = nb::none(),
          "Of each element: (E,) logarithm of the likelihood of everything else that was seen, if "
          "things come to stay and leave; of the most probable course (E,) float32 share of the "
          "time in which it was not empty. Then, for things alone and for anything that was there: "
          "(E, 2) float32 probability of it at the last look; (E, 2) int32 how often it came or "
          "left; (E, 2, 2, 2) int32 looks before and after the first and the last time, -1: none. "
          "rows (first, last, every): of some of the elements.")
      .def("likelihood", &likelihoods<D>, nb::arg("classes") = nb::none(),
           nb::arg("rows") = nb::none(), nb::arg("threads") = 1,
           "(E, C) float32 relative to the best class, (E,) logarithm of the best: of everything "
           "else that was seen of the cell, given that a beam ended in it; under those of the "
           "classes (bool, one per class) alone, as if there were no others. rows (first, last, "
           "every): of some of the elements.");
}

}  // namespace

void bind_occupancy_hmm(nb::module_& m) {
  bind<2>(m, "OccupancyHmm2D");
  bind<3>(m, "OccupancyHmm3D");
}

}  // namespace stillmap::bindings
