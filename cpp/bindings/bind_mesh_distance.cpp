#include <nanobind/stl/pair.h>

#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/mesh/mesh_distance.hpp"

namespace stillmap::bindings {
namespace {

using Faces =
    nb::ndarray<const int32_t, nb::numpy, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;

constexpr double kFarthest = 1e9;  // metres, avoids overflow

bool all_finite(const Positions<3>& rows) {
  double sum = 0.0;  // 0 * x is NaN unless x is finite
  for (size_t i = 0; i < 3 * rows.shape(0); ++i) sum += 0.0 * rows.data()[i];
  return sum == 0.0;
}

void make(MeshDistance* self, const Positions<3>& vertices, const Faces& faces,
          double max_distance) {
  const size_t V = vertices.shape(0), F = faces.shape(0);
  for (size_t i = 0; i < 3 * V; ++i)
    require(std::abs(vertices.data()[i]) <= kFarthest, "vertices: not finite, or beyond 1e9 m");
  require(F < size_t{1} << 31, "faces: too many");
  for (size_t i = 0; i < 3 * F; ++i) {
    const int32_t at = faces.data()[i];
    require(at >= 0 && static_cast<size_t>(at) < V, "faces: vertex index out of range");
  }
  require(max_distance >= 1e-6 && max_distance <= kFarthest,
          "max_distance: expected 1e-6 to 1e9 metres");
  nb::gil_scoped_release released;
  new (self) MeshDistance(vertices.data(), V, faces.data(), F, max_distance);
}

auto closest_faces(const MeshDistance& mesh, const Positions<3>& points,
                   const Positions<3>& origins, int threads) {
  const size_t n = points.shape(0);
  require(origins.shape(0) == n, "origins: expected a row per point");
  require(all_finite(points), "points: not finite");
  require(all_finite(origins), "origins: not finite");
  NearestPoints out;
  {
    nb::gil_scoped_release released;
    out = mesh.nearest(points.data(), origins.data(), n, threads);
  }
  return std::make_pair(to_numpy(std::move(out.face), {n}),
                        to_numpy(std::move(out.barycentric), {n, 3}));
}

}  // namespace

void bind_mesh_distance(nb::module_& m) {
  nb::class_<MeshDistance>(m, "MeshDistance", "Closest-face queries against a triangle mesh.")
      .def("__init__", &make, nb::arg("vertices").noconvert(), nb::arg("faces").noconvert(),
           nb::kw_only(), nb::arg("max_distance"),
           "vertices (V, 3) float64, metres; faces (F, 3) int32, counter-clockwise seen from the "
           "front; max_distance: search radius in metres.")
      .def("__len__", &MeshDistance::size)
      .def_prop_ro("max_distance", &MeshDistance::max_distance)
      .def_prop_ro("memory_bytes", &MeshDistance::memory_bytes)
      .def("closest_faces", &closest_faces, nb::arg("points").noconvert(),
           nb::arg("origins").noconvert(), nb::kw_only(), nb::arg("threads") = 1,
           "Closest face (n,) int32 to each of points (n, 3) float64, -1 where none is closer than "
           "max_distance; barycentric coordinates (n, 3) float64 of the closest point, 0 where "
           "there is none. Degenerate faces and faces seen from behind from origins (n, 3) float64 "
           "are skipped; ties go to the lowest index.");
}

}  // namespace stillmap::bindings
