#include <nanobind/stl/array.h>
#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include <memory>

#include "arrays.hpp"
#include "bindings.hpp"
#include "cell_box.hpp"
#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/occupancy/no_return_beams.hpp"
#include "stillmap/occupancy/observation_counts.hpp"

namespace stillmap::bindings {
namespace {

template <int D>
std::shared_ptr<const NoReturnBeams<D>> no_return_beams(const std::optional<Cells<D>>& stop_cells,
                                                        double end_margin, double resolution) {
  require(end_margin >= 0.0, "end_margin: expected a length in metres that is not negative");
  if (!stop_cells) return nullptr;
  std::vector<Cell<D>> cells;
  for (size_t k = 0; k < stop_cells->shape(0); ++k) cells.push_back(cell_from<D>(*stop_cells, k));
  return std::make_shared<NoReturnBeams<D>>(NoReturnLimits<D>{cells, end_margin / resolution});
}

template <int D>
void add(ObservationCounts<D>& counts, const Points<D>& points, const Flat<bool>& hit,
         const Flat<bool>& is_dynamic, const Flat<int64_t>& offset, const Poses<D>& poses,
         const Flat<int64_t>& time_bin, int threads) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  require(is_dynamic.shape(0) == points.shape(0),
          "is_dynamic: expected " + std::to_string(points.shape(0)) +
              " entries as points has rows, got " + std::to_string(is_dynamic.shape(0)));
  require(time_bin.shape(0) == scans.n_scans, "time_bin: expected one number per scan");
  nb::gil_scoped_release released;
  counts.add(scans, is_dynamic.data(), time_bin.data(), threads);
}

template <int D>
auto dense(const ObservationCounts<D>& counts, const std::array<int64_t, D>& first_cell,
           const std::array<int64_t, D>& shape) {
  const Box<D> box(first_cell, shape);
  std::vector<uint16_t> observed(box.total(), 0), clear(box.total(), 0);
  box.for_each_block(counts, [&](const auto& block) {
    for (int i = 0; i < BlockLayout<D>::kCells; ++i) {
      const Cell<D> cell = BlockLayout<D>::cell_at(block.origin, i);
      if (!box.contains(cell)) continue;
      const CellVisits& visits = block.values[static_cast<size_t>(i)];
      observed[box.index(cell)] = visits.observed;
      clear[box.index(cell)] = visits.clear;
    }
  });
  return std::make_tuple(box.shaped(std::move(observed)), box.shaped(std::move(clear)));
}

template <int D>
void bind(nb::module_& m, const char* name) {
  using L = ObservationCounts<D>;
  nb::class_<L>(m, name,
                "Number of time bins in which a cell was observed, and in how many of them no "
                "moving object was near.")
      .def(
          "__init__",
          [](L* self, double resolution, double radius, const std::optional<Cells<D>>& stop_cells,
             double end_margin) {
            new (self)
                L(resolution, radius, no_return_beams<D>(stop_cells, end_margin, resolution));
          },
          nb::arg("resolution"), nb::kw_only(), nb::arg("radius"),
          nb::arg("stop_cells").noconvert() = nb::none(), nb::arg("end_margin") = 0.0,
          "radius: distance in metres between cell centres within which a dynamic return makes a "
          "cell not clear. stop_cells (S, D) int64, end_margin: trust in beams without a return, "
          "see `add_no_return_beams`; without stop_cells they are trusted all the way.")
      .def_prop_ro("resolution", &L::resolution, "metres")
      .def_prop_ro("radius", &L::radius, "metres")
      .def_prop_ro("dimension", [](const L&) { return D; })
      .def("add", &add<D>, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("is_dynamic").noconvert(), nb::arg("offset").noconvert(),
           nb::arg("T_map_sensor").noconvert(), nb::arg("time_bin").noconvert(),
           nb::arg("threads") = 1,
           "Adds scans; is_dynamic (M,) bool marks the returns from moving objects. time_bin (T,) "
           "int64 must not decrease and must exceed those of earlier calls.")
      .def_prop_ro("block_cells", &lowest_cells<L>, nb::rv_policy::move,
                   "(B, D) int64: lowest cell of each block, see `OccupancyGrid2D.block_cells`.")
      .def("dense", &dense<D>, nb::arg("first_cell"), nb::arg("shape"),
           "observed and clear counts, uint16 saturating at 65535, over a box of cells, axes in "
           "reverse order as in `OccupancyGrid2D.dense`.");
}

}  // namespace

void bind_observation_counts(nb::module_& m) {
  bind<2>(m, "ObservationCounts2D");
  bind<3>(m, "ObservationCounts3D");
}

}  // namespace stillmap::bindings
