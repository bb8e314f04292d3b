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

void make(ClusterPooling* self, const SurfelMap<3>& surfel_map, const Flat<bool>& stands,
          const Values& values, int column, int64_t fewest) {
  const size_t n = surfel_map.size(), kinds = values.shape(1);
  require(surfel_map.fitted(), "surface: fit it first");
  require(stands.shape(0) == n, "stands: expected one per element");
  require(values.shape(0) == n && kinds > 0, "values: expected a row per element");
  bool bounded = true;
  for (size_t i = 0; i < n * kinds; ++i)
    bounded = bounded && std::abs(values.data()[i]) <= kMaxValue;
  require(bounded, "values: expected -1e6 to 1e6");
  require(column >= 1 && column <= kMaxColumnCells, "column: expected 1 to 1048576 cells");
  require(fewest >= 1, "fewest: expected at least 1");
  new (self) ClusterPooling(surfel_map, stands.data(), values.data(), kinds, {column, fewest});
}

void add(ClusterPooling& bodies, const Points<3>& points, const Flat<bool>& hit,
         const Flat<int64_t>& offset, const Poses<3>& poses, int threads) {
  const auto scans = scans_from<3>(points, hit, offset, poses);
  nb::gil_scoped_release released;
  bodies.add(scans, threads);
}

auto means(const ClusterPooling& bodies) {
  auto out = bodies.means();
  const size_t kinds = bodies.n_values(), n = out.size() / kinds;
  return to_numpy(std::move(out), {n, kinds});
}

}  // namespace

void bind_cluster_pooling(nb::module_& m) {
  nb::class_<ClusterPooling>(m, "Bodies3D",
                             "What stands apart in each sweep, and what is known of it.")
      .def("__init__", &make, nb::arg("surface"), nb::arg("stands").noconvert(),
           nb::arg("values").noconvert(), nb::kw_only(), nb::arg("column"), nb::arg("fewest"),
           nb::keep_alive<1, 2>(),
           "stands (E,): of which elements bodies consist; values (E, K) float32: what is known of "
           "each. Columns of that many cells touch within a body, which has that many elements at "
           "least.")
      .def("add", &add, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("offset").noconvert(), nb::arg("T_map_sensor").noconvert(),
           nb::arg("threads") = 1, "Each scan is a sweep.")
      .def("means", &means,
           "(E, K) float32: mean value of the body around each element, mean over the sweeps that "
           "saw it; NaN where none did.");
}

}  // namespace stillmap::bindings
