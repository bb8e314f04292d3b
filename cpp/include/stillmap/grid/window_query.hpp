// Queries of all indexed cells in a window around a cell. Caches the 3^D blocks around the block of
// the window's centre, since successive queries are usually close together. In 3D, where most cells
// are empty, indexed ones are found in bit masks of the rows of cells.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
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

// Indexed cells of each block: a byte for each row along x, a bit for each cell of it. Empty in 2D.
template <int D>
class RowMasks {
 public:
  static constexpr bool kUsed = D == 3;
  static constexpr size_t kRows = static_cast<size_t>(CellIndex<D>::kCells / CellIndex<D>::kEdge);
  using Masks = std::array<uint8_t, kRows>;

  explicit RowMasks(const CellIndex<D>& index) {
    if constexpr (kUsed) {
      static_assert(CellIndex<D>::kEdge == 8);
      masks_.reserve(index.blocks().size());
      for (const auto& block : index.blocks()) masks_.push_back(masks_of(block->values.data()));
    }
  }

  const Masks& of_block(size_t number) const { return masks_[number]; }
  static const Masks& none() {
    static const Masks empty{};
    return empty;
  }

 private:
  static Masks masks_of(const int32_t* index) {
    Masks masks{};
    for (uint8_t& mask : masks)
      for (unsigned x = 0; x < 8; ++x, ++index)
        mask = static_cast<uint8_t>(mask | (unsigned{*index != CellIndex<D>::kNone} << x));
    return masks;
  }

  std::vector<Masks> masks_;
};

template <int D>
class WindowQuery {
 public:
  // Both are referred to, and the index must not change.
  WindowQuery(const CellIndex<D>& index, const RowMasks<D>& masks) : index_(index), masks_(masks) {}

  // Calls visit(index) for the indexed cells of a window around a cell, row by row.
  template <class Visit>
  void for_each(const Cell<D>& centre, const CellRows<D>& rows, Visit&& visit) {
    cache_blocks(CellIndex<D>::block_of(centre));
    if constexpr (RowMasks<D>::kUsed) {
      const int32_t radius = rows.empty() ? 0 : -rows.front().offset[D - 1];
      if (radius <= CellIndex<D>::kEdge) {  // within the blocks around that of the centre
        for_each_by_masks(centre, rows, visit);
        return;
      }
    }
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
  template <class Visit>
  void for_each_by_masks(const Cell<D>& centre, const CellRows<D>& rows, Visit&& visit) const {
    constexpr int32_t edge = CellIndex<D>::kEdge;
    const Cell<D> local = centre - CellIndex<D>::block_of(centre) * edge;
    for (const CellRow<D>& row : rows) {
      // from the lowest corner of the cached blocks
      const auto y = static_cast<size_t>(local[1] + row.offset[1] + edge);
      const auto z = static_cast<size_t>(local[2] + row.offset[2] + edge);
      const size_t first = 3 * (3 * (z / edge) + y / edge);  // of the three blocks along x
      const size_t line = z % edge * edge + y % edge;
      uint32_t bits = (*block_masks_[first])[line] | (*block_masks_[first + 1])[line] << edge |
                      (*block_masks_[first + 2])[line] << (2 * edge);
      bits &= ((uint32_t{2} << (2 * row.half_width)) - 1) << (local[0] + edge - row.half_width);
      for (; bits; bits &= bits - 1) {
        const auto x = static_cast<size_t>(__builtin_ctz(bits));
        visit(blocks_[first + x / edge]->values[line * edge + x % edge]);
      }
    }
  }

  using Block = typename CellIndex<D>::Block;
  static constexpr size_t kBlocks = D == 2 ? 9 : 27;

  void cache_blocks(const Cell<D>& block) {
    if (valid_ && block == centre_block_) return;
    centre_block_ = block;
    valid_ = true;
    size_t i = 0;
    for_each_in_cube<D>(block, 1, [&](const Cell<D>& neighbour) {
      const size_t number = index_.find_number(neighbour);
      const bool is_there = number != CellIndex<D>::kNoBlock;
      if constexpr (RowMasks<D>::kUsed)
        block_masks_[i] = is_there ? &masks_.of_block(number) : &RowMasks<D>::none();
      blocks_[i++] = is_there ? index_.blocks()[number].get() : nullptr;
    });
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
  const RowMasks<D>& masks_;
  Cell<D> centre_block_ = Cell<D>::Zero();
  bool valid_ = false;
  std::array<const Block*, kBlocks> blocks_{};
  std::array<const typename RowMasks<D>::Masks*, kBlocks> block_masks_{};  // 3D only
};

}  // namespace stillmap
