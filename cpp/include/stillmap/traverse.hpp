// Cells and chord lengths along a segment: the l_j of the paper's last paragraph of Sect. 3.
#pragma once

#include <Eigen/Core>
#include <cmath>
#include <cstdint>
#include <limits>

namespace stillmap {

template <int D>
using Vec = Eigen::Matrix<double, D, 1>;
template <int D>
using Cell = Eigen::Matrix<int32_t, D, 1>;

// NaN compares false, so it is refused like a coordinate that is too far away
template <int D>
inline bool all_below(const Vec<D>& x, double limit) {
  return (x.array().abs() < limit).all();
}

template <int D>
inline Cell<D> cell_of(const Vec<D>& point_in_cells) {
  return point_in_cells.array().floor().template cast<int32_t>();
}

// Calls visit(cell, length) for every cell of the segment before its end cell, in order.
// Points are given in units of cells, and so are the lengths. Returns the end cell; its own chord
// is written to *last_length. Crossing a corner passes through a cell of length zero, so that
// exactly sum |end - start| borders are crossed and the walk always ends.
template <int D, class Visit>
inline Cell<D> traverse(const Vec<D>& start, const Vec<D>& end, Visit&& visit,
                        double* last_length = nullptr) {
  constexpr double inf = std::numeric_limits<double>::infinity();
  Cell<D> cell = cell_of<D>(start);
  const Cell<D> last = cell_of<D>(end);
  const Vec<D> direction = end - start;
  const double length = direction.norm();

  Vec<D> next, delta;  // arc length at the next border of each axis, and between its borders
  Cell<D> step;
  int64_t borders = 0;
  for (int d = 0; d < D; ++d) {
    const int32_t cells = last[d] - cell[d];
    borders += std::abs(cells);
    step[d] = cells > 0 ? 1 : -1;
    delta[d] = cells ? length / std::abs(direction[d]) : inf;
    next[d] = cells ? (cell[d] + (cells > 0 ? 1 : 0) - start[d]) / direction[d] * length : inf;
  }
  double travelled = 0.0;
  for (; borders > 0; --borders) {
    int axis = next[1] < next[0] ? 1 : 0;
    if constexpr (D == 3) axis = next[2] < next[axis] ? 2 : axis;
    const double border = next[axis];
    visit(cell, border > travelled ? border - travelled : 0.0);
    travelled = border > travelled ? border : travelled;
    cell[axis] += step[axis];
    next[axis] = cell[axis] == last[axis] ? inf : border + delta[axis];
  }
  if (last_length) *last_length = length > travelled ? length - travelled : 0.0;
  return last;
}

}  // namespace stillmap
