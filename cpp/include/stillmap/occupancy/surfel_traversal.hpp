// The cells that a segment crosses among some that are marked: those of `traverse`, in its order.
// It is followed block by block; within a block the few marked cells are asked, not all on the way.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <vector>

#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/occupancy/surfel_bitmap.hpp"

namespace stillmap {

template <int D>
class Crossing {
 public:
  static constexpr bool kByMarks = true;  // else it visits all elements, marked or not
  using Marks = typename Tiles<D>::Marks;

  // A marked cell that is crossed.
  struct Place {
    size_t block;  // numbered as in the tiles
    int32_t element;
    Cell<D> cell;
  };

  Crossing(const Surface<D>&, const Tiles<D>& tiles) : tiles_(tiles) {}

  // Calls visit(place) for the cells marked in blocks that the segment leaves before it ends.
  template <class Visit>
  void follow(const Vec<D>& start, const Vec<D>& end, const std::vector<Marks>& marked,
              Visit&& visit) {
    note_borders(start, end);
    Cell<D> block = Grid<D>::block_of(first_);
    const int32_t* page = tiles_.page_of(block);
    std::array<int32_t, D> leaves;  // border of each axis by which it may leave the block
    std::array<double, D> when;     // and the arc lengths there
    for (int d = 0; d < D; ++d) {
      const int32_t local = first_[d] & (kEdge - 1);
      leaves[at(d)] = step_[at(d)] > 0 ? kEdge - 1 - local : local;
      when[at(d)] = borders_[at(d)][leaves[at(d)] + 1];
    }
    double entered = 0.0;
    for (;;) {
      int axis = when[1] < when[0] ? 1 : 0;
      if (D == 3 && when[D - 1] < when[at(axis)]) axis = D - 1;
      const double left = when[at(axis)];
      last_ = page ? page[Tiles<D>::place_of(block)] : Tiles<D>::kNone;
      if (last_ != Tiles<D>::kNone)
        in_block(entered, std::min(left, length_), block, static_cast<size_t>(last_), marked,
                 visit);
      if (!(left < kInf)) return;
      entered = left;
      leaves[at(axis)] += kEdge;
      when[at(axis)] = borders_[at(axis)][leaves[at(axis)] + 1];
      const int32_t before = block[axis];
      block[axis] = before + step_[at(axis)];
      if (!Tiles<D>::same_page(before, block[axis])) page = tiles_.page_of(block);
    }
  }

  // the element in the cell in which the segment ended
  int32_t element_at_end(const Cell<D>& end) { return tiles_.element(last_, end); }

 private:
  static constexpr int kEdge = Surface<D>::kEdge;
  static constexpr double kInf = std::numeric_limits<double>::infinity();

  static size_t at(int axis) { return static_cast<size_t>(axis); }

  // Arc lengths at all borders of each axis, added up as `traverse` does; that of border i stands
  // at i + 1, for what lies before the first is entered from the start.
  void note_borders(const Vec<D>& start, const Vec<D>& end) {
    first_ = cell_of<D>(start);
    const Cell<D> cells = cell_of<D>(end) - first_;
    const Vec<D> direction = end - start;
    const double length = direction.norm();
    start_ = start;
    length_ = length;
    way_ = direction * (1.0 / length);
    for (int d = 0; d < D; ++d) {
      const int32_t n = std::abs(cells[d]);
      step_[at(d)] = cells[d] > 0 ? 1 : -1;
      const size_t size = static_cast<size_t>(n) + kEdge + 2;
      if (noted_[at(d)].size() < size) noted_[at(d)].resize(size);
      double* out = noted_[at(d)].data();
      borders_[at(d)] = out;
      *out++ = -kInf;
      if (n) {
        const double to_border = first_[d] + (cells[d] > 0 ? 1 : 0) - start[d];
        const double delta = length / std::abs(direction[d]);
        double next = to_border / direction[d] * length;
        for (int32_t i = 0; i < n; ++i, next += delta) *out++ = next;
      }
      std::fill_n(out, kEdge + 1, kInf);
    }
  }

  // The part of the segment between two arc lengths, which lies in a block.
  template <class Visit>
  void in_block(double from, double to, const Cell<D>& block, size_t number,
                const std::vector<Marks>& marked, Visit&& visit) {
    const Marks& marks = marked[number];
    std::array<uint32_t, D> slices;     // of the box around it, as far as they have marks
    for (int d = D - 1; d >= 0; --d) {  // most beams pass above what is there
      constexpr double margin = 1e-6;   // cells: more than any rounding
      const double corner = start_[d] - block[d] * kEdge;
      const double in = corner + way_[d] * from, out = corner + way_[d] * to;
      // one is added, as casts cut off towards zero
      const int low = static_cast<int>(std::min(in, out) - margin + 1.0) - 1;
      const int high = static_cast<int>(std::max(in, out) + margin);
      const uint64_t box = (uint64_t{2} << std::clamp(high, 0, kEdge - 1)) -
                           (uint64_t{1} << std::clamp(low, 0, kEdge - 1));
      slices[at(d)] = static_cast<uint32_t>(box) & marks.slices[at(d)];
      if (!slices[at(d)]) return;
    }
    size_t found = 0;
    marks.each_in(slices, [&](size_t tile, size_t bit, const Cell<D>& local) {
      const Cell<D> cell = block * kEdge + local;
      const int32_t steps = crossed(cell);
      if (steps < 0) return;
      size_t place = found++;  // in the order in which they are crossed
      for (; place > 0 && found_[place - 1].first > steps; --place)
        found_[place] = found_[place - 1];
      found_[place] = {steps, {number, tiles_.element(number, tile, bit), cell}};
    });
    for (size_t i = 0; i < found; ++i) visit(found_[i].second);
  }

  // Number of borders that are crossed before a cell is, negative if it is not, or not left again.
  // Of borders that are crossed at once, that of the first axis is crossed first.
  int32_t crossed(const Cell<D>& cell) const {
    int32_t steps = 0;
    std::array<double, D> in;
    double out = kInf;
    int by = 0;
    for (int d = 0; d < D; ++d) {
      const int32_t i = (cell[d] - first_[d]) * step_[at(d)];
      if (i < 0) return -1;
      const double* border = borders_[at(d)] + i;
      in[at(d)] = border[0];
      if (border[1] < out) out = border[1], by = d;
      steps += i;
    }
    bool crosses = out < kInf;
    for (int d = 0; d < D; ++d) crosses &= (in[at(d)] < out) | ((in[at(d)] == out) & (d < by));
    return crosses ? steps : -1;
  }

  const Tiles<D>& tiles_;
  Vec<D> start_, way_;
  double length_;
  Cell<D> first_;
  int32_t last_ = Tiles<D>::kNone;
  std::array<int32_t, D> step_;
  std::array<std::vector<double>, D> noted_;
  std::array<const double*, D> borders_;
  std::array<std::pair<int32_t, Place>, D * kEdge> found_;
};

// In a plane things are seldom far from one another: all elements on the way, cell by cell.
template <>
class Crossing<2> {
 public:
  static constexpr bool kByMarks = false;
  using Marks = Tiles<2>::Marks;

  struct Place {
    int32_t element;
    Cell<2> cell;
  };

  Crossing(const Surface<2>& surface, const Tiles<2>&) : cursor_(surface) {}

  template <class Visit>
  void follow(const Vec<2>& start, const Vec<2>& end, const std::vector<Marks>&, Visit&& visit) {
    const auto cells = (cell_of<2>(end) - cell_of<2>(start)).cwiseAbs().sum();
    places_.resize(std::max(places_.size(), static_cast<size_t>(cells) + 1));
    // no branch on whether there is an element: nobody could foresee it
    Place* next = places_.data();
    Walker walker(cursor_, [&](const int32_t* k, const Cell<2>& cell) {
      const int32_t element = k ? *k : kNoElement;
      *next = {element, cell};
      next += element != kNoElement;
    });
    traverse<2>(start, end, walker);
    for (const Place* place = places_.data(); place != next; ++place) visit(*place);
  }

  int32_t element_at_end(const Cell<2>& end) {
    const auto* block = cursor_.block(end);
    return block ? block->counts[static_cast<size_t>(Surface<2>::local_of(end))] : kNoElement;
  }

 private:
  std::vector<Place> places_;
  Cursor<const Surface<2>> cursor_;
};

}  // namespace stillmap
