#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/bodies.hpp"

namespace stillmap::border {
namespace {

void make(Bodies* self, const Surface<3>& surface, const Flat<bool>& stands,
          const Flat<float>& p_static, int column, int64_t fewest) {
  const size_t n = surface.size();
  require(surface.fitted(), "surface: fit it first");
  require(stands.shape(0) == n, "stands: expected one per element");
  require(p_static.shape(0) == n, "p_static: expected one per element");
  for (size_t k = 0; k < n; ++k)
    require_probability(static_cast<double>(p_static.data()[k]), "p_static");
  require(column >= 1 && column <= 1 << 20, "column: expected 1 to 1048576 cells");
  require(fewest >= 1, "fewest: expected at least 1");
  new (self) Bodies(surface, stands.data(), p_static.data(), {column, fewest});
}

void add(Bodies& bodies, const Points<3>& points, const Flat<bool>& hit,
         const Flat<int64_t>& offset, const Poses<3>& poses, int threads) {
  const auto scans = scans_from<3>(points, hit, offset, poses);
  nb::gil_scoped_release released;
  bodies.add(scans, threads);
}

auto share(const Bodies& bodies) {
  auto out = bodies.share();
  const size_t n = out.size();
  return owned(std::move(out), {n});
}

}  // namespace

void bind_bodies(nb::module_& m) {
  nb::class_<Bodies>(m, "Bodies3D", "What stands apart in each sweep, and how much of it moves.")
      .def("__init__", &make, nb::arg("surface"), nb::arg("stands").noconvert(),
           nb::arg("p_static").noconvert(), nb::kw_only(), nb::arg("column"), nb::arg("fewest"),
           nb::keep_alive<1, 2>(),
           "stands (E,): of which elements bodies consist; p_static (E,) float32. Columns of that "
           "many cells touch within a body, which has that many elements at least.")
      .def("add", &add, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
           nb::arg("offset").noconvert(), nb::arg("T_map_sensor").noconvert(),
           nb::arg("threads") = 1, "Each scan is a sweep.")
      .def("share", &share,
           "(E,) float32: mean probability to move of the body around each element, mean over the "
           "sweeps that saw it; NaN where none did.");
}

}  // namespace stillmap::border
