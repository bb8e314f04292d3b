// What is known of the cells in which beams ended.
#pragma once

#include <algorithm>
#include <array>
#include <limits>

#include "stillmap/occupancy/beam_counting.hpp"

namespace stillmap {

// Calls visit(cell) for the cells of the cube of that radius around a cell.
template <int D, class Visit>
inline void for_each_near(const Cell<D>& centre, int radius, Visit&& visit) {
  Cell<D> cell = centre.array() - radius;
  for (;;) {
    visit(static_cast<const Cell<D>&>(cell));
    int d = 0;
    while (d < D && ++cell[d] > centre[d] + radius) {
      cell[d] = centre[d] - radius;
      ++d;
    }
    if (d == D) return;
  }
}

// Everything in units of cells.
template <int D>
struct Element {
  Vec<D> mean = Vec<D>::Zero();    // of the end points in the cell
  Vec<D> normal = Vec<D>::Zero();  // unit length; zero where the surroundings are no surface
  double off_plane = 0.0;          // of the cell's centre from the surface around it
  double prominence = 1.0;         // its beams against those of the richest cell around
  Vec<D> centre = Vec<D>::Zero();  // of the surface around it, else the mean
  double half = 0.5;               // how far it extends from there for sure
};

constexpr int64_t kLastLook = std::numeric_limits<int32_t>::max();

// First and last look at which beams ended in a cell.
struct Span {
  int32_t first = static_cast<int32_t>(kLastLook), last = -1;

  void widen(int64_t look) {
    first = std::min(first, static_cast<int32_t>(look));
    last = std::max(last, static_cast<int32_t>(look));
  }
  int64_t looks() const { return int64_t{last} - first + 1; }
};

// Sums over the end points in a cell.
template <int D>
struct Sums {
  static constexpr int kProducts = D * (D + 1) / 2;

  Cell<D> cell;
  int64_t count = 0;
  std::array<Fixed, D> first{};           // of end point - cell corner
  std::array<Fixed, kProducts> second{};  // of its products, by rows of the upper triangle
  Span hit;

  void add(const Vec<D>& end) {
    const Vec<D> x = end - cell.template cast<double>();
    ++count;
    size_t product = 0;
    for (int i = 0; i < D; ++i) {
      first[static_cast<size_t>(i)] += to_fixed(x[i]);
      for (int j = i; j < D; ++j) second[product++] += to_fixed(x[i] * x[j]);
    }
  }
  // those of other end points in the same cell
  void add(const Sums& other) {
    count += other.count;
    for (size_t i = 0; i < first.size(); ++i) first[i] += other.first[i];
    for (size_t i = 0; i < second.size(); ++i) second[i] += other.second[i];
    hit.first = std::min(hit.first, other.hit.first);
    hit.last = std::max(hit.last, other.hit.last);
  }
};

// Count, mean and covariance of the end points in the cells around one.
template <int D>
struct Spread {
  using Square = Eigen::Matrix<double, D, D>;

  double count = 0.0, most = 0.0;  // in all cells, in one
  Vec<D> first = Vec<D>::Zero();
  Square second = Square::Zero();

  void add(const Sums<D>& s, const Cell<D>& about) {
    const Vec<D> corner = (s.cell - about).template cast<double>();
    const double n = static_cast<double>(s.count);
    Vec<D> sum;
    for (int d = 0; d < D; ++d) sum[d] = from_fixed(s.first[static_cast<size_t>(d)]);
    Square products;
    size_t product = 0;
    for (int i = 0; i < D; ++i)
      for (int j = i; j < D; ++j) products(i, j) = products(j, i) = from_fixed(s.second[product++]);
    count += n;
    most = std::max(most, n);
    first += sum + n * corner;
    second += products + corner * sum.transpose() + sum * corner.transpose() +
              n * corner * corner.transpose();
  }
  Vec<D> mean() const { return first / count; }
  Square covariance() const { return second / count - mean() * mean().transpose(); }
};

}  // namespace stillmap
