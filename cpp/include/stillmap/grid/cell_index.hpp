// Block-sparse map from cells to int32 indices.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <memory>
#include <tuple>
#include <type_traits>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

// Indices of the cells of a block in 3D. Surfaces leave most of a block empty, and a return far
// from all others nearly all of it, so slices one cell high are allocated when an index is written.
class SlicedIndices {
 public:
  static constexpr int32_t kNone = -1;
  static constexpr size_t kSlices = BlockLayout<3>::kEdge;
  using Slice = std::array<int32_t, BlockLayout<3>::kCells / kSlices>;

  int32_t operator[](size_t local) const {
    const Slice* found = slice(local / kSliceSize);
    return found ? (*found)[local % kSliceSize] : kNone;
  }
  // Adds the slice where there is none.
  int32_t& operator[](size_t local) {
    std::unique_ptr<Slice>& found = slices_[local / kSliceSize];
    if (!found) {
      found = std::make_unique<Slice>();
      found->fill(kNone);
    }
    return (*found)[local % kSliceSize];
  }

  // nullptr if no cell of it has an index.
  const Slice* slice(size_t z) const { return slices_[z].get(); }

  // Gives all cells one index, which must be kNone.
  void fill(int32_t) { slices_ = {}; }

 private:
  static constexpr size_t kSliceSize = std::tuple_size_v<Slice>;

  std::array<std::unique_ptr<Slice>, kSlices> slices_;
};

template <int D>
using DenseIndices = std::array<int32_t, BlockLayout<D>::kCells>;

// Cells without an entry have the index kNone. With dense indices RayWalker can traverse it like an
// OccupancyGrid.
template <int D, class Indices = DenseIndices<D>>
class CellIndex : public BlockMap<D, int32_t, Indices> {
 public:
  static constexpr int32_t kNone = -1;

 protected:
  // Index of a cell, kNone after insertion.
  int32_t& index_of(const Cell<D>& cell) {
    auto* block = this->find_or_add(BlockLayout<D>::block_of(cell), kNone);
    return block->values[static_cast<size_t>(BlockLayout<D>::local_of(cell))];
  }
};

// Index of the cells that surfaces run through.
template <int D>
using SurfaceIndex = CellIndex<D, std::conditional_t<D == 2, DenseIndices<2>, SlicedIndices>>;

}  // namespace stillmap
