// Traversal of the cells with surfels along a ray: the same cells as `traverse`. It proceeds block
// by block and tests the few set cells of a block instead of all cells along the ray.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <limits>
#include <type_traits>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/occupancy/surfel_bitmap.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap {

template <int D>
class SurfelTraversal {
 public:
  static constexpr bool kUsesBits = true;  // the 2D version visits all surfels
  using BlockBits = typename SurfelBitmap<D>::BlockBits;

  // Set cell on the ray.
  struct Crossing {
    size_t block;  // number in the bitmap
    int32_t surfel;
    int32_t n_before;  // borders on the ray before it
    Cell<D> cell;
  };

  SurfelTraversal(const SurfelMap<D>&, const SurfelBitmap<D>& bitmap) : bitmap_(bitmap) {}

  // Calls visit(crossing) for the set cells of `bits` that the ray leaves before its end, block by
  // block; those of one block in any order.
  template <class Visit>
  void traverse_marked(const Vec<D>& start, const Vec<D>& end, const std::vector<BlockBits>& bits,
                       Visit&& visit) {
    compute_borders(start, end);
    Cell<D> block = BlockLayout<D>::block_of(first_);
    if (!has_start_ || block != start_block_) {  // the beams of a sweep start in one block
      has_start_ = true;
      start_block_ = block;
      start_page_ = bitmap_.page_of(block);
    }
    const int32_t* page = start_page_;
    std::array<int32_t, D> exit_border;  // number of the border at which each axis leaves the block
    std::array<double, D> exit_length;   // arc length there
    for (int d = 0; d < D; ++d) {
      const int32_t local = first_[d] & (kEdge - 1);
      exit_border[to_size(d)] = axes_[to_size(d)].step > 0 ? kEdge - 1 - local : local;
      exit_length[to_size(d)] = axes_[to_size(d)].border(exit_border[to_size(d)]);
    }
    double enter_at = 0.0;
    // Leaves the block along an axis, known when compiled; false in the last block.
    const auto leave = [&](auto axis) {
      constexpr int d = decltype(axis)::value;
      const double leave_at = exit_length[d];
      const int32_t number =
          page ? page[SurfelBitmap<D>::index_in_page(block)] : SurfelBitmap<D>::kNone;
      if (number != SurfelBitmap<D>::kNone)
        visit_block(enter_at, std::min(leave_at, length_), block, static_cast<size_t>(number), bits,
                    visit);
      if (!(leave_at < kInf)) return false;
      enter_at = leave_at;
      exit_border[d] += kEdge;
      exit_length[d] = axes_[d].border(exit_border[d]);
      const int32_t previous = block[d];
      block[d] = previous + axes_[d].step;
      if (!SurfelBitmap<D>::same_page(previous, block[d])) page = bitmap_.page_of(block);
      return true;
    };
    using X = std::integral_constant<int, 0>;
    using Y = std::integral_constant<int, 1>;
    using Z = std::integral_constant<int, D - 1>;
    for (bool is_inside = true; is_inside;) {  // branches, as an index would wait for comparisons
      const bool y_first = exit_length[1] < exit_length[0];
      if (D == 3 && exit_length[D - 1] < exit_length[y_first ? 1 : 0]) {
        is_inside = leave(Z{});
      } else if (y_first) {
        is_inside = leave(Y{});
      } else {
        is_inside = leave(X{});
      }
    }
  }

 private:
  static constexpr int kEdge = SurfelMap<D>::kEdge;
  static constexpr double kInf = std::numeric_limits<double>::infinity();

  static size_t to_size(int axis) { return static_cast<size_t>(axis); }

  // Borders between the cells along one axis, numbered from 0 in the order of the ray.
  struct Axis {
    double first, delta;  // arc length at border 0, and between two borders
    int32_t count, step;  // borders that the ray crosses; +1 or -1

    // Arc length at a border; infinite behind the last one.
    double border(int32_t i) const { return i < count ? first + i * delta : kInf; }
  };

  void compute_borders(const Vec<D>& start, const Vec<D>& end) {
    first_ = cell_of<D>(start);
    const Cell<D> cells = cell_of<D>(end) - first_;
    const Vec<D> direction = end - start;
    const double length = direction.norm();
    start_ = start;
    length_ = length;
    direction_ = direction * (1.0 / length);
    for (int d = 0; d < D; ++d) {
      const double to_border = first_[d] + (cells[d] > 0 ? 1 : 0) - start[d];
      axes_[to_size(d)] = {to_border / direction[d] * length, length / std::abs(direction[d]),
                           std::abs(cells[d]), cells[d] > 0 ? 1 : -1};
    }
  }

  // Visits the set cells of one block, which contains the ray between two arc lengths.
  template <class Visit>
  void visit_block(double from, double to, const Cell<D>& block, size_t number,
                   const std::vector<BlockBits>& bits, Visit&& visit) {
    const BlockBits& block_bits = bits[number];
    std::array<uint32_t, D> slices;     // set slices within the ray's bounding box
    for (int d = D - 1; d >= 0; --d) {  // z first: most beams pass above all surfels
      constexpr double margin = 1e-6;   // cells, more than rounding errors
      const double corner = start_[d] - block[d] * kEdge;
      const double entry = corner + direction_[d] * from, exit = corner + direction_[d] * to;
      // the offset of one makes the cast round down
      const int low = static_cast<int>(std::min(entry, exit) - margin + 1.0) - 1;
      const int high = static_cast<int>(std::max(entry, exit) + margin);
      const uint64_t box = (uint64_t{2} << std::clamp(high, 0, kEdge - 1)) -
                           (uint64_t{1} << std::clamp(low, 0, kEdge - 1));
      slices[to_size(d)] = static_cast<uint32_t>(box) & block_bits.slices[to_size(d)];
      if (!slices[to_size(d)]) return;
    }
    block_bits.for_each_in_slices(slices, [&](size_t tile, size_t bit, const Cell<D>& local) {
      const Cell<D> cell = block * kEdge + local;
      const int32_t n_before = borders_before(cell);
      if (n_before >= 0) visit(Crossing{number, bitmap_.surfel(number, tile, bit), n_before, cell});
    });
  }

  // Number of borders before a cell; negative if the ray misses the cell or ends in it.
  int32_t borders_before(const Cell<D>& cell) const {
    int32_t n_before = 0;
    std::array<double, D> entry, exit;
    double entered = -kInf, left = kInf;
    for (int d = 0; d < D; ++d) {
      const Axis& axis = axes_[to_size(d)];
      const int32_t i = (cell[d] - first_[d]) * axis.step;
      if (i < 0 || i > axis.count) return -1;
      entry[to_size(d)] = i > 0 ? axis.border(i - 1) : -kInf;
      exit[to_size(d)] = axis.border(i);
      entered = std::max(entered, entry[to_size(d)]);
      left = std::min(left, exit[to_size(d)]);
      n_before += i;
    }
    if (!(left < kInf)) return -1;
    return entered < left || (entered == left && crosses_corner(entry, exit, left)) ? n_before : -1;
  }

  // Whether a ray crosses a cell whose corner it meets: there the border of the lower axis comes
  // first, as in `traverse`.
  static bool crosses_corner(const std::array<double, D>& entry, const std::array<double, D>& exit,
                             double left) {
    const auto exit_axis = std::find(exit.begin(), exit.end(), left) - exit.begin();
    bool crosses = true;
    for (int d = 0; d < D; ++d) crosses &= (entry[to_size(d)] < left) | (d < exit_axis);
    return crosses;
  }

  const SurfelBitmap<D>& bitmap_;
  Vec<D> start_, direction_;
  double length_;
  Cell<D> first_;
  bool has_start_ = false;
  Cell<D> start_block_;  // of the last ray
  const int32_t* start_page_;
  std::array<Axis, D> axes_;
};

// In 2D surfels are dense along rays, so all cells are visited.
template <>
class SurfelTraversal<2> {
 public:
  static constexpr bool kUsesBits = false;
  using BlockBits = SurfelBitmap<2>::BlockBits;

  struct Crossing {
    int32_t surfel;
    Cell<2> cell;
  };

  SurfelTraversal(const SurfelMap<2>& surfel_map, const SurfelBitmap<2>&) : cursor_(surfel_map) {}

  template <class Visit>
  void traverse_marked(const Vec<2>& start, const Vec<2>& end, const std::vector<BlockBits>&,
                       Visit&& visit) {
    const auto cells = (cell_of<2>(end) - cell_of<2>(start)).cwiseAbs().sum();
    crossings_.resize(std::max(crossings_.size(), static_cast<size_t>(cells) + 1));
    // branch-free, as the test is unpredictable
    Crossing* next = crossings_.data();
    RayWalker walker(cursor_, [&](const int32_t* k, const Cell<2>& cell) {
      const int32_t surfel = k ? *k : kNoSurfel;
      *next = {surfel, cell};
      next += surfel != kNoSurfel;
    });
    traverse<2>(start, end, walker);
    for (const Crossing* crossing = crossings_.data(); crossing != next; ++crossing)
      visit(*crossing);
  }

 private:
  std::vector<Crossing> crossings_;
  BlockCursor<const SurfelMap<2>> cursor_;
};

}  // namespace stillmap
