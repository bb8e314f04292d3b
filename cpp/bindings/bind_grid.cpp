#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/pair.h>
#include <nanobind/stl/tuple.h>

#include <array>
#include <cmath>
#include <limits>
#include <optional>

#include "arrays.hpp"
#include "bindings.hpp"
#include "cell_box.hpp"
#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"

namespace stillmap::bindings {
namespace {

template <int D>
nb::ndarray<nb::numpy, double> alpha_beta(const OccupancyGrid<D>& grid, const Cells<D>& cells) {
  const size_t n = cells.shape(0);
  std::vector<double> out(2 * n, 0.0);
  BlockCursor<const OccupancyGrid<D>> cursor(grid);
  for (size_t k = 0; k < n; ++k) {
    if (const CellCounts* c = cursor.find_observed(cell_from<D>(cells, k))) {
      out[2 * k] = from_fixed(c->alpha);
      out[2 * k + 1] = from_fixed(c->beta);
    }
  }
  return to_numpy(std::move(out), {n, 2});
}

// Calls visit(cell, counts) for the observed cells of a block.
template <int D, class Visit>
void for_each_observed_in(const typename OccupancyGrid<D>::Block& block, Visit&& visit) {
  for (int i = 0; i < BlockLayout<D>::kCells; ++i) {
    const CellCounts& c = block.values[static_cast<size_t>(i)];
    if (c.alpha + c.beta != 0) visit(BlockLayout<D>::cell_at(block.origin, i), c);
  }
}

template <int D, class Visit>
void for_each_observed(const OccupancyGrid<D>& grid, Visit&& visit) {
  for (const auto& block : grid.blocks()) for_each_observed_in<D>(*block, visit);
}

// Bounding box of the observed cells.
template <int D>
Box<D> box_around(const OccupancyGrid<D>& grid) {
  Cell<D> first = Cell<D>::Constant(std::numeric_limits<int32_t>::max());
  Cell<D> last = Cell<D>::Constant(std::numeric_limits<int32_t>::min());
  for_each_observed(grid, [&](const Cell<D>& cell, const CellCounts&) {
    first = first.cwiseMin(cell);
    last = last.cwiseMax(cell);
  });
  Box<D> box;
  if (first[0] > last[0]) return box;
  box.first = first;
  for (int d = 0; d < D; ++d)
    box.size[static_cast<size_t>(d)] = static_cast<size_t>(last[d] - first[d] + 1);
  return box;
}

// Log marginal likelihood of the counts of a cell whose occupancy has the prior Beta(a, b):
// ln B(alpha + a, beta + b) - ln B(a, b).
class CellEvidence {
 public:
  CellEvidence(double a, double b) : a_(a), b_(b) {
    require(a > 0.0 && b > 0.0, "a, b: expected positive pseudo-counts");
    of_hits_ = std::lgamma(a);
    of_both_ = std::lgamma(a + b) - of_hits_ - std::lgamma(b);
  }

  double operator()(Fixed alpha, Fixed beta) const {
    const double hits = alpha == 0 ? of_hits_ : std::lgamma(from_fixed(alpha) + a_);
    return hits + std::lgamma(from_fixed(beta) + b_) -
           std::lgamma(from_fixed(alpha + beta) + a_ + b_) + of_both_;
  }

 private:
  double a_, b_, of_hits_, of_both_;
};

// Free space is left out: its cells depend on each other, and all places have some.
template <int D>
double log_evidence(const OccupancyGrid<D>& grid, double a, double b) {
  const CellEvidence evidence(a, b);
  double sum = 0.0;
  for_each_observed(grid, [&](const Cell<D>&, const CellCounts& c) {
    if (c.alpha > 0) sum += evidence(c.alpha, c.beta);
  });
  return sum;
}

// Log evidence of the counts of both grids in one map over that of a map of each.
template <int D>
double evidence_gain(const OccupancyGrid<D>& grid, const OccupancyGrid<D>& other, double a,
                     double b) {
  require(grid.resolution() == other.resolution(), "other: expected the same resolution");
  const CellEvidence evidence(a, b);
  BlockCursor<const OccupancyGrid<D>> cursor(grid);
  double sum = 0.0;
  for_each_observed(other, [&](const Cell<D>& cell, const CellCounts& c) {
    const CellCounts* here = cursor.find_observed(cell);
    if (here == nullptr || here->alpha + c.alpha == 0) return;
    sum += evidence(here->alpha + c.alpha, here->beta + c.beta);
    sum -= evidence(here->alpha, here->beta) + evidence(c.alpha, c.beta);
  });
  return sum;
}

template <int D>
auto box_of(const OccupancyGrid<D>& grid) {
  const Box<D> box = box_around(grid);
  std::array<int64_t, D> shape;
  for (size_t d = 0; d < D; ++d) shape[d] = static_cast<int64_t>(box.size[D - 1 - d]);
  return std::make_pair(box.first_cell(), shape);
}

template <int D>
auto dense(const OccupancyGrid<D>& grid, const OptionalCell<D>& first_cell,
           const OptionalCell<D>& shape) {
  if (first_cell.has_value() != shape.has_value())
    throw std::invalid_argument("first_cell, shape: expected both or neither");
  const Box<D> box = shape ? Box<D>(*first_cell, *shape) : box_around(grid);
  std::vector<double> alpha(box.total(), 0.0), beta(box.total(), 0.0);
  box.for_each_block(grid, [&](const auto& block) {
    for_each_observed_in<D>(block, [&](const Cell<D>& cell, const CellCounts& c) {
      if (!box.contains(cell)) return;
      alpha[box.index(cell)] = from_fixed(c.alpha);
      beta[box.index(cell)] = from_fixed(c.beta);
    });
  });
  return std::make_tuple(box.first_cell(), box.shaped(std::move(alpha)),
                         box.shaped(std::move(beta)));
}

template <int D>
void bind(nb::module_& m, const char* name) {
  using G = OccupancyGrid<D>;
  nb::class_<G>(m, name, "Block-sparse counts alpha, beta of (10); cell = floor(x / resolution).")
      .def(nb::init<double, double, bool>(), nb::arg("resolution"), nb::arg("approach") = 0.0,
           nb::arg("moments") = true,
           "approach: length in metres before the end of a beam whose crossings are ignored in the "
           "likelihood field of registration; alpha, beta do not depend on it. moments: False "
           "leaves out what registration alone needs, most of the memory of cells with returns.")
      .def_prop_ro("resolution", &G::resolution, "metres")
      .def_prop_ro("approach", &G::approach, "metres")
      .def_prop_ro("dimension", [](const G&) { return D; })
      .def("merge", &G::merge, nb::arg("other"), "Adds the sums of another grid.")
      .def("alpha_beta", &alpha_beta<D>, nb::arg("cells").noconvert(),
           "(K, 2) float64: sums alpha, beta of cells (K, D) int64; 0, 0 for unobserved cells.")
      .def("log_evidence", &log_evidence<D>, nb::arg("a"), nb::arg("b"),
           "Log marginal likelihood in nats of the counts of cells with returns: the occupancy of "
           "each has the prior Beta(a, b) and is integrated out.")
      .def("evidence_gain", &evidence_gain<D>, nb::arg("other"), nb::arg("a"), nb::arg("b"),
           "Nats by which a map of the counts of both grids has more evidence than a map of each, "
           "as of `log_evidence`, in the cells that both observe and in which either has returns.")
      .def("bounding_box", &box_of<D>,
           "first_cell (D,) int64 and shape of the bounding box of observed cells, as returned by "
           "`dense`.")
      .def("dense", &dense<D>, nb::arg("first_cell") = nb::none(), nb::arg("shape") = nb::none(),
           "first_cell (D,) int64 and alpha, beta float64 over a box of cells, by default the "
           "bounding box of the observed ones; axes in reverse order: a 2D array is [row = y, "
           "column = x].")
      .def_prop_ro("block_cells", &lowest_cells<OccupancyGrid<D>>, nb::rv_policy::move,
                   "(B, D) int64: lowest cell of each block; blocks have 32 cells along each axis "
                   "in 2D and 8 in 3D, and cells outside them are unobserved.");
}

// Visitor that records the cells and chord lengths of a traversal.
template <int D>
struct Recorder : CellTracker<D> {
  std::vector<int64_t> cells;
  std::vector<double> lengths;

  void visit(double length) {
    for (int d = 0; d < D; ++d) cells.push_back(this->cell[d]);
    lengths.push_back(length);
  }
};

template <int D>
auto cells_along(const Flat<double>& start, const Flat<double>& end, double resolution) {
  const Vec<D> a = Eigen::Map<const Vec<D>>(start.data()) / resolution;
  const Vec<D> b = Eigen::Map<const Vec<D>>(end.data()) / resolution;
  require(all_below<D>(a, BlockLayout<D>::kMaxCell) && all_below<D>(b, BlockLayout<D>::kMaxCell),
          "start, end: not finite or too far away");
  Recorder<D> recorder;
  const double last_length = traverse<D>(a, b, recorder);
  recorder.visit(last_length);
  const size_t n = recorder.lengths.size();
  return std::make_tuple(to_numpy(std::move(recorder.cells), {n, static_cast<size_t>(D)}),
                         to_numpy(std::move(recorder.lengths), {n}));
}

auto cells_along_any(const Flat<double>& start, const Flat<double>& end, double resolution) {
  require(resolution > 0.0, "resolution: expected a positive length in metres");
  require(start.shape(0) == end.shape(0), "start, end: expected the same dimension");
  require(start.shape(0) == 2 || start.shape(0) == 3, "start: expected 2 or 3 coordinates");
  return start.shape(0) == 2 ? cells_along<2>(start, end, resolution)
                             : cells_along<3>(start, end, resolution);
}

}  // namespace

void bind_grid(nb::module_& m) {
  bind<2>(m, "OccupancyGrid2D");
  bind<3>(m, "OccupancyGrid3D");
  m.def("traverse", &cells_along_any, nb::arg("start").noconvert(), nb::arg("end").noconvert(),
        nb::arg("resolution"),
        "Cells (K, D) int64 of a segment (D,) to (D,) in order, end cell last, and the chord "
        "lengths (K,) in cells.");
}

}  // namespace stillmap::bindings
