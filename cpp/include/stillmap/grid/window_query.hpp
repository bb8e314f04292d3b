// Queries of all indexed cells in a window around a cell. Caches the 3^D blocks around the block of
// the window's centre, since successive queries are usually close together.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/cell_index.hpp"

namespace stillmap {

// Row of cells along x, relative to the window's centre.
template <int D>
struct CellRow {
  Cell<D> offset;
  int32_t half_width;  // cells to either side of the row's middle
};
template <int D>
using CellRows = std::vector<CellRow<D>>;

// Rows of a window, in order of the later axes: the ball of cells whose centres lie within a radius
// (cells), or the cube around it.
template <int D>
inline CellRows<D> window_rows(double radius, bool cube) {
  const auto cells = static_cast<int>(std::floor(radius));
  CellRows<D> rows;
  for_each_in_cube<D>(Cell<D>::Zero(), cells, [&](const Cell<D>& off) {
    if (off[0] != 0) return;
    const double squared_rest = radius * radius - off.template cast<double>().squaredNorm();
    if (cube) rows.push_back({off, cells});
    if (!cube && squared_rest >= 0.0)
      rows.push_back({off, static_cast<int32_t>(std::sqrt(squared_rest))});
  });
  return rows;
}

template <int D>
class WindowQuery {
 public:
  explicit WindowQuery(const CellIndex<D>& index) : index_(index) {}

  // Calls visit(index) for the indexed cells of a window around a cell, row by row.
  template <class Visit>
  void for_each(const Cell<D>& centre, const CellRows<D>& rows, Visit&& visit) {
    cache_blocks(CellIndex<D>::block_of(centre));
    for (const CellRow<D>& row : rows) {
      Cell<D> cell = centre + row.offset;
      const int32_t last = cell[0] + row.half_width;
      for (cell[0] -= row.half_width; cell[0] <= last;) {
        const int32_t stop = std::min(last, cell[0] | (CellIndex<D>::kEdge - 1));
        const Block* block = cached_block(CellIndex<D>::block_of(cell));
        if (block) {
          const int32_t* index = block->values.data() + CellIndex<D>::local_of(cell);
          for (const int32_t* end = index + (stop - cell[0] + 1); index != end; ++index)
            if (*index != CellIndex<D>::kNone) visit(*index);
        }
        cell[0] = stop + 1;
      }
    }
  }

 private:
  using Block = typename CellIndex<D>::Block;
  static constexpr size_t kBlocks = D == 2 ? 9 : 27;

  void cache_blocks(const Cell<D>& block) {
    if (valid_ && block == centre_block_) return;
    centre_block_ = block;
    valid_ = true;
    size_t i = 0;
    for_each_in_cube<D>(block, 1,
                        [&](const Cell<D>& neighbour) { blocks_[i++] = index_.find(neighbour); });
  }

  const Block* cached_block(const Cell<D>& block) const {
    size_t i = 0;
    for (int d = D - 1; d >= 0; --d) {
      const int32_t step = block[d] - centre_block_[d] + 1;
      if (step < 0 || step > 2) return index_.find(block);
      i = 3 * i + static_cast<size_t>(step);
    }
    return blocks_[i];
  }

  const CellIndex<D>& index_;
  Cell<D> centre_block_ = Cell<D>::Zero();
  bool valid_ = false;
  std::array<const Block*, kBlocks> blocks_{};
};

}  // namespace stillmap
