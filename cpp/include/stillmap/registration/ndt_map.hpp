// The last stretch of a drive as moments of end points in cells of several sizes, and the surface
// that they make anywhere: what sweeps of a spinning lidar are registered against.
#pragma once

#include <Eigen/Eigenvalues>
#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/voxel_hash_map.hpp"

namespace stillmap {

// Sums over the end points in a cell, each weighing e; lengths in edges, about the cell's centre.
template <int D>
struct CellMoments {
  static constexpr size_t kProducts = D * (D + 1) / 2;
  double weight = 0.0;
  std::array<double, D> first{};
  std::array<double, kProducts> second{};  // by rows of the upper triangle
};

// When the end points around a place are a surface.
struct PlaneOptions {
  double min_weight;    // weight of the end points around, at least
  double max_flatness;  // variance across it against the next one, at most
  double min_extent;    // that next variance, in square edges, at least
};

// The surface near a place; metres.
template <int D>
struct Plane {
  Vec<D> normal;
  double offset;    // of the surface from the place, along the normal
  double variance;  // of end points across it
};

template <int D>
class NdtMap {
 public:
  // edge: metres, of the smallest cells; those of each further level are twice as large.
  // enough: weight from which on a cell takes no more: its early poses are the better ones
  NdtMap(double edge, int levels, double max_weight) : edge_(edge), max_weight_(max_weight) {
    if (!(edge > 0.0) || !std::isfinite(edge))
      throw std::invalid_argument("edge: expected a positive length in metres");
    if (levels < 1 || levels > 8) throw std::invalid_argument("levels: expected 1 to 8");
    if (!(max_weight > 0.0)) throw std::invalid_argument("enough: expected a positive weight");
    tables_.resize(static_cast<size_t>(levels));
  }

  int levels() const { return static_cast<int>(tables_.size()); }
  double edge(int level) const { return std::ldexp(edge_, level); }
  size_t size() const { return tables_.front().size(); }

  size_t memory_bytes() const {
    size_t bytes = 0;
    for (const auto& table : tables_) bytes += table.memory_bytes();
    return bytes;
  }

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

  // Forgets what lies farther than `radius` metres from a place.
  void crop(const Vec<D>& position, double radius) {
    for (int level = 0; level < levels(); ++level)
      tables_[static_cast<size_t>(level)].keep_if([&](const Cell<D>& cell) {
        return (centre(cell) * edge(level) - position).squaredNorm() <= radius * radius;
      });
  }

  // The plane through the end points around a place: moments of the 2^D cells whose centres
  // surround it, each by its share in a linear interpolation, so that the plane changes steadily
  // from place to place; its normal is the axis of the least variance. False where they are no
  // surface.
  bool fit_plane(const Vec<D>& position, int level, const PlaneOptions& options,
                 Plane<D>& plane) const {
    LocalMoments sum;
    interpolate(position / edge(level), tables_[static_cast<size_t>(level)], sum);
    if (sum.weight < options.min_weight) return false;
    const Vec<D> mean = sum.first / sum.weight;
    const Square covariance = sum.second / sum.weight - mean * mean.transpose();
    Eigen::SelfAdjointEigenSolver<Square> eigen;
    eigen.computeDirect(covariance);
    const Vec<D>& variance = eigen.eigenvalues();  // rising
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

  // Moments about the place asked for, in edges.
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
    // steiner: sum (x + c)(x + c)^T
    sum.second += weight * (second + to_centre * first.transpose() + first * to_centre.transpose() +
                            m.weight * to_centre * to_centre.transpose());
  }

  double edge_, max_weight_;
  std::vector<VoxelHashMap<D, CellMoments<D>>> tables_;
};

}  // namespace stillmap
