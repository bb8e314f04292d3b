// Numbers the cells of which something is known, sparsely: int32 places in blocks of cells.
#pragma once

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

// A grid to walk through as Grid is, with the place of each cell, or kNone, instead of counts.
template <int D>
class CellIndex : public BlockMap<D, int32_t> {
 public:
  static constexpr int32_t kNone = -1;

 protected:
  // kNone at first
  int32_t& index_of(const Cell<D>& cell) {
    auto* block = this->find_or_add(BlockLayout<D>::block_of(cell), kNone);
    return block->values[static_cast<size_t>(BlockLayout<D>::local_of(cell))];
  }
};

}  // namespace stillmap
