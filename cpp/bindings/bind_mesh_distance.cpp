#include <nanobind/stl/pair.h>

#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/mesh/mesh_distance.hpp"

namespace stillmap::bindings {
namespace {

using FacesOf =
    nb::ndarray<const int32_t, nb::numpy, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

constexpr double kFarthest = 1e9;  // metres, avoids overflow

bool all_finite(const Places<3>& rows) {
  double sum = 0.0;  // 0 * x is NaN unless x is finite
  for (size_t i = 0; i < 3 * rows.shape(0); ++i) sum += 0.0 * rows.data()[i];
  return sum == 0.0;
}

void make(MeshDistance* self, const Places<3>& vertices, const FacesOf& faces,
          double max_distance) {
  const size_t V = vertices.shape(0), F = faces.shape(0);
  for (size_t i = 0; i < 3 * V; ++i)
    require(std::abs(vertices.data()[i]) <= kFarthest, "vertices: not finite, or beyond 1e9 m");
  require(F < size_t{1} << 31, "faces: too many");
  for (size_t i = 0; i < 3 * F; ++i) {
    const int32_t at = faces.data()[i];
    require(at >= 0 && static_cast<size_t>(at) < V, "faces: a vertex that is not there");
  }
  require(max_distance >= 1e-6 && max_distance <= kFarthest,
          "max_distance: expected 1e-6 to 1e9 metres");
  nb::gil_scoped_release released;
  new (self) MeshDistance(vertices.data(), V, faces.data(), F, max_distance);
}

auto closest_faces(const MeshDistance& faces, const Places<3>& points, const Places<3>& origins,
                   int threads) {
  const size_t n = points.shape(0);
  require(origins.shape(0) == n, "origins: expected a row per point");
  require(all_finite(points), "points: not finite");
  require(all_finite(origins), "origins: not finite");
  NearestPoints out;
  {
    nb::gil_scoped_release released;
    out = faces.nearest(points.data(), origins.data(), n, threads);
  }
  return std::make_pair(to_numpy(std::move(out.face), {n}),
                        to_numpy(std::move(out.barycentric), {n, 3}));
}

}  // namespace

void bind_mesh_distance(nb::module_& m) {
  nb::class_<MeshDistance>(
      m, "MeshDistance",
      "The faces of a mesh, to be asked which of them is the nearest to a point.")
      .def("__init__", &make, nb::arg("vertices").noconvert(), nb::arg("faces").noconvert(),
           nb::kw_only(), nb::arg("max_distance"),
           "vertices (V, 3) float64, metres; faces (F, 3) int32, counter-clockwise from where they "
           "are seen; max_distance: metres to a face, beyond which it is not near.")
      .def("__len__", &MeshDistance::size)
      .def_prop_ro("max_distance", &MeshDistance::max_distance)
      .def_prop_ro("memory_bytes", &MeshDistance::memory_bytes)
      .def("closest_faces", &closest_faces, nb::arg("points").noconvert(),
           nb::arg("origins").noconvert(), nb::kw_only(), nb::arg("threads") = 1,
           "Which face (n,) int32 has the place nearest to each of points (n, 3) float64, less "
           "than max_distance away, -1 where there is none; and the weights (n, 3) float64 of its "
           "corners there, 0 where there is none. Faces without area do not count, nor those that "
           "have their back to where the point was seen from, origins (n, 3) float64; of several "
           "at one distance the lowest number does.");
}

}  // namespace stillmap::bindings
