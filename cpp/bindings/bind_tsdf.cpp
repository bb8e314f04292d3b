#include <nanobind/stl/array.h>
#include <nanobind/stl/pair.h>

#include <cmath>
#include <limits>

#include "arrays.hpp"
#include "bindings.hpp"
#include "cell_box.hpp"
#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/mesh/tsdf.hpp"

namespace stillmap::bindings {
namespace {

using Faces =
    nb::ndarray<const int32_t, nb::numpy, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

bool all_finite(const double* values, size_t n) {
  double sum = 0.0;  // 0 * x is NaN unless x is finite
  for (size_t i = 0; i < n; ++i) sum += 0.0 * values[i];
  return sum == 0.0;
}

void integrate(TsdfVolume& volume, const Positions<3>& points, const Positions<3>& origin,
               const Flat<double>& standoff, const Faces& faces, const Flat<float>& weight,
               int threads) {
  const size_t n = points.shape(0), m = faces.shape(0);
  require(origin.shape(0) == n, "origin: expected a row per point");
  require(standoff.shape(0) == n, "standoff: expected one per point");
  require(weight.shape(0) == m, "weight: expected one per face");
  require(m <= std::numeric_limits<uint32_t>::max(), "faces: too many");
  require(all_finite(points.data(), 3 * n), "points: not finite");
  require(all_finite(origin.data(), 3 * n), "origin: not finite");
  require(all_finite(standoff.data(), n), "standoff: not finite");
  bool in_range = true, valid_weights = true;
  for (size_t i = 0; i < 3 * m; ++i)
    in_range = in_range && faces.data()[i] >= 0 && static_cast<size_t>(faces.data()[i]) < n;
  for (size_t i = 0; i < m; ++i)
    valid_weights = valid_weights && weight.data()[i] >= 0.0f && std::isfinite(weight.data()[i]);
  require(in_range, "faces: point index out of range");
  require(valid_weights, "weight: expected finite values of at least 0");
  nb::gil_scoped_release released;
  volume.integrate({points.data(), origin.data(), standoff.data(), faces.data(), weight.data(), m},
                   threads);
}

auto blocks(const TsdfVolume& volume) {
  std::vector<int64_t> out;
  out.reserve(3 * volume.blocks().size());
  for (const auto& block : volume.blocks())
    for (int d = 0; d < 3; ++d) out.push_back(block->origin[d]);
  const size_t n = out.size() / 3;
  return to_numpy(std::move(out), {n, 3});
}

// Calls visit(index in the box, voxel) for the integrated voxels of a block, x fastest.
template <class Visit>
void for_each_voxel(const TsdfVolume::Block& block, const Box<3>& box, Visit&& visit) {
  for (int local = 0; local < TsdfVolume::kCells; ++local) {
    const TsdfVoxel& voxel = block.values[static_cast<size_t>(local)];
    const Cell<3> cell = BlockLayout<3>::cell_at(block.origin, local);
    if (voxel.weight > 0.0f && box.contains(cell)) visit(box.index(cell), voxel);
  }
}

auto dense(const TsdfVolume& volume, const std::array<int64_t, 3>& first_cell,
           const std::array<int64_t, 3>& shape) {
  constexpr int kEdge = TsdfVolume::kEdge;
  const Box<3> box(first_cell, shape);
  std::vector<float> metres(box.total(), std::numeric_limits<float>::quiet_NaN());
  std::vector<float> weight(metres.size(), 0.0f);
  {
    nb::gil_scoped_release released;
    Cell<3> end = box.first;
    for (int d = 0; d < 3; ++d)
      end[d] += static_cast<int32_t>(box.size[static_cast<size_t>(d)]) - 1;
    const Cell<3> low = TsdfVolume::block_of(box.first), high = TsdfVolume::block_of(end);
    const auto write = [&](const TsdfVolume::Block& block) {
      for_each_voxel(block, box, [&](size_t at, const TsdfVoxel& voxel) {
        metres[at] = voxel.weighted_distance / voxel.weight;
        weight[at] = voxel.weight;
      });
    };
    if (box.total() / static_cast<size_t>(kEdge) > 64 * volume.blocks().size()) {
      for (const auto& block : volume.blocks())
        if (box.overlaps(block->origin * kEdge, kEdge)) write(*block);
    } else if (box.total()) {
      Cell<3> at;
      for (at[2] = low[2]; at[2] <= high[2]; ++at[2])
        for (at[1] = low[1]; at[1] <= high[1]; ++at[1])
          for (at[0] = low[0]; at[0] <= high[0]; ++at[0])
            if (const auto* block = volume.find(at)) write(*block);
    }
  }
  return std::make_pair(box.shaped(std::move(metres)), box.shaped(std::move(weight)));
}

}  // namespace

void bind_tsdf(nb::module_& m) {
  nb::class_<TsdfVolume>(
      m, "TsdfVolume",
      "Truncated signed distance field (Curless and Levoy 1996), block-sparse. The lowest corner "
      "of voxel (0, 0, 0) is the origin; distances are those of voxel centres.")
      .def(nb::init<double, double, double>(), nb::arg("voxel"), nb::kw_only(),
           nb::arg("truncation_front"), nb::arg("truncation_back"),
           "voxel: edge in metres; truncation_front, truncation_back: metres in front of and "
           "behind surfaces up to which distances are integrated.")
      .def_prop_ro("voxel", &TsdfVolume::voxel)
      .def_prop_ro("truncation_front", &TsdfVolume::truncation_front)
      .def_prop_ro("truncation_back", &TsdfVolume::truncation_back)
      .def_prop_ro(
          "block_edge", [](const TsdfVolume&) { return TsdfVolume::kEdge; },
          "voxels along the edge of a block")
      .def("integrate", &integrate, nb::arg("points").noconvert(), nb::arg("origin").noconvert(),
           nb::arg("standoff").noconvert(), nb::arg("faces").noconvert(),
           nb::arg("weight").noconvert(), nb::arg("threads") = 1,
           "Integrates the voxels on lines of sight through faces (m, 3) int32 with weight (m,) "
           "float32. points (n, 3) in metres; origin (n, 3): sensor position of each; standoff "
           "(n,): distance in metres from it to the tangent plane of the surface at the point. "
           "Faces seen edge-on or with a standoff <= 0 are skipped.")
      .def("blocks", &blocks,
           "(B, 3) int64: indices of the allocated blocks, in order of allocation.")
      .def("dense", &dense, nb::arg("first_cell"), nb::arg("shape"),
           "float32 arrays [z, y, x] over a box of voxels: signed distance in metres, positive in "
           "front of the surface, NaN where unobserved; sum of weights.");
}

}  // namespace stillmap::bindings
