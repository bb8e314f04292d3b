// The last stretch of a drive as moments of end points in cells of several sizes, and the surface
// that they make anywhere: what sweeps of a spinning lidar are registered against.
#pragma once

#include <Eigen/Eigenvalues>
#include <array>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "stillmap/grid/voxel_hash_map.hpp"
#include "stillmap/occupancy/beam_counting.hpp"

namespace stillmap {

// Sums over the end points in a cell, each weighing e; lengths in edges, about the cell's centre.
template <int D>
struct Moments {
  static constexpr size_t kProducts = D * (D + 1) / 2;
  double weight = 0.0;
  std::array<double, D> first{};
  std::array<double, kProducts> second{};  // by rows of the upper triangle
};

// When the end points around a place are a surface.
struct PlaneOptions {
  double least;  // weight of the end points around, at least
  double flat;   // variance across it against the next one, at most
  double wide;   // that next variance, in square edges, at least
};

// The surface near a place; metres.
template <int D>
struct Plane {
  Vec<D> normal;
  double offset;    // of the surface from the place, along the normal
  double variance;  // of end points across it
};

template <int D>
class SweepMap {
 public:
  // edge: metres, of the smallest cells; those of each further level are twice as large.
  // enough: weight from which on a cell takes no more: its early poses are the better ones
  SweepMap(double edge, int levels, double enough) : edge_(edge), enough_(enough) {
    if (!(edge > 0.0) || !std::isfinite(edge))
      throw std::invalid_argument("edge: expected a positive length in metres");
    if (levels < 1 || levels > 8) throw std::invalid_argument("levels: expected 1 to 8");
    if (!(enough > 0.0)) throw std::invalid_argument("enough: expected a positive weight");
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
      if (!all_below<D>(x, VoxelTable<D, Moments<D>>::kMaxCell))
        throw std::invalid_argument("point: not finite or too far away");
      const Cell<D> cell = cell_of<D>(x);
      Moments<D>& m = tables_[static_cast<size_t>(level)].find_or_add(cell);
      if (m.weight >= enough_) continue;
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
  void keep_near(const Vec<D>& place, double radius) {
    for (int level = 0; level < levels(); ++level)
      tables_[static_cast<size_t>(level)].keep_if([&](const Cell<D>& cell) {
        return (centre(cell) * edge(level) - place).squaredNorm() <= radius * radius;
      });
  }

  // The plane through the end points around a place: moments of the 2^D cells whose centres
  // surround it, each by its share in a linear interpolation, so that the plane changes steadily
  // from place to place; its normal is the axis of the least variance. False where they are no
  // surface.
  bool plane(const Vec<D>& place, int level, const PlaneOptions& options, Plane<D>& found) const {
    Blend sum;
    blend(place / edge(level), tables_[static_cast<size_t>(level)], sum);
    if (sum.weight < options.least) return false;
    const Vec<D> mean = sum.first / sum.weight;
    const Square covariance = sum.second / sum.weight - mean * mean.transpose();
    Eigen::SelfAdjointEigenSolver<Square> axes;
    axes.computeDirect(covariance);
    const Vec<D>& variance = axes.eigenvalues();  // rising
    if (!(variance[1] >= options.wide) || !(variance[0] <= options.flat * variance[1]))
      return false;
    const double metres = edge(level);
    found.normal = axes.eigenvectors().col(0);
    found.offset = found.normal.dot(mean) * metres;
    found.variance = std::max(variance[0], 0.0) * metres * metres;
    return true;
  }

 private:
  using Square = Eigen::Matrix<double, D, D>;

  // Moments about the place asked for, in edges.
  struct Blend {
    double weight = 0.0;
    Vec<D> first = Vec<D>::Zero();
    Square second = Square::Zero();
  };

  static Vec<D> centre(const Cell<D>& cell) { return cell.template cast<double>().array() + 0.5; }

  static void blend(const Vec<D>& x, const VoxelTable<D, Moments<D>>& table, Blend& sum) {
    const Vec<D> shifted = x.array() - 0.5;
    if (!all_below<D>(shifted, VoxelTable<D, Moments<D>>::kMaxCell - 2)) return;
    const Cell<D> low = cell_of<D>(shifted);
    const Vec<D> within = shifted - low.template cast<double>();
    for (int corner = 0; corner < 1 << D; ++corner) {
      Cell<D> cell = low;
      double share = 1.0;
      for (int d = 0; d < D; ++d) {
        const int up = (corner >> d) & 1;
        cell[d] += up;
        share *= up ? within[d] : 1.0 - within[d];
      }
      const Moments<D>* m = table.find(cell);
      if (m) accumulate(*m, centre(cell) - x, share, sum);
    }
  }

  static void accumulate(const Moments<D>& m, const Vec<D>& to_centre, double share, Blend& sum) {
    const Vec<D> first = Eigen::Map<const Vec<D>>(m.first.data());
    Square second;
    size_t product = 0;
    for (int i = 0; i < D; ++i)
      for (int j = i; j < D; ++j) second(i, j) = second(j, i) = m.second[product++];
    sum.weight += share * m.weight;
    sum.first += share * (first + m.weight * to_centre);
    // steiner: sum (x + c)(x + c)^T
    sum.second += share * (second + to_centre * first.transpose() + first * to_centre.transpose() +
                           m.weight * to_centre * to_centre.transpose());
  }

  double edge_, enough_;
  std::vector<VoxelTable<D, Moments<D>>> tables_;
};

}  // namespace stillmap
