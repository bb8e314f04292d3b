// Block-sparse map from cells to int32 indices.
#pragma once

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

// Cells without an entry have the index kNone. RayWalker can traverse it like an OccupancyGrid.
template <int D>
class CellIndex : public BlockMap<D, int32_t> {
 public:
  static constexpr int32_t kNone = -1;

 protected:
  // Index of a cell, kNone after insertion.
  int32_t& index_of(const Cell<D>& cell) {
    auto* block = this->find_or_add(BlockLayout<D>::block_of(cell), kNone);
    return block->values[static_cast<size_t>(BlockLayout<D>::local_of(cell))];
  }
};

}  // namespace stillmap
