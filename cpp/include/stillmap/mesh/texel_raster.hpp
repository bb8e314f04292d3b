// Rasterisation of triangles into the texels of an atlas page.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

namespace stillmap {

struct TexelCoverage {
  std::vector<int32_t> texel;  // row * width + column
  std::vector<int32_t> face;
  std::vector<float> barycentric;  // of the second and third corner
};

namespace texel_raster {

struct Triangle {
  double ax, ay, bx, by, cx, cy;

  double doubled_area() const { return (bx - ax) * (cy - ay) - (by - ay) * (cx - ax); }
};

// Range [first, last] of the texel centres between two coordinates.
inline std::array<int32_t, 2> covered_range(double low, double high, int32_t size) {
  const double first = std::ceil(low - 0.5), last = std::floor(high - 0.5);
  return {static_cast<int32_t>(std::clamp(first, 0.0, static_cast<double>(size))),
          static_cast<int32_t>(std::clamp(last, -1.0, static_cast<double>(size - 1)))};
}

inline void append(TexelCoverage& out, int32_t texel, int32_t face, double j, double k) {
  out.texel.push_back(texel);
  out.face.push_back(face);
  out.barycentric.push_back(static_cast<float>(j));
  out.barycentric.push_back(static_cast<float>(k));
}

inline void rasterise(const Triangle& t, int32_t number, int32_t width, int32_t height,
                      TexelCoverage& out) {
  const double area = t.doubled_area();
  const size_t n_before = out.texel.size();
  const auto [left, right] =
      covered_range(std::min({t.ax, t.bx, t.cx}), std::max({t.ax, t.bx, t.cx}), width);
  const auto [top, bottom] =
      covered_range(std::min({t.ay, t.by, t.cy}), std::max({t.ay, t.by, t.cy}), height);
  if (area != 0.0)
    for (int32_t row = top; row <= bottom; ++row)
      for (int32_t column = left; column <= right; ++column) {
        const double x = column + 0.5 - t.ax, y = row + 0.5 - t.ay;
        const double j = (x * (t.cy - t.ay) - y * (t.cx - t.ax)) / area;
        const double k = ((t.bx - t.ax) * y - (t.by - t.ay) * x) / area;
        if (j >= 0.0 && k >= 0.0 && j + k <= 1.0) append(out, row * width + column, number, j, k);
      }
  if (out.texel.size() > n_before) return;
  // smaller than a texel: the texel that contains its centroid
  const auto within = [](double coordinate, int32_t size) {
    return static_cast<int32_t>(
        std::clamp(std::floor(coordinate), 0.0, static_cast<double>(size - 1)));
  };
  append(out,
         within((t.ay + t.by + t.cy) / 3.0, height) * width +
             within((t.ax + t.bx + t.cx) / 3.0, width),
         number, 1.0 / 3.0, 1.0 / 3.0);
}

}  // namespace texel_raster

// Rasterises triangles with corners (n, 3, 2) in texels from the left and top edge of the page.
// Texels on a shared edge belong to both triangles.
inline TexelCoverage rasterise_triangles(const double* corners, size_t n, int32_t width,
                                         int32_t height) {
  TexelCoverage out;
  for (size_t f = 0; f < n; ++f) {
    const double* c = corners + 6 * f;
    texel_raster::rasterise({c[0], c[1], c[2], c[3], c[4], c[5]}, static_cast<int32_t>(f), width,
                            height, out);
  }
  return out;
}

}  // namespace stillmap
