// Local map of weighted end-point moments in voxels of several sizes (NDT map), from which planes
// are fitted anywhere.
#pragma once

#include <Eigen/Eigenvalues>
#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/voxel_hash_map.hpp"

namespace stillmap {

// Weighted sums over the end points in a cell, relative to its centre, in units of its edge.
template <int D>
struct CellMoments {
  static constexpr size_t kProducts = D * (D + 1) / 2;
  double weight = 0.0;
  std::array<double, D> first{};
  std::array<double, kProducts> second{};  // upper triangle by rows
};

// Conditions on a plane.
struct PlaneOptions {
  double min_weight;    // smallest sum of weights
  double max_flatness;  // largest variance across the plane / next variance
  double min_extent;    // smallest next variance, in edges squared
};

// Plane near a position; metres.
template <int D>
struct Plane {
  Vec<D> normal;
  double offset;    // signed distance from the position, along the normal
  double variance;  // of end points across the plane
};

template <int D>
class NdtMap {
 public:
  // edge: metres, of the finest cells; each further level doubles it. max_weight: a cell accepts no
  // more end points from there on, since early poses drift least.
  NdtMap(double edge, int levels, double max_weight) : edge_(edge), max_weight_(max_weight) {
    if (!(edge > 0.0) || !std::isfinite(edge))
      throw std::invalid_argument("edge: expected a positive length in metres");
    if (levels < 1 || levels > 8) throw std::invalid_argument("levels: expected 1 to 8");
    if (!(max_weight > 0.0)) throw std::invalid_argument("max_weight: expected a positive weight");
    tables_.resize(static_cast<size_t>(levels));
  }

  int levels() const { return static_cast<int>(tables_.size()); }
  double edge(int level) const { return std::ldexp(edge_, level); }
  size_t size() const { return tables_.front().size(); }

  void add(const Vec<D>& point, double weight) {
    for (int level = 0; level < levels(); ++level) {
      const Vec<D> x = point / edge(level);
      if (!all_below<D>(x, VoxelHashMap<D, CellMoments<D>>::kMaxCell))
        throw std::invalid_argument("point: not finite or too far away");
      const Cell<D> cell = cell_of<D>(x);
      CellMoments<D>& m = tables_[static_cast<size_t>(level)].find_or_add(cell);
      if (m.weight >= max_weight_) continue;
      const Vec<D> off = x - centre(cell);
      m.weight += weight;
      size_t product = 0;
      for (int i = 0; i < D; ++i) {
        m.first[static_cast<size_t>(i)] += weight * off[i];
        for (int j = i; j < D; ++j) m.second[product++] += weight * off[i] * off[j];
      }
    }
  }

  // Removes the cells farther than `radius` metres from a position.
  void crop(const Vec<D>& position, double radius) {
    for (int level = 0; level < levels(); ++level)
      tables_[static_cast<size_t>(level)].keep_if([&](const Cell<D>& cell) {
        return (centre(cell) * edge(level) - position).squaredNorm() <= radius * radius;
      });
  }

  // Fits a plane to the moments of the 2^D cells around a position, interpolated linearly, so that
  // it varies continuously; its normal is the axis of least variance. False if the conditions are
  // not met.
  bool fit_plane(const Vec<D>& position, int level, const PlaneOptions& options,
                 Plane<D>& plane) const {
    LocalMoments sum;
    interpolate(position / edge(level), tables_[static_cast<size_t>(level)], sum);
    if (sum.weight < options.min_weight) return false;
    const Vec<D> mean = sum.first / sum.weight;
    const Square covariance = sum.second / sum.weight - mean * mean.transpose();
    Eigen::SelfAdjointEigenSolver<Square> eigen;
    eigen.computeDirect(covariance);
    const Vec<D>& variance = eigen.eigenvalues();  // ascending
    if (!(variance[1] >= options.min_extent) ||
        !(variance[0] <= options.max_flatness * variance[1]))
      return false;
    const double metres = edge(level);
    plane.normal = eigen.eigenvectors().col(0);
    plane.offset = plane.normal.dot(mean) * metres;
    plane.variance = std::max(variance[0], 0.0) * metres * metres;
    return true;
  }

 private:
  using Square = Eigen::Matrix<double, D, D>;

  // Interpolated moments about a position, in edges.
  struct LocalMoments {
    double weight = 0.0;
    Vec<D> first = Vec<D>::Zero();
    Square second = Square::Zero();
  };

  static Vec<D> centre(const Cell<D>& cell) { return cell.template cast<double>().array() + 0.5; }

  static void interpolate(const Vec<D>& x, const VoxelHashMap<D, CellMoments<D>>& table,
                          LocalMoments& sum) {
    const Vec<D> shifted = x.array() - 0.5;
    if (!all_below<D>(shifted, VoxelHashMap<D, CellMoments<D>>::kMaxCell - 2)) return;
    const Cell<D> low = cell_of<D>(shifted);
    const Vec<D> within = shifted - low.template cast<double>();
    for (int corner = 0; corner < 1 << D; ++corner) {
      Cell<D> cell = low;
      double weight = 1.0;
      for (int d = 0; d < D; ++d) {
        const int up = (corner >> d) & 1;
        cell[d] += up;
        weight *= up ? within[d] : 1.0 - within[d];
      }
      const CellMoments<D>* m = table.find(cell);
      if (m) accumulate(*m, centre(cell) - x, weight, sum);
    }
  }

  static void accumulate(const CellMoments<D>& m, const Vec<D>& to_centre, double weight,
                         LocalMoments& sum) {
    const Vec<D> first = Eigen::Map<const Vec<D>>(m.first.data());
    Square second;
    size_t product = 0;
    for (int i = 0; i < D; ++i)
      for (int j = i; j < D; ++j) second(i, j) = second(j, i) = m.second[product++];
    sum.weight += weight * m.weight;
    sum.first += weight * (first + m.weight * to_centre);
    // parallel axis theorem: sum (x + c)(x + c)^T
    sum.second += weight * (second + to_centre * first.transpose() + first * to_centre.transpose() +
                            m.weight * to_centre * to_centre.transpose());
  }

  double edge_, max_weight_;
  std::vector<VoxelHashMap<D, CellMoments<D>>> tables_;
};

}  // namespace stillmap
