// What a scan says about its pose, from the directions of the surfaces that it sees. The curvature
// of the likelihood field takes the pattern of end points on a bare wall for information along it;
// surface normals do not.
#pragma once

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
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
template <int D>
struct SurfaceNormal {
  Vec<D> normal = Vec<D>::Zero();
  double isotropy = 0.0;  // 0: a plane, 1: a point
};

// Normals of a planar scan from the neighbouring end points, in the order of the beams. An end
// point with fewer than two neighbours may lie on a wall of any direction and has no normal.
inline std::vector<SurfaceNormal<2>> estimate_normals(const std::vector<Vec<2>>& points,
                                                      const NormalOptions& options) {
  const auto n_points = static_cast<int64_t>(points.size());
  const auto at = [&](int64_t n) -> const Vec<2>& { return points[static_cast<size_t>(n)]; };
  // the last end point on the same surface in one direction
  const auto extend = [&](int64_t n, int64_t step) {
    int64_t last = n;
    for (int64_t k = n + step; k >= 0 && k < n_points; k += step) {
      const bool is_next = std::abs(k - n) == 1;
      if ((at(k) - at(last)).norm() > options.max_gap) break;
      if (!is_next && (at(k) - at(n)).norm() > options.radius) break;
      last = k;
    }
    return last;
  };
  std::vector<SurfaceNormal<2>> out(points.size());
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

// Information of one end point about the pose, for a lever arm R p and a surface in the moving
// frame; to be scaled by the inverse variance of the end point.
template <int D>
inline Eigen::Matrix<double, Lie<D>::kDof, Lie<D>::kDof> endpoint_information(const Vec<D>& lever,
                                                                              const Vec<D>& normal,
                                                                              double isotropy) {
  const auto J = Lie<D>::jacobian(lever);
  Eigen::Matrix<double, D, D> constrained = (1.0 - isotropy) * normal * normal.transpose();
  constrained.diagonal().array() += isotropy;
  return J.transpose() * constrained * J;
}

}  // namespace stillmap
