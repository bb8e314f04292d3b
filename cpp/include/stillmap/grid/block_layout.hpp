// Block layout shared by all block-sparse maps: cubic blocks of 32 x 32 cells in 2D and of 8 x 8 x
// 8 cells in 3D.
#pragma once

#include <cstddef>
#include <cstdint>

#include "stillmap/grid/cell.hpp"

namespace stillmap {

template <int D>
struct BlockLayout {
  static constexpr int kDimension = D;
  static constexpr int kShift = D == 2 ? 5 : 3;
  static constexpr int kEdge = 1 << kShift;
  static constexpr int kCells = D == 2 ? kEdge * kEdge : kEdge * kEdge * kEdge;
  // Largest cell coordinate that is accepted, so that a block coordinate fits the 21 bits of its
  // key.
  static constexpr int32_t kMaxCell = D == 2 ? 1 << 24 : 1 << 23;

  static Cell<D> block_of(const Cell<D>& cell) {
    Cell<D> block;
    for (int d = 0; d < D; ++d) block[d] = cell[d] >> kShift;
    return block;
  }

  // Index of a cell within its block, x fastest.
  static int local_of(const Cell<D>& cell) {
    constexpr int mask = kEdge - 1;
    int local = cell[D - 1] & mask;
    for (int d = D - 2; d >= 0; --d) local = (local << kShift) | (cell[d] & mask);
    return local;
  }

  static Cell<D> cell_at(const Cell<D>& block, int local) {
    Cell<D> cell;
    for (int d = 0; d < D; ++d)
      cell[d] = block[d] * kEdge + ((local >> (d * kShift)) & (kEdge - 1));
    return cell;
  }

  static uint64_t key(const Cell<D>& block) {
    uint64_t packed = 0;
    for (int d = 0; d < D; ++d)
      packed = (packed << 21) | (static_cast<uint64_t>(static_cast<int64_t>(block[d])) & 0x1fffff);
    return packed;
  }
  struct Hash {
    size_t operator()(uint64_t k) const {
      k ^= k >> 31;
      k *= 0x9e3779b97f4a7c15ull;
      return static_cast<size_t>(k ^ (k >> 29));
    }
  };
};

}  // namespace stillmap
