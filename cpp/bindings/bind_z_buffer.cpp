#include <nanobind/stl/tuple.h>

#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/mesh/z_buffer.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap::bindings {
namespace {

using Faces =
    nb::ndarray<const int32_t, nb::numpy, nb::shape<-1, 3>, nb::c_contig, nb::device::cpu>;
using Matrix = nb::ndarray<const double, nb::numpy, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;

constexpr int kLargest = 1 << 15;  // pixels along an edge of a picture
constexpr double kFarthest = 1e9;  // metres or pixels, avoids overflow

Pinhole checked(const Matrix& K, const OnePose<3>& T_camera_map, int width, int height,
                double near) {
  const double* k = K.data();
  for (size_t i = 0; i < 9; ++i)
    require(std::abs(k[i]) <= kFarthest, "K: not finite, or beyond 1e9 pixels");
  require(k[0] > 0.0 && k[4] > 0.0, "K: expected positive focal lengths");
  require(k[3] == 0.0 && k[6] == 0.0 && k[7] == 0.0 && k[8] == 1.0,
          "K: expected (fx s cx, 0 fy cy, 0 0 1)");
  require(width > 0 && width <= kLargest && height > 0 && height <= kLargest,
          "width, height: expected 1 to 32768 pixels");
  require(near >= 1e-6 && near <= kFarthest, "near: expected 1e-6 to 1e9 metres");
  const Pose<3> pose = checked_pose<3>(T_camera_map, "T_camera_map");
  require(pose.R.cwiseAbs().maxCoeff() <= 2.0, "T_camera_map: expected a rotation");
  require(pose.t.cwiseAbs().maxCoeff() <= kFarthest, "T_camera_map: beyond 1e9 m");
  return {pose.R, pose.t, k[0], k[1], k[2], k[4], k[5], width, height, near};
}

auto render(const Positions<3>& vertices, const Faces& faces, const Matrix& K,
            const OnePose<3>& T_camera_map, int width, int height, double near, int threads) {
  const size_t V = vertices.shape(0), F = faces.shape(0);
  for (size_t i = 0; i < 3 * V; ++i)
    require(std::abs(vertices.data()[i]) <= kFarthest, "vertices: not finite, or beyond 1e9 m");
  for (size_t i = 0; i < 3 * F; ++i) {
    const int32_t at = faces.data()[i];
    require(at >= 0 && static_cast<size_t>(at) < V, "faces: vertex index out of range");
  }
  require(F < size_t{1} << 31, "faces: too many");
  const Pinhole camera = checked(K, T_camera_map, width, height, near);
  ZBuffer out;
  {
    nb::gil_scoped_release released;
    out = render_z_buffer(vertices.data(), V, faces.data(), F, camera, threads);
  }
  const auto h = static_cast<size_t>(height), w = static_cast<size_t>(width);
  return std::make_tuple(to_numpy(std::move(out.depth), {h, w}),
                         to_numpy(std::move(out.face), {h, w}));
}

}  // namespace

void bind_z_buffer(nb::module_& m) {
  m.def("render_z_buffer", &render, nb::arg("vertices").noconvert(), nb::arg("faces").noconvert(),
        nb::arg("K").noconvert(), nb::arg("T_camera_map").noconvert(), nb::arg("width"),
        nb::arg("height"), nb::kw_only(), nb::arg("near"), nb::arg("threads") = 1,
        "Renders a mesh, vertices (V, 3) float64 and faces (F, 3) int32, with a pinhole camera: "
        "depth (height, width) float32, metres along the optical axis, inf for background; face "
        "(height, width) int32, -1 for background. Pixel centres have integer coordinates; faces "
        "are two-sided and clipped `near` metres ahead of the camera.");
}

}  // namespace stillmap::bindings
