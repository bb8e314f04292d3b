// Range image of one sweep: how far it saw free space in each direction of the sensor.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <limits>
#include <vector>

namespace stillmap {

struct PixelSize {
  float azimuth, elevation;  // radians
};

class RangeImage {
 public:
  using Point = Eigen::Vector3f;  // sensor frame, metres

  // The shortest range of the beams of each pixel and of those around it: a beam that passes close
  // to a silhouette, or along a surface, shows no free space behind it.
  RangeImage(const std::vector<Point>& ends, PixelSize pixel) : pixel_(pixel) {
    columns_ = std::max(static_cast<int>(std::ceil(2.0f * kPi / pixel_.azimuth)), 1);
    float low = kPi, high = -kPi;
    std::vector<float> elevation(ends.size());
    for (size_t n = 0; n < ends.size(); ++n) {
      elevation[n] = elevation_of(ends[n]);
      low = std::min(low, elevation[n]);
      high = std::max(high, elevation[n]);
    }
    lowest_ = low;
    rows_ = ends.empty() ? 0 : static_cast<int>((high - low) / pixel_.elevation) + 1;
    range_.assign(static_cast<size_t>(rows_) * static_cast<size_t>(columns_), kEmpty);
    for (size_t n = 0; n < ends.size(); ++n) {
      const float range = ends[n].norm();
      float& at = range_[index(row_of(elevation[n]), column_of(ends[n].x(), ends[n].y()))];
      at = std::min(at, range);
      longest_ = std::max(longest_, range);
    }
    erode();
  }

  float longest() const { return longest_; }
  PixelSize pixel() const { return pixel_; }

  // Metres of free space in the direction of a point; 0 where no beam went.
  float free_range(const Point& p) const {
    float out;
    free_ranges(&p.x(), &p.y(), &p.z(), 1, &out);
    return out;
  }

  // The same for n points, at most kBatch.
  static constexpr size_t kBatch = 512;
  void free_ranges(const float* x, const float* y, const float* z, size_t n, float* out) const {
    std::array<int, kBatch> pixel;
    for (size_t k = 0; k < n; ++k) {  // without branches: the compiler vectorizes it
      const float elevation = arctan2(z[k], std::sqrt(x[k] * x[k] + y[k] * y[k]));
      const int row = elevation < lowest_ ? -1 : row_of(elevation);
      const int in_row = row * columns_ + column_of(x[k], y[k]);
      pixel[k] = row >= rows_ ? -1 : in_row;
    }
    for (size_t k = 0; k < n; ++k)
      out[k] = pixel[k] < 0 ? 0.0f : free_[static_cast<size_t>(pixel[k])];
  }

 private:
  static constexpr float kPi = 3.14159265f;
  static constexpr float kTiny = 1e-30f;  // m: no division by zero
  static constexpr float kEmpty = std::numeric_limits<float>::infinity();

  // Abramowitz and Stegun, 4.4.49: the error is below 1e-5
  static float arctan(float x) {
    const float s = x * x;
    return x *
           (0.9998660f + s * (-0.3302995f + s * (0.1801410f + s * (-0.0851330f + s * 0.0208351f))));
  }
  static float arctan2(float y, float x) {
    const float ax = std::abs(x), ay = std::abs(y);
    const float angle = arctan(std::min(ax, ay) / std::max(std::max(ax, ay), kTiny));
    const float steep = 0.5f * kPi - angle, up = ay > ax ? steep : angle;
    const float behind = kPi - up, left = x < 0.0f ? behind : up;
    return y < 0.0f ? -left : left;
  }
  static float elevation_of(const Point& p) {
    return arctan2(p.z(), std::sqrt(p.x() * p.x() + p.y() * p.y()));
  }
  // not below the lowest beam
  int row_of(float elevation) const {
    return static_cast<int>((elevation - lowest_) / pixel_.elevation);
  }
  int column_of(float x, float y) const {
    const auto column = static_cast<int>((arctan2(y, x) + kPi) / pixel_.azimuth);
    return std::min(std::max(column, 0), columns_ - 1);
  }
  size_t index(int row, int column) const {
    return static_cast<size_t>(row) * static_cast<size_t>(columns_) + static_cast<size_t>(column);
  }

  // The minimum of each pixel and the eight around it; empty ones stay empty.
  void erode() {
    std::vector<float> across(range_.size());
    for (int row = 0; row < rows_; ++row)
      for (int column = 0; column < columns_; ++column) {
        const int left = column ? column - 1 : columns_ - 1;
        const int right = column + 1 < columns_ ? column + 1 : 0;
        across[index(row, column)] = std::min(
            {range_[index(row, left)], range_[index(row, column)], range_[index(row, right)]});
      }
    free_.assign(range_.size(), 0.0f);
    for (int row = 0; row < rows_; ++row)
      for (int column = 0; column < columns_; ++column) {
        if (range_[index(row, column)] == kEmpty) continue;
        float least = across[index(row, column)];
        if (row > 0) least = std::min(least, across[index(row - 1, column)]);
        if (row + 1 < rows_) least = std::min(least, across[index(row + 1, column)]);
        free_[index(row, column)] = least;
      }
    range_ = {};
  }

  PixelSize pixel_;
  int rows_ = 0, columns_ = 0;
  float lowest_ = 0.0f, longest_ = 0.0f;
  std::vector<float> range_, free_;  // (rows, columns) metres
};

}  // namespace stillmap
