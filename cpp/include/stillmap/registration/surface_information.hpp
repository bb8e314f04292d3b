// What a scan says about its pose, from the directions of the surfaces that it sees. The curvature
// of the likelihood field takes the pattern of end points on a bare wall for information along it;
// surface normals do not.
#pragma once

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

struct NormalOptions {
  double radius;      // metres, end points of successive beams that belong to one surface
  double max_gap;     // metres between the successive end points of one surface
  double flat_below;  // ratio of variances across and along up to which a surface is flat
  double round_from;  // ratio from which it constrains both directions equally
};

// Surface at one end point: its unit normal, and by how much it constrains the tangent too.
struct SurfaceNormal {
  Vec<2> normal = Vec<2>::Zero();
  double isotropy = 0.0;  // 0: a plane, 1: a point
};

// The largest square of which the square root is not above a length.
inline double squared_limit(double length) {
  constexpr double inf = std::numeric_limits<double>::infinity();
  double squared = length * length;
  while (std::sqrt(squared) > length) squared = std::nextafter(squared, 0.0);
  while (squared < inf && std::sqrt(std::nextafter(squared, inf)) <= length)
    squared = std::nextafter(squared, inf);
  return squared;
}

// Normals of a planar scan from the neighbouring end points, in the order of the beams. An end
// point with fewer than two neighbours may lie on a wall of any direction and has no normal.
inline std::vector<SurfaceNormal> estimate_normals(const std::vector<Vec<2>>& points,
                                                   const NormalOptions& options) {
  const auto n_points = static_cast<int64_t>(points.size());
  const auto at = [&](int64_t n) -> const Vec<2>& { return points[static_cast<size_t>(n)]; };
  const double max_gap = squared_limit(options.max_gap), radius = squared_limit(options.radius);
  // begin of the run of end points without a gap that each one belongs to, and its end
  std::vector<int64_t> begin(points.size(), 0), end(points.size(), n_points);
  const auto is_gap = [&](int64_t n) { return (at(n) - at(n - 1)).squaredNorm() > max_gap; };
  for (int64_t n = 1; n < n_points; ++n)
    begin[static_cast<size_t>(n)] = is_gap(n) ? n : begin[static_cast<size_t>(n - 1)];
  for (int64_t n = n_points - 1; n > 0; --n)
    end[static_cast<size_t>(n - 1)] =
        begin[static_cast<size_t>(n)] == n ? n : end[static_cast<size_t>(n)];
  // the last end point on the same surface in one direction, the next one at any distance
  const auto extend = [&](int64_t n, int64_t step) {
    const auto i = static_cast<size_t>(n);
    int64_t last = n;
    for (int64_t k = n + step; k >= begin[i] && k < end[i]; k += step) {
      if (last != n && (at(k) - at(n)).squaredNorm() > radius) break;
      last = k;
    }
    return last;
  };
  std::vector<SurfaceNormal> out(points.size());
  for (int64_t n = 0; n < n_points; ++n) {
    auto& surface = out[static_cast<size_t>(n)];
    const int64_t first = extend(n, -1), last = extend(n, 1);
    if (last - first < 2) continue;
    Vec<2> mean = Vec<2>::Zero();
    for (int64_t k = first; k <= last; ++k) mean += at(k);
    mean /= static_cast<double>(last - first + 1);
    Eigen::Matrix2d scatter = Eigen::Matrix2d::Zero();
    for (int64_t k = first; k <= last; ++k) scatter += (at(k) - mean) * (at(k) - mean).transpose();
    Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen;
    eigen.computeDirect(scatter);
    const double ratio = eigen.eigenvalues()[0] / std::max(eigen.eigenvalues()[1], 1e-12);
    surface.normal = eigen.eigenvectors().col(0);
    surface.isotropy = std::clamp(
        (ratio - options.flat_below) / (options.round_from - options.flat_below), 0.0, 1.0);
  }
  return out;
}

// Shares of evidence that the end points of a planar scan, in the order of the beams, do not have
// in common with their neighbours: half for each side on which the neighbour is a correlation
// length (metres) away or farther, and less for a nearer one.
inline std::vector<double> evidence_shares(const std::vector<Vec<2>>& points,
                                           double correlation_length) {
  std::vector<double> shares(points.size(), 1.0);
  for (size_t n = 1; n < points.size(); ++n) {
    const double distance = (points[n] - points[n - 1]).norm();
    const double common = 0.5 * (1.0 - std::min(distance / correlation_length, 1.0));
    shares[n - 1] -= common;
    shares[n] -= common;
  }
  return shares;
}

// Information of one end point about the pose, for a lever arm R p and a surface in the moving
// frame; to be scaled by the inverse variance of the end point.
inline Eigen::Matrix3d endpoint_information(const Vec<2>& lever, const Vec<2>& normal,
                                            double isotropy) {
  const auto J = Lie<2>::jacobian(lever);
  Eigen::Matrix2d constrained = (1.0 - isotropy) * normal * normal.transpose();
  constrained.diagonal().array() += isotropy;
  return J.transpose() * constrained * J;
}

}  // namespace stillmap
