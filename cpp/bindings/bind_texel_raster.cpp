#include <nanobind/stl/tuple.h>

#include <cmath>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/mesh/texel_raster.hpp"

namespace stillmap::bindings {
namespace {

using Corners =
    nb::ndarray<const double, nb::numpy, nb::shape<-1, 3, 2>, nb::c_contig, nb::device::cpu>;

constexpr int kLargest = 1 << 15;  // texels along an edge of a page

auto rasterise_texels(const Corners& corners, int width, int height) {
  const size_t n = corners.shape(0);
  for (size_t i = 0; i < 6 * n; ++i)
    require(std::isfinite(corners.data()[i]), "corners: not finite");
  require(n < size_t{1} << 31, "corners: too many");
  require(width > 0 && width <= kLargest && height > 0 && height <= kLargest,
          "width, height: expected 1 to 32768 texels");
  TexelCoverage out;
  {
    nb::gil_scoped_release released;
    out = rasterise_triangles(corners.data(), n, width, height);
  }
  const size_t k = out.texel.size();
  return std::make_tuple(to_numpy(std::move(out.texel), {k}), to_numpy(std::move(out.face), {k}),
                         to_numpy(std::move(out.barycentric), {k, 2}));
}

}  // namespace

void bind_texel_raster(nb::module_& m) {
  m.def(
      "rasterise_texels", &rasterise_texels, nb::arg("corners").noconvert(), nb::arg("width"),
      nb::arg("height"),
      "Rasterises triangles on a texture page. corners (n, 3, 2) float64 in texels from its left "
      "and top edge. Returns texel (k,) int32 = row * width + column, triangle (k,) int32, "
      "ascending, and the barycentric weights (k, 2) float32 of the second and third corner at the "
      "texel centre. A triangle that covers no texel centre takes the texel of its centroid.");
}

}  // namespace stillmap::bindings
