#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/occupancy/cluster_pooling.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap::bindings {
namespace {

using Values = nb::ndarray<const float, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

constexpr float kMaxValue = 1e6f;
constexpr int kMaxColumnCells = 1 << 20;

void make(ClusterPooling* self, const SurfelMap<3>& surfel_map, const Flat<bool>& is_obstacle,
          const Values& values, int column_cells, int64_t min_surfels) {
  const size_t n = surfel_map.size(), n_values = values.shape(1);
  require(surfel_map.fitted(), "surfel_map: fit it first");
  require(is_obstacle.shape(0) == n, "is_obstacle: expected one per surfel");
  require(values.shape(0) == n && n_values > 0, "values: expected a row per surfel");
  bool bounded = true;
  for (size_t i = 0; i < n * n_values; ++i)
    bounded = bounded && std::abs(values.data()[i]) <= kMaxValue;
  require(bounded, "values: expected -1e6 to 1e6");
  require(column_cells >= 1 && column_cells <= kMaxColumnCells,
          "column_cells: expected 1 to 1048576 cells");
  require(min_surfels >= 1, "min_surfels: expected at least 1");
  new (self) ClusterPooling(surfel_map, is_obstacle.data(), values.data(), n_values,
                            {column_cells, min_surfels});
}

void add(ClusterPooling& pooling, const Points<3>& points, const Flat<bool>& hit,
         const Flat<int64_t>& offset, const Poses<3>& poses, int threads) {
  const auto scans = scans_from<3>(points, hit, offset, poses);
  nb::gil_scoped_release released;
  pooling.add(scans, threads);
}

auto means(const ClusterPooling& pooling) {
  auto out = pooling.means();
  const size_t n_values = pooling.n_values(), n = out.size() / n_values;
  return to_numpy(std::move(out), {n, n_values});
}

}  // namespace

void bind_cluster_pooling(nb::module_& m) {
  nb::class_<ClusterPooling>(
      m, "ClusterPooling3D",
      "Averages values of surfels over the connected clusters of each sweep.")
      .def("__init__", &make, nb::arg("surfel_map"), nb::arg("is_obstacle").noconvert(),
           nb::arg("values").noconvert(), nb::kw_only(), nb::arg("column_cells"),
           nb::arg("min_surfels"), nb::keep_alive<1, 2>(),
           "is_obstacle (E,) bool selects the surfels that form clusters; values (E, K) float32 "
           "are averaged. Surfels are clustered by adjacent vertical columns of column_cells x "
           "column_cells cells; clusters of fewer than min_surfels surfels are ignored.")
      .def("add", &add, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("offset").noconvert(), nb::arg("T_map_sensor").noconvert(),
           nb::arg("threads") = 1, "Adds scans; each of them is clustered by itself.")
      .def("means", &means,
           "(E, K) float32: mean values of the clusters that contain each surfel, averaged over "
           "sweeps; NaN where there is none.");
}

}  // namespace stillmap::bindings
