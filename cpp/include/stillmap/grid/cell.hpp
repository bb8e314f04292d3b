// Integer cells of a regular grid and points in units of cells: cell = floor(point / resolution).
#pragma once

#include <Eigen/Core>
#include <cstdint>

namespace stillmap {

template <int D>
using Vec = Eigen::Matrix<double, D, 1>;
template <int D>
using Cell = Eigen::Matrix<int32_t, D, 1>;

// False for NaN as well, since comparisons with NaN are false.
template <int D>
inline bool all_below(const Vec<D>& x, double limit) {
  return (x.array().abs() < limit).all();
}

template <int D>
inline Cell<D> cell_of(const Vec<D>& point_in_cells) {
  return point_in_cells.array().floor().template cast<int32_t>();
}

// Calls visit(cell) for all cells of the cube of edge 2 radius + 1 around a cell, x fastest.
template <int D, class Visit>
inline void for_each_in_cube(const Cell<D>& centre, int radius, Visit&& visit) {
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

// Calls visit(cell) for the cells of a box, bounds included, x fastest.
template <int D, class Visit>
inline void for_each_in_box(const Cell<D>& low, const Cell<D>& high, Visit&& visit) {
  if ((low.array() > high.array()).any()) return;
  Cell<D> cell = low;
  while (true) {
    visit(cell);
    int d = 0;
    for (; d < D; ++d) {
      if (++cell[d] <= high[d]) break;
      cell[d] = low[d];
    }
    if (d == D) return;
  }
}

}  // namespace stillmap
