#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <array>
#include <optional>

#include "arrays.hpp"
#include "bindings.hpp"
#include "row_slice.hpp"
#include "stillmap/occupancy/occupancy_hmm.hpp"
#include "stillmap/occupancy/surfel.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap::bindings {
namespace {

template <int D>
void add_end_points(SurfelMap<D>& surfel_map, const Points<D>& points, const Flat<bool>& hit,
                    const Flat<int64_t>& offset, const Poses<D>& poses,
                    const std::optional<Flat<int64_t>>& time_bin, int threads) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  require(!time_bin || time_bin->shape(0) == scans.n_scans,
          "time_bin: expected one number per scan");
  for (size_t t = 0; time_bin && t < scans.n_scans; ++t)
    require(time_bin->data()[t] >= 0 && time_bin->data()[t] <= kMaxTimeBin,
            "time_bin: out of range");
  nb::gil_scoped_release released;
  surfel_map.add(scans, time_bin ? time_bin->data() : nullptr, threads);
}

// (E, 2) first and last time bin with a return
template <int D>
auto hit_spans(const SurfelMap<D>& surfel_map) {
  std::vector<int32_t> out;
  for (const TimeSpan& span : surfel_map.hit_spans())
    out.insert(out.end(), {span.first, span.last});
  const size_t n = surfel_map.hit_spans().size();
  return to_numpy(std::move(out), {n, 2});
}

template <int D>
auto surfel_of_beams(const SurfelMap<D>& surfel_map, const Points<D>& points, const Flat<bool>& hit,
                     const Flat<int64_t>& offset, const Poses<D>& poses, int threads) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  std::vector<int32_t> out(points.shape(0));
  {
    nb::gil_scoped_release released;
    associate_beams<D>(surfel_map, scans, threads, out.data());
  }
  const size_t n = out.size();
  return to_numpy(std::move(out), {n});
}

// Cells, means and normals (E, D), distances from the plane, prominences and beam counts (E,).
template <int D>
auto describe_surfels(const SurfelMap<D>& surfel_map, const std::optional<Slice>& rows) {
  require(surfel_map.fitted(), "surfel_map: fit it first");
  const auto [first, step, n] = rows_from(rows, surfel_map.size());
  const auto d = static_cast<size_t>(D);
  std::vector<int64_t> cells(n * d), beams(n);
  std::vector<double> means(n * d), normals(n * d), centre_to_plane(n), prominence(n);
  for (size_t i = 0; i < n; ++i) {
    const auto k = static_cast<int32_t>(first + i * step);
    for (int a = 0; a < D; ++a) {
      const size_t at = i * d + static_cast<size_t>(a);
      cells[at] = surfel_map.cell(k)[a];
      means[at] = surfel_map.surfel(k).mean[a] * surfel_map.resolution();
      normals[at] = surfel_map.surfel(k).normal[a];
    }
    beams[i] = surfel_map.beam_count(k);
    prominence[i] = surfel_map.surfel(k).prominence;
    centre_to_plane[i] = surfel_map.surfel(k).centre_to_plane * surfel_map.resolution();
  }
  return std::make_tuple(to_numpy(std::move(cells), {n, d}), to_numpy(std::move(means), {n, d}),
                         to_numpy(std::move(normals), {n, d}),
                         to_numpy(std::move(centre_to_plane), {n}),
                         to_numpy(std::move(prominence), {n}), to_numpy(std::move(beams), {n}));
}

template <int D>
void bind(nb::module_& m, const char* name) {
  using S = SurfelMap<D>;
  nb::class_<S>(m, name, "One surfel per cell that contains end points.")
      .def(nb::init<double>(), nb::arg("resolution"))
      .def_prop_ro("resolution", &S::resolution, "metres")
      .def_prop_ro("dimension", [](const S&) { return D; })
      .def_prop_ro("size", &S::size, "number of surfels")
      .def_prop_ro(
          "noise_std", [](const S& s) { return s.noise_std() * s.resolution(); },
          "metres: median standard deviation of end points across planar surfels; 0 before `fit`")
      .def("add_end_points", &add_end_points<D>, nb::arg("points").noconvert(),
           nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::arg("time_bin").noconvert() = nb::none(),
           nb::arg("threads") = 1,
           "Adds the end points of returns; time_bin (T,) int64 in all calls, or in none.")
      .def_prop_ro("hit_spans", &hit_spans<D>, nb::rv_policy::move,
                   "(E, 2) int32: first and last time bin with a return in the cell of each "
                   "surfel, after `fit`; (0, 2) without time bins.")
      .def("fit", &S::fit, nb::arg("threads") = 1, nb::call_guard<nb::gil_scoped_release>(),
           "Computes means, normals and noise_std; no end points can be added afterwards.")
      .def("surfels", &describe_surfels<D>, nb::arg("rows") = nb::none(),
           "cells (E, D) int64, means (E, D) metres, normals (E, D) (zero: not planar), distance "
           "(E,) of the cell centre from the plane in metres (zero: not planar), prominence (E,): "
           "number of returns relative to the largest in the neighbourhood, number of returns (E,) "
           "int64. rows (first, last, step) selects surfels.")
      .def("associate_beams", &surfel_of_beams<D>, nb::arg("points").noconvert(),
           nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::arg("threads") = 1,
           "(M,) int32: index of the surfel that each beam ended on, -1: none.");
}

}  // namespace

void bind_surfel_map(nb::module_& m) {
  m.def(
      "normal_cdf",
      [](const Flat<double>& x) {
        std::vector<double> out(x.shape(0));
        for (size_t i = 0; i < out.size(); ++i)
          out[i] = 0.5 * std::erfc(-x.data()[i] / std::sqrt(2.0));
        const size_t n = out.size();
        return to_numpy(std::move(out), {n});
      },
      nb::arg("x").noconvert(), "Standard normal distribution function of (n,) float64.");
  bind<2>(m, "SurfelMap2D");
  bind<3>(m, "SurfelMap3D");
}

}  // namespace stillmap::bindings
