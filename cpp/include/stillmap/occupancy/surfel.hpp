// Surfels and the sums over end points from which they are fitted.
#pragma once

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <array>
#include <limits>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"

namespace stillmap {

// Surface element of one cell, in units of cells.
template <int D>
struct Surfel {
  Vec<D> mean = Vec<D>::Zero();    // of the end points in the cell
  Vec<D> normal = Vec<D>::Zero();  // unit length; zero: isotropic, no plane was fitted
  double centre_to_plane = 0.0;    // signed distance from the cell's centre to the plane
  double prominence = 1.0;         // beams in the cell / beams in the fullest cell of the window
  Vec<D> centre = Vec<D>::Zero();  // of the fitted plane patch; without a plane, the mean
  double half_extent = 0.5;        // half extent of the plane patch
};

constexpr int64_t kMaxTimeBin = std::numeric_limits<int32_t>::max();

// First and last time bin with a return in a cell.
struct TimeSpan {
  int32_t first = static_cast<int32_t>(kMaxTimeBin), last = -1;

  void extend(int64_t time_bin) {
    first = std::min(first, static_cast<int32_t>(time_bin));
    last = std::max(last, static_cast<int32_t>(time_bin));
  }
  void extend(const TimeSpan& other) {
    first = std::min(first, other.first);
    last = std::max(last, other.last);
  }
  bool empty() const { return last < first; }
  int64_t n_bins() const { return int64_t{last} - first + 1; }
};

// Sums over the end points in a cell.
template <int D>
struct EndPointSums {
  static constexpr int kProducts = D * (D + 1) / 2;
  // In 2D, where cells are small, both faces of a thin wall may lie in one window: what tells them
  // apart is summed, too, see SurfelMap::fit_faces.
  static constexpr bool kHasFaces = D == 2;

  Cell<D> cell;
  int64_t count = 0;
  std::array<Fixed, D> first{};                 // sum of x = end point - cell corner
  std::array<Fixed, kProducts> second{};        // sum of x x^T, upper triangle by rows
  std::array<Fixed, kHasFaces ? D : 0> view{};  // sum of the unit vectors of the beams
  TimeSpan hit_span;

  // An end point, and where the beam started, both in units of cells.
  void add(const Vec<D>& end, const Vec<D>& start) {
    const Vec<D> x = end - cell.template cast<double>();
    ++count;
    size_t product = 0;
    for (int i = 0; i < D; ++i) {
      first[static_cast<size_t>(i)] += to_fixed(x[i]);
      for (int j = i; j < D; ++j) second[product++] += to_fixed(x[i] * x[j]);
    }
    if constexpr (kHasFaces) {
      const Vec<D> direction = (end - start).normalized();  // zero where both are the same
      for (int d = 0; d < D; ++d) view[static_cast<size_t>(d)] += to_fixed(direction[d]);
    }
  }
  // Adds the sums over other end points in the same cell.
  void add(const EndPointSums& other) {
    count += other.count;
    for (size_t i = 0; i < first.size(); ++i) first[i] += other.first[i];
    for (size_t i = 0; i < second.size(); ++i) second[i] += other.second[i];
    for (size_t i = 0; i < view.size(); ++i) view[i] += other.view[i];
    hit_span.extend(other.hit_span);
  }
};

// Count, mean and covariance of the end points in a window of cells.
template <int D>
struct WindowMoments {
  using Square = Eigen::Matrix<double, D, D>;

  double count = 0.0, max_count = 0.0;  // total; largest of any cell
  Vec<D> first = Vec<D>::Zero();
  Square second = Square::Zero();      // lower triangle
  Vec<D> view = Vec<D>::Zero();        // see EndPointSums; zero if it has none
  TimeSpan hit_span;                   // of all cells; empty in 3D and without time bins
  double n_cells = 0.0, n_bins = 0.0;  // with a hit span; in these spans in total

  void add(const EndPointSums<D>& s, const Cell<D>& centre) {
    const Vec<D> corner = (s.cell - centre).template cast<double>();
    const double n = static_cast<double>(s.count);
    Vec<D> sum;
    for (int d = 0; d < D; ++d) sum[d] = from_fixed(s.first[static_cast<size_t>(d)]);
    count += n;
    max_count = std::max(max_count, n);
    first += sum + n * corner;
    size_t product = 0;
    for (int j = 0; j < D; ++j)
      for (int i = j; i < D; ++i)
        second(i, j) += from_fixed(s.second[product++]) + corner[i] * sum[j] + sum[i] * corner[j] +
                        n * corner[i] * corner[j];
    if constexpr (EndPointSums<D>::kHasFaces) {
      for (int d = 0; d < D; ++d) view[d] += from_fixed(s.view[static_cast<size_t>(d)]);
      if (s.hit_span.empty()) return;
      hit_span.extend(s.hit_span);
      n_cells += 1.0;
      n_bins += static_cast<double>(s.hit_span.n_bins());
    }
  }
  Vec<D> mean() const { return first / count; }
  // Mean hit span of a cell over that of all cells.
  double mean_span_share() const {
    return n_cells > 0.0 ? n_bins / (n_cells * static_cast<double>(hit_span.n_bins())) : 0.0;
  }
  // Its lower triangle.
  Square covariance() const { return second / count - mean() * mean().transpose(); }
};

// Principal axes of the end points in a window, whose radius is in cells.
template <int D>
struct PrincipalAxes {
  using Square = Eigen::Matrix<double, D, D>;

  Vec<D> variance = Vec<D>::Zero(), normal = Vec<D>::Zero();  // ascending; of the first one
  bool is_extended = false, is_flat = false;

  PrincipalAxes(const WindowMoments<D>& moments, int radius) {
    const double min_variance = 0.15 * radius * radius;  // over 3 of 5 cells
    const Square covariance = moments.covariance();
    if (max_second_variance(covariance) < min_variance) return;
    const Eigen::SelfAdjointEigenSolver<Square> eigen(covariance);  // of the lower triangle
    variance = eigen.eigenvalues().cwiseMax(0.0);
    normal = eigen.eigenvectors().col(0);
    is_extended = variance[1] > min_variance;
    is_flat = is_extended && variance[0] < 0.25 * variance[1];
  }

 private:
  // Upper bound of the second smallest eigenvalue, which is cheaper than the eigenvalues: in 3D,
  // the product of the larger two is at most the sum of the principal minors of order two, and the
  // largest is at least a third of the trace.
  static double max_second_variance(const Square& lower) {
    if constexpr (D == 2) {
      return std::numeric_limits<double>::infinity();
    } else {
      constexpr double rounding = 1e-6;  // relative to variances, far more than its errors
      const auto minor = [&](int i, int j) {
        return lower(i, i) * lower(j, j) - lower(j, i) * lower(j, i);
      };
      const double trace = lower.trace();
      return 3.0 * (minor(0, 1) + minor(0, 2) + minor(1, 2)) / trace + rounding * (1.0 + trace);
    }
  }
};

}  // namespace stillmap
