// Voxels in front of and behind a triangle along its lines of sight.
#pragma once

#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <utility>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

// Triangles over the end points of a scan.
struct TriangleBatch {
  const double* points;    // (n, 3) metres
  const double* origin;    // (n, 3) metres, sensor position of each point
  const double* standoff;  // (n,) metres, sensor to the tangent plane at the point
  const int32_t* faces;    // (m, 3)
  const float* weight;     // (m,)
  size_t size;             // m
};

// gradient . voxel + constant, at voxel indices.
struct LinearForm {
  Vec<3> gradient = Vec<3>::Zero();
  double constant = 0.0;
  double value(const Vec<3>& voxel) const { return gradient.dot(voxel) + constant; }
  LinearForm plus(double c) const { return {gradient, constant + c}; }
  LinearForm times(double c) const { return {c * gradient, c * constant}; }
};

// Frustum of the lines of sight through a triangle, truncated in front of and behind it.
//
// With the sensor at o, a voxel is v = o + sum_i mu_i (corner_i - o). All mu_i are positive on
// lines of sight through the triangle, which they meet at v / k, k = sum mu_i. The distance from
// the surface is (1 - k) h with the standoff h, exact for a plane.
class TriangleFrustum {
 public:
  static constexpr double kMargin = 0.01;  // of the triangle, closes gaps to its neighbours

  TriangleFrustum(const TriangleBatch& triangles, size_t face, double voxel,
                  double truncation_front, double truncation_back) {
    std::array<Vec<3>, 3> corner;
    Vec<3> o = Vec<3>::Zero();
    for (size_t i = 0; i < 3; ++i) {
      const auto p = static_cast<size_t>(triangles.faces[3 * face + i]);
      corner[i] = Eigen::Map<const Vec<3>>(triangles.points + 3 * p);
      o += Eigen::Map<const Vec<3>>(triangles.origin + 3 * p) / 3.0;
      standoff_[i] = triangles.standoff[p];
    }
    const Vec<3> a = corner[0] - o, b = corner[1] - o, c = corner[2] - o;
    const double volume = a.dot(b.cross(c));
    const double h = (standoff_[0] + standoff_[1] + standoff_[2]) / 3.0;
    // degenerate, or behind the sensor
    if (!(std::abs(volume) > kMinVolumeRatio * a.norm() * b.norm() * c.norm()) || !(h > 0.0))
      return;
    const std::array<Vec<3>, 3> inverse = {b.cross(c) / volume, c.cross(a) / volume,
                                           a.cross(b) / volume};
    LinearForm scale;
    for (size_t i = 0; i < 3; ++i) {
      mu_[i].gradient = inverse[i] * voxel;
      mu_[i].constant = inverse[i].dot(Vec<3>::Constant(0.5 * voxel) - o);
      scale.gradient += mu_[i].gradient;
      scale.constant += mu_[i].constant;
      bounds_[i] = mu_[i].plus(kMargin);
    }
    // limits the depth along lines of sight at grazing incidence
    const double per_metre = std::min(1.0 / h, 3.0 * kMaxSlant / (a + b + c).norm());
    nearest_ = std::max(1.0 - truncation_front * per_metre, kMinSensorShare);
    farthest_ = 1.0 + truncation_back * per_metre;
    bounds_[3] = scale.plus(-nearest_);
    bounds_[4] = scale.times(-1.0).plus(farthest_);
    longest_edge_ =
        std::sqrt(std::max({(a - b).squaredNorm(), (b - c).squaredNorm(), (c - a).squaredNorm()})) /
        voxel;
    compute_bounds({a, b, c}, o, voxel);
  }

  bool empty() const { return (high_.array() < low_.array()).any(); }
  double longest_edge() const { return longest_edge_; }  // of the triangle, in voxels
  const Cell<3>& low() const { return low_; }
  const Cell<3>& high() const { return high_; }

  // Conservative test: whether a cube of voxels lies outside of one bounding plane.
  bool misses_cube(const Cell<3>& lowest, int edge) const {
    const Vec<3> first = lowest.cast<double>();
    for (const LinearForm& bound : bounds_) {
      double largest = bound.value(first);
      for (int d = 0; d < 3; ++d) largest += std::max(bound.gradient[d], 0.0) * (edge - 1);
      if (largest < 0.0) return true;
    }
    return false;
  }

  // Calls visit(voxel, signed distance in metres) for the voxels between low and high inside.
  template <class Visit>
  void for_each_voxel(const Cell<3>& low, const Cell<3>& high, Visit&& visit) const {
    const int a = axis_, b = (axis_ + 1) % 3, c = (axis_ + 2) % 3;
    Cell<3> voxel;
    for (voxel[a] = low[a]; voxel[a] <= high[a]; ++voxel[a]) {
      const auto [first_b, last_b] = slice_range(voxel[a], b, low[b], high[b]);
      const auto [first_c, last_c] = slice_range(voxel[a], c, low[c], high[c]);
      for (voxel[b] = first_b; voxel[b] <= last_b; ++voxel[b])
        for (voxel[c] = first_c; voxel[c] <= last_c; ++voxel[c]) {
          double distance;
          if (signed_distance(voxel.cast<double>(), distance)) visit(voxel, distance);
        }
    }
  }

 private:
  // Whether a voxel is inside, and its signed distance in metres, positive in front.
  bool signed_distance(const Vec<3>& voxel, double& distance) const {
    double scale = 0.0, sum = 0.0;
    for (size_t i = 0; i < 3; ++i) {
      const double mu = mu_[i].value(voxel);
      if (mu < -kMargin) return false;
      scale += mu;
      sum += mu * standoff_[i];
    }
    if (!(scale >= nearest_ && scale <= farthest_)) return false;
    distance = (1.0 - scale) * sum / scale;
    return true;
  }

  // Range of voxels along an axis that lines of sight cross at a slice.
  std::pair<int32_t, int32_t> slice_range(int32_t slice_index, int axis, int32_t low,
                                          int32_t high) const {
    if (spreads_) return {low, high};
    const double from = slice_index - origin_[axis_];
    double smallest = std::numeric_limits<double>::infinity(), largest = -smallest;
    for (const Vec<3>& slope : slopes_) {
      const double at = origin_[axis] + from * slope[axis];
      smallest = std::min(smallest, at);
      largest = std::max(largest, at);
    }
    // a slice beside the sensor may be crossed far away
    return {smallest > low ? static_cast<int32_t>(std::ceil(std::min(smallest, high + 1.0))) : low,
            largest < high ? static_cast<int32_t>(std::floor(std::max(largest, low - 1.0))) : high};
  }

  static constexpr double kMinVolumeRatio = 1e-12;
  static constexpr double kMinSensorShare = 0.05;  // of the way from the sensor to the surface
  static constexpr double kMaxSlant = 100.0;       // depth along a line of sight / distance
  static constexpr double kMinAxisShare = 0.1;     // of a line of sight's length along axis_
  static constexpr double kMaxVoxel = BlockLayout<3>::kMaxCell;

  void compute_bounds(const std::array<Vec<3>, 3>& corner, const Vec<3>& o, double voxel) {
    origin_ = o / voxel - Vec<3>::Constant(0.5);
    (corner[0] + corner[1] + corner[2]).cwiseAbs().maxCoeff(&axis_);
    Vec<3> low = Vec<3>::Constant(std::numeric_limits<double>::infinity()), high = -low;
    for (size_t i = 0; i < 3; ++i) {
      // mu is at least -margin for the other two corners
      const Vec<3> end =
          corner[i] + 2.0 * kMargin * (2.0 * corner[i] - corner[(i + 1) % 3] - corner[(i + 2) % 3]);
      for (const double scale : {nearest_, farthest_}) {
        const Vec<3> at = origin_ + scale * end / voxel;
        low = low.cwiseMin(at);
        high = high.cwiseMax(at);
      }
      slopes_[i] = end / end[axis_];
      // lines of sight on both sides of a slice
      spreads_ = spreads_ || !(std::abs(end[axis_]) > kMinAxisShare * end.norm()) ||
                 (end[axis_] > 0.0) != (corner[0][axis_] > 0.0);
    }
    if (!(low.minCoeff() > -kMaxVoxel) || !(high.maxCoeff() < kMaxVoxel))
      throw std::invalid_argument("points: too far away for voxels of this edge");
    low_ = low.array().floor().cast<int32_t>();
    high_ = high.array().ceil().cast<int32_t>();
  }

  std::array<LinearForm, 3> mu_;
  std::array<LinearForm, 5> bounds_;  // inside if all are positive
  std::array<double, 3> standoff_{};
  double nearest_ = 0.0, farthest_ = 0.0;  // of the way from the sensor to the surface
  Vec<3> origin_ = Vec<3>::Zero();         // of the lines of sight, in voxels
  std::array<Vec<3>, 3> slopes_;           // of the edges, per unit along axis_
  double longest_edge_ = 0.0;
  int axis_ = 0;  // main axis of the lines of sight
  bool spreads_ = false;
  Cell<3> low_ = Cell<3>::Ones(), high_ = Cell<3>::Zero();
};

}  // namespace stillmap
