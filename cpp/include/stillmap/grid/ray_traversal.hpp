// Grid traversal (Amanatides and Woo 1987) with the chord length in each cell: l_j of Sect. 3.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <type_traits>

#include "stillmap/grid/cell.hpp"

namespace stillmap {

// Visits the cells of a segment in order. Points and lengths are in units of cells. Calls
// visitor.start(first cell), then at every cell border visitor.visit(chord length in the cell it
// leaves) and visitor.step<axis>(+1 or -1); returns the chord length in the end cell. At a corner
// it passes through a cell with chord length zero, so exactly sum |end cell - start cell| borders
// are crossed.
template <int D, class Visitor>
inline double traverse(const Vec<D>& start, const Vec<D>& end, Visitor& visitor) {
  constexpr double inf = std::numeric_limits<double>::infinity();
  const Cell<D> first = cell_of<D>(start), last = cell_of<D>(end);
  const Vec<D> direction = end - start;
  const double length = direction.norm();

  struct Axis {
    double next;   // arc length at the next border
    double delta;  // arc length between two borders
    int32_t left;  // borders left to cross
    int32_t step;
  };
  Axis axes[D];
  int64_t borders = 0;
  for (int d = 0; d < D; ++d) {
    const int32_t cells = last[d] - first[d];
    const int32_t step = cells > 0 ? 1 : -1;
    const double to_border = first[d] + (cells > 0 ? 1 : 0) - start[d];
    axes[d] = {cells ? to_border / direction[d] * length : inf,
               cells ? length / std::abs(direction[d]) : inf, std::abs(cells), step};
    borders += axes[d].left;
  }
  visitor.start(first);
  double travelled = 0.0;
  auto cross = [&](Axis& axis, auto which) {
    const double border = axis.next;
    visitor.visit(border > travelled ? border - travelled : 0.0);
    travelled = border > travelled ? border : travelled;
    axis.next = --axis.left ? border + axis.delta : inf;
    visitor.template step<decltype(which)::value>(axis.step);
  };
  using X = std::integral_constant<int, 0>;
  using Y = std::integral_constant<int, 1>;
  using Z = std::integral_constant<int, D - 1>;
  for (; borders > 0; --borders) {
    const bool y_first = axes[1].next < axes[0].next;
    if (D == 3 && axes[D - 1].next < axes[y_first ? 1 : 0].next) {
      cross(axes[D - 1], Z{});
    } else if (y_first) {
      cross(axes[1], Y{});
    } else {
      cross(axes[0], X{});
    }
  }
  return length > travelled ? length - travelled : 0.0;
}

// What visitors for `traverse` have in common that follow the cell themselves.
template <int D>
struct CellTracker {
  void start(const Cell<D>& first) { cell = first; }
  template <int Axis>
  void step(int32_t direction) {
    cell[Axis] += direction;
  }

  Cell<D> cell = Cell<D>::Zero();
};

}  // namespace stillmap
