#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/vector.h>

#include <array>
#include <limits>
#include <type_traits>
#include <utility>
#include <vector>

#include "arrays.hpp"
#include "bindings.hpp"
#include "cell_box.hpp"
#include "stillmap/occupancy/occupancy_filter.hpp"
#include "stillmap/occupancy/sweep_filter.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap::bindings {
namespace {

constexpr float kUnknown = std::numeric_limits<float>::quiet_NaN();
constexpr double kMinPixel = 0.004;  // radians: the image of a sweep has a few MB at most

void check_options(double resolution, const FilterOptions& options) {
  require(resolution > 0.0 && std::isfinite(resolution), "resolution: expected a positive length");
  const size_t n = options.rho.size();
  require(n > 0 && n <= CellFilters::kMaxClasses, "rho: expected 1 to 32 classes");
  require(options.tau.size() == n && options.weights.size() == n,
          "tau, weights: expected one for each class");
  require(options.n_static > 0 && options.n_static < n,
          "n_static: expected static classes and others");
  for (size_t c = 0; c < n; ++c) {
    require(options.rho[c] > 0.0 && options.rho[c] < 1.0, "rho: expected values in (0, 1)");
    require(options.tau[c] > 0.0, "tau: expected positive seconds");
    require(options.weights[c] > 0.0, "weights: expected positive values");
  }
  require(options.p_detection > 0.0 && options.p_detection < 1.0,
          "p_detection: expected a probability in (0, 1)");
  require(options.bin_seconds > 0.0, "bin_seconds: expected positive seconds");
  require(options.lateral_std > 0.0, "lateral_std: expected a positive length in cells");
  require(options.hit_radius >= 0.0, "hit_radius: expected a length in cells");
  require(options.max_log_ratio > 0.0, "max_log_ratio: expected positive nats");
}

using Filter2D = OccupancyFilter<2>;

void add_scan(Filter2D& filter, const Points<2>& points, const Flat<bool>& hit,
              const Flat<float>& margin, const Flat<int64_t>& offset, const Poses<2>& poses,
              int64_t time_bin, int32_t tag) {
  const auto scans = scans_from<2>(points, hit, offset, poses);
  const float* cells = per_beam(margin, points.shape(0), "margin");
  for (size_t n = 0; n < points.shape(0); ++n)
    require(cells[n] >= 0.0f, "margin: expected lengths in cells that are not negative");
  require(tag >= 0, "tag: expected a number that is not negative");
  nb::gil_scoped_release released;
  filter.add(scans, cells, time_bin, tag);
}

void add_sweep(SweepFilter& filter, const Points<3>& points, const Flat<bool>& hit,
               const Flat<int64_t>& offset, const Poses<3>& poses,
               const std::array<double, 2>& pixel, int64_t time_bin, int32_t tag, int threads) {
  const auto sweep = scans_from<3>(points, hit, offset, poses);
  require(sweep.n_scans == 1, "T_map_sensor: expected one pose, of one sweep");
  for (const double angle : pixel)
    require(angle >= kMinPixel && angle < 1.0, "pixel: expected angles of 0.004 to 1 rad");
  require(tag >= 0, "tag: expected a number that is not negative");
  const PixelSize size{static_cast<float>(pixel[0]), static_cast<float>(pixel[1])};
  nb::gil_scoped_release released;
  filter.add(sweep, size, time_bin, tag, threads);
}

template <class Filter>
void prime(Filter& filter, const Cells<Filter::kDimension>& cells, const Flat<bool>& occupied,
           double log_ratio) {
  const size_t n = cells.shape(0);
  require(occupied.shape(0) == n, "occupied: expected as many entries as cells has rows");
  require(log_ratio >= 0.0, "log_ratio: expected nats that are not negative");
  for (size_t k = 0; k < n; ++k)
    filter.prime(cell_from<Filter::kDimension>(cells, k), occupied.data()[k], log_ratio);
}

// Labels beams first to last; a const filter may be shared between threads.
template <class Filter, class Scans>
void label_beams(Filter& filter, const Scans& scans, int64_t first, int64_t last, float prior,
                 std::vector<float>& out) {
  constexpr int D = std::remove_const_t<Filter>::kDimension;
  typename std::remove_const_t<Filter>::ConstCursor cursor(filter);
  for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t, int64_t n, const Pose<D>& pose) {
    if (n < first || n >= last) return;
    const BeamSegment<D> beam(pose, scans.points + n * D, filter.resolution());
    out[static_cast<size_t>(n)] =
        scans.hit[n] ? filter.p_static_at(cursor, beam.end, prior) : prior;
  });
}

template <class Filter>
auto label(Filter& filter, const Points<Filter::kDimension>& points, const Flat<bool>& hit,
           const Flat<int64_t>& offset, const Poses<Filter::kDimension>& poses, double prior,
           int threads) {
  constexpr int D = Filter::kDimension;
  require_probability(prior, "prior");
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const auto otherwise = static_cast<float>(prior);
  std::vector<float> out(points.shape(0), kUnknown);
  {
    nb::gil_scoped_release released;
    const auto bounds = split_evenly(points.shape(0), threads);
    if (bounds.size() == 2) {
      label_beams(filter, scans, 0, static_cast<int64_t>(points.shape(0)), otherwise, out);
    } else {
      const Filter& shared = filter;
      parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
        label_beams(shared, scans, static_cast<int64_t>(first), static_cast<int64_t>(last),
                    otherwise, out);
      });
    }
  }
  const size_t n = out.size();
  return to_numpy(std::move(out), {n});
}

Box<2> box_around(const Filter2D& filter) {
  Box<2> box;
  if (filter.blocks().empty()) return box;
  Cell<2> low = Cell<2>::Constant(std::numeric_limits<int32_t>::max()), high = -low;
  for (const auto& block : filter.blocks()) {
    low = low.cwiseMin(block->origin);
    high = high.cwiseMax(block->origin);
  }
  box.first = BlockLayout<2>::cell_at(low, 0);
  for (int d = 0; d < 2; ++d)
    box.size[static_cast<size_t>(d)] =
        static_cast<size_t>(high[d] - low[d] + 1) * BlockLayout<2>::kEdge;
  return box;
}

auto dense(const Filter2D& filter, const OptionalCell<2>& first_cell, const OptionalCell<2>& shape,
           double odds_factor) {
  require(odds_factor > 0.0, "odds_factor: expected a positive number");
  require(first_cell.has_value() == shape.has_value(),
          "first_cell, shape: expected both or neither");
  const Box<2> box = shape ? Box<2>(*first_cell, *shape) : box_around(filter);
  std::vector<float> out(box.total(), kUnknown);
  {
    nb::gil_scoped_release released;
    box.for_each_block(filter, [&](const auto& block) {
      filter.for_each_known_in(block, static_cast<float>(odds_factor),
                               [&](const Cell<2>& cell, float p) {
                                 if (box.contains(cell)) out[box.index(cell)] = p;
                               });
    });
  }
  return std::make_pair(box.first_cell(), box.shaped(std::move(out)));
}

template <class Filter>
auto take_changed(Filter& filter, size_t most, double odds_factor) {
  constexpr int D = Filter::kDimension;
  constexpr auto E = static_cast<size_t>(Filter::kEdge), n = static_cast<size_t>(Filter::kCells);
  require(odds_factor > 0.0, "odds_factor: expected a positive number");
  std::vector<int64_t> cells;
  std::vector<float> tiles;
  size_t count = 0;
  {
    nb::gil_scoped_release released;
    for (const Cell<D>& origin : filter.take_changed_blocks(most)) {
      const Cell<D> first = Filter::cell_at(origin, 0);
      cells.insert(cells.end(), first.data(), first.data() + D);
      tiles.resize(++count * n, kUnknown);
      float* tile = tiles.data() + (count - 1) * n;
      filter.for_each_known_in(
          *filter.find(origin), static_cast<float>(odds_factor),
          [&](const Cell<D>& cell, float p) { tile[Filter::local_of(cell)] = p; });
    }
  }
  auto lowest = to_numpy(std::move(cells), {count, static_cast<size_t>(D)});
  if constexpr (D == 2) {
    return std::make_pair(lowest, to_numpy(std::move(tiles), {count, E, E}));
  } else {
    return std::make_pair(lowest, to_numpy(std::move(tiles), {count, E, E, E}));
  }
}

template <class Filter>
auto known_cells(const Filter& filter, double odds_factor) {
  constexpr int D = Filter::kDimension;
  require(odds_factor > 0.0, "odds_factor: expected a positive number");
  std::vector<int64_t> cells;
  std::vector<float> p_occupied;
  {
    nb::gil_scoped_release released;
    for (const auto& block : filter.blocks())
      filter.for_each_surface_in(*block, static_cast<float>(odds_factor),
                                 [&](const Cell<D>& cell, float p) {
                                   cells.insert(cells.end(), cell.data(), cell.data() + D);
                                   p_occupied.push_back(p);
                                 });
  }
  const size_t n = p_occupied.size();
  return std::make_pair(to_numpy(std::move(cells), {n, static_cast<size_t>(D)}),
                        to_numpy(std::move(p_occupied), {n}));
}

template <class Filter>
size_t take_over(Filter& filter, const Filter& from, const Poses<Filter::kDimension>& motion,
                 size_t first, size_t count) {
  constexpr int D = Filter::kDimension;
  require(&filter != &from, "other: expected another filter");
  std::vector<Pose<D>> poses;
  for (size_t k = 0; k < motion.shape(0); ++k) {
    poses.push_back(pose_from<D>(motion.data() + k * (D + 1) * (D + 1)));
    require(poses.back().R.allFinite() && poses.back().t.allFinite(), "motion: not finite");
  }
  nb::gil_scoped_release released;
  return filter.take_over(from, poses, first, count);
}

// What the filters in 2D and 3D have in common.
template <class Filter>
nb::class_<Filter> bind_filter(nb::module_& m, const char* name, const char* doc) {
  return nb::class_<Filter>(m, name, doc)
      .def(
          "__init__",
          [](Filter* self, double resolution, std::vector<double> rho, std::vector<double> tau,
             std::vector<double> weights, size_t n_static, double p_detection, double bin_seconds,
             double lateral_std, double hit_radius, double max_log_ratio) {
            FilterOptions options{std::move(rho), std::move(tau), std::move(weights),
                                  n_static,       p_detection,    bin_seconds,
                                  lateral_std,    hit_radius,     max_log_ratio};
            check_options(resolution, options);
            new (self) Filter(resolution, std::move(options));
          },
          nb::arg("resolution"), nb::kw_only(), nb::arg("rho"), nb::arg("tau"), nb::arg("weights"),
          nb::arg("n_static"), nb::arg("p_detection"), nb::arg("bin_seconds"),
          nb::arg("lateral_std"), nb::arg("hit_radius"), nb::arg("max_log_ratio"),
          "The first n_static classes of rho and tau (s) are static. lateral_std and hit_radius "
          "are in cells, max_log_ratio in nats.")
      .def_prop_ro("resolution", &Filter::resolution, "Edge of a cell, metres.")
      .def_prop_ro("size", &Filter::size, "Number of cells in which beams ended.")
      .def("label", &label<Filter>, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("offset").noconvert(), nb::arg("T_map_sensor").noconvert(), nb::arg("prior"),
           nb::arg("threads") = 1,
           "(M,) float32 P(static) of every beam by what was added so far. NaN for unusable "
           "beams; the prior without a return, and where no beam ended before.")
      .def("known_cells", &known_cells<Filter>, nb::kw_only(), nb::arg("odds_factor") = 1.0,
           "Cells (K, D) int64 in which beams ended, and P(static and occupied) (K,) float32. The "
           "prior odds of static classes are those of the weights times odds_factor.")
      .def_prop_ro("changed_count", &Filter::changed_count,
                   "Number of blocks that changed since they were taken last.")
      .def("take_changed_blocks", &take_changed<Filter>, nb::arg("most"), nb::kw_only(),
           nb::arg("odds_factor") = 1.0,
           "Lowest cells (B, D) int64 of the first `most` blocks that changed since they were "
           "taken last, and P(static and occupied) of their cells, (B, [z,] y, x) float32; NaN: "
           "unknown.")
      .def_prop_ro("block_cells", &lowest_cells<Filter>, nb::rv_policy::move,
                   "(B, D) int64: lowest cell of each block, see `OccupancyGrid2D.block_cells`.")
      .def_prop_ro("block_count", [](const Filter& filter) { return filter.blocks().size(); })
      .def("sibling", &Filter::sibling, "An empty filter of the same kind.")
      .def("prime", &prime<Filter>, nb::arg("cells").noconvert(), nb::arg("occupied").noconvert(),
           nb::arg("log_ratio"),
           "Initializes cells (K, D) int64 from another map: occupied by static surface, for "
           "which dynamic classes fall behind by log_ratio nats, or free.")
      .def("take_over", &take_over<Filter>, nb::arg("other"), nb::arg("motion").noconvert(),
           nb::arg("first"), nb::arg("count"),
           "Adds `count` blocks of another filter from `first` on, whose cells are moved by the "
           "motions (K, D+1, D+1), metres, of the tags of the scans that observed them last. Cells "
           "that meet add their evidence. Returns the first block that is left.");
}

}  // namespace

void bind_occupancy_filter(nb::module_& m) {
  bind_filter<Filter2D>(m, "OccupancyFilter2D",
                        "Forward filters of two-state hidden Markov models in every cell, updated "
                        "scan by scan: the causal E-step.")
      .def("add", &add_scan, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("margin").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::kw_only(), nb::arg("time_bin"), nb::arg("tag"),
           "Adds the hits of scans taken in one time bin. A beam passes the cells that lie more "
           "than its margin (M,) float32, in cells, before its end. tag: see `take_over`.")
      .def("dense", &dense, nb::arg("first_cell") = nb::none(), nb::arg("shape") = nb::none(),
           nb::kw_only(), nb::arg("odds_factor") = 1.0,
           "Lowest cell (D,), and P(static and occupied) as an array [y, x] float32 of a box "
           "of cells, by default of all; NaN where no beam passed or ended.");
  bind_filter<SweepFilter>(m, "SweepFilter3D",
                           "The same in 3D: cells are looked up in the range image of each sweep.")
      .def("add", &add_sweep, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("offset").noconvert(), nb::arg("T_map_sensor").noconvert(), nb::kw_only(),
           nb::arg("pixel"), nb::arg("time_bin"), nb::arg("tag"), nb::arg("threads") = 1,
           "Adds the hits of one sweep. pixel: radians of azimuth and elevation of a pixel of its "
           "range image, at least those between neighbouring beams. tag: see `take_over`.");
}

}  // namespace stillmap::bindings
