// Queries of all indexed cells in a window around a cell. Caches those of the 3^D blocks around the
// block of the window's centre that windows reached, since successive queries are usually close
// together. In 3D, where most cells are empty, indexed ones are found in bit masks of the rows of
// cells.
#pragma once

#include <algorithm>
#include <array>
#include <bitset>
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
  using Index = SurfaceIndex<D>;
  static constexpr size_t kRows = static_cast<size_t>(Index::kCells / Index::kEdge);
  using Masks = std::array<uint8_t, kRows>;

  explicit RowMasks(const Index& index) {
    if constexpr (kUsed) {
      static_assert(Index::kEdge == 8);
      masks_.reserve(index.blocks().size());
      for (const auto& block : index.blocks()) masks_.push_back(masks_of(block->values));
    }
  }

  const Masks& of_block(size_t number) const { return masks_[number]; }
  static const Masks& none() {
    static const Masks empty{};
    return empty;
  }

 private:
  static Masks masks_of(const SlicedIndices& indices) {
    Masks masks{};
    auto mask = masks.begin();
    for (size_t z = 0; z < SlicedIndices::kSlices; ++z) {
      const SlicedIndices::Slice* slice = indices.slice(z);
      if (!slice) {
        mask += Index::kEdge;
        continue;
      }
      for (auto index = slice->begin(); index != slice->end(); ++mask)
        for (unsigned x = 0; x < 8; ++x, ++index)
          *mask = static_cast<uint8_t>(*mask | (unsigned{*index != Index::kNone} << x));
    }
    return masks;
  }

  std::vector<Masks> masks_;
};

template <int D>
class WindowQuery {
 public:
  using Index = SurfaceIndex<D>;

  // Both are referred to, and the index must not change.
  WindowQuery(const Index& index, const RowMasks<D>& masks) : index_(index), masks_(masks) {}

  // Calls visit(index) for the indexed cells of a window around a cell, row by row.
  template <class Visit>
  void for_each(const Cell<D>& centre, const CellRows<D>& rows, Visit&& visit) {
    if (rows.empty()) return;
    const int32_t radius = -rows.front().offset[D - 1];
    cache_blocks(centre, radius);
    if constexpr (RowMasks<D>::kUsed) {
      if (radius <= Index::kEdge) {  // within the blocks around that of the centre
        for_each_by_masks(centre, rows, visit);
        return;
      }
    }
    for (const CellRow<D>& row : rows) {
      Cell<D> cell = centre + row.offset;
      const int32_t last = cell[0] + row.half_width;
      for (cell[0] -= row.half_width; cell[0] <= last;) {
        const int32_t stop = std::min(last, cell[0] | (Index::kEdge - 1));
        const Block* block = cached_block(Index::block_of(cell));
        if (block) {
          const auto first = static_cast<size_t>(Index::local_of(cell));
          const size_t end = first + static_cast<size_t>(stop - cell[0] + 1);
          for (size_t local = first; local < end; ++local)
            if (const int32_t index = block->values[local]; index != Index::kNone) visit(index);
        }
        cell[0] = stop + 1;
      }
    }
  }

 private:
  template <class Visit>
  void for_each_by_masks(const Cell<D>& centre, const CellRows<D>& rows, Visit&& visit) const {
    constexpr int32_t edge = Index::kEdge;
    const Cell<D> local = centre - Index::block_of(centre) * edge;
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

  using Block = typename Index::Block;
  static constexpr size_t kBlocks = D == 2 ? 9 : 27;

  // Looks up the blocks that a window reaches. Where surfaces are far apart few windows share a
  // block, and most of the blocks around it would be looked up in vain.
  void cache_blocks(const Cell<D>& centre, int32_t radius) {
    const Cell<D> block = Index::block_of(centre);
    if (!valid_ || block != centre_block_) {
      centre_block_ = block;
      valid_ = true;
      reached_ = 0;
      is_cached_.reset();
      if constexpr (RowMasks<D>::kUsed) block_masks_.fill(&RowMasks<D>::none());
      cache_block(Cell<D>::Zero());
    }
    uint32_t reached = 0;
    for (int d = 0; d < D; ++d) {
      const int32_t local = centre[d] & (Index::kEdge - 1);
      reached |= uint32_t{local < radius} << (2 * d);
      reached |= uint32_t{local >= Index::kEdge - radius} << (2 * d + 1);
    }
    if ((reached & ~reached_) == 0) return;
    reached_ |= reached;
    Cell<D> low, high;
    for (int d = 0; d < D; ++d) {
      low[d] = -static_cast<int32_t>(reached_ >> (2 * d) & 1u);
      high[d] = static_cast<int32_t>(reached_ >> (2 * d + 1) & 1u);
    }
    for_each_in_box<D>(low, high, [&](const Cell<D>& step) { cache_block(step); });
  }

  // step: from the centre's block.
  void cache_block(const Cell<D>& step) {
    const size_t i = cached_index(step);
    if (is_cached_[i]) return;
    is_cached_.set(i);
    const size_t number = index_.find_number(centre_block_ + step);
    const bool is_there = number != Index::kNoBlock;
    if constexpr (RowMasks<D>::kUsed)
      block_masks_[i] = is_there ? &masks_.of_block(number) : &RowMasks<D>::none();
    blocks_[i] = is_there ? index_.blocks()[number].get() : nullptr;
  }

  // Index of a block among those around the centre's, by the steps from that, -1 to 1.
  static size_t cached_index(const Cell<D>& step) {
    size_t i = 0;
    for (int d = D - 1; d >= 0; --d) i = 3 * i + static_cast<size_t>(step[d] + 1);
    return i;
  }

  const Block* cached_block(const Cell<D>& block) const {
    const Cell<D> step = block - centre_block_;
    if ((step.array().abs() > 1).any()) return index_.find(block);
    return blocks_[cached_index(step)];
  }

  const Index& index_;
  const RowMasks<D>& masks_;
  bool valid_ = false;
  Cell<D> centre_block_ = Cell<D>::Zero();
  uint32_t reached_ = 0;  // the sides on which blocks are cached, two bits for each axis
  std::bitset<kBlocks> is_cached_;
  std::array<const Block*, kBlocks> blocks_{};
  std::array<const typename RowMasks<D>::Masks*, kBlocks> block_masks_{};  // 3D only
};

}  // namespace stillmap
