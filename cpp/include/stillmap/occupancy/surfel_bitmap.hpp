// Bitmap of the cells that have surfels: a fraction of the size of the index, so rays can test it
// in every cell.
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <type_traits>
#include <utility>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap {

// Number of set bits. The builtin calls a library function on processors without popcount.
constexpr int32_t popcount(uint64_t x) {
  x -= (x >> 1) & 0x5555555555555555u;
  x = (x & 0x3333333333333333u) + ((x >> 2) & 0x3333333333333333u);
  x = (x + (x >> 4)) & 0x0f0f0f0f0f0f0f0fu;
  return static_cast<int32_t>((x * 0x0101010101010101u) >> 56);
}

// Masks of the cells of a tile (4 cells a side) for each set of slices masks an axis: [axis][set
// of slices].
template <int D>
using SliceMasks = std::array<std::array<uint64_t, 16>, D>;
template <int D>
constexpr SliceMasks<D> make_slice_masks() {
  SliceMasks<D> masks{};
  for (size_t d = 0; d < D; ++d)
    for (size_t slices = 0; slices < 16; ++slices)
      for (size_t cell = 0; cell < size_t{1} << (2 * D); ++cell)
        if (slices >> ((cell >> (2 * d)) & 3) & 1) masks[d][slices] |= uint64_t{1} << cell;
  return masks;
}
template <int D>
inline constexpr SliceMasks<D> kSliceMasks = make_slice_masks<D>();

// The blocks of a surfel map, cut into tiles of 4 cells a side. Surfels of a tile are numbered
// consecutively in the order of its bits.
template <int D>
class SurfelBitmap {
 public:
  using Mask = std::conditional_t<D == 2, uint16_t, uint64_t>;
  static constexpr int kShift = 2, kTileEdge = 1 << kShift;  // edge of a tile, in cells
  static constexpr int kTilesPerEdge = SurfelMap<D>::kEdge >> kShift;
  static constexpr int kTilesPerBlock = SurfelMap<D>::kCells >> (D * kShift);
  using SliceMask = std::conditional_t<D == 2, uint32_t, uint8_t>;
  static constexpr int32_t kNone = -1;

  // Set of cells of one block.
  class BlockBits {
   public:
    std::array<Mask, kTilesPerBlock> tiles{};
    std::array<SliceMask, D> slices{};  // slices masks each axis that have set cells

    bool contains(const Cell<D>& cell) const { return tiles[tile_of(cell)] & bit(bit_of(cell)); }
    void set(const Cell<D>& cell) {
      tiles[tile_of(cell)] |= bit(bit_of(cell));
      for (int d = 0; d < D; ++d)
        slices[static_cast<size_t>(d)] |=
            static_cast<SliceMask>(SliceMask{1} << (cell[d] & (SurfelMap<D>::kEdge - 1)));
    }
    void clear(const Cell<D>& cell) {
      tiles[tile_of(cell)] &= static_cast<Mask>(~bit(bit_of(cell)));
      for (int d = 0; d < D; ++d) {
        const int slice = cell[d] & (SurfelMap<D>::kEdge - 1);
        if (!any_in_slice(d, slice))
          slices[static_cast<size_t>(d)] &= static_cast<SliceMask>(~(1u << slice));
      }
    }

    // `clear`, for many cells before one call of `find_slices`.
    void clear_in_tile(const Cell<D>& cell) {
      tiles[tile_of(cell)] &= static_cast<Mask>(~bit(bit_of(cell)));
    }
    void find_slices() {
      for (int d = 0; d < D; ++d) {
        auto& found = slices[static_cast<size_t>(d)];
        for (int slice = 0; slice < SurfelMap<D>::kEdge; ++slice)
          if ((found >> slice & 1u) && !any_in_slice(d, slice))
            found &= static_cast<SliceMask>(~(1u << slice));
      }
    }

    // Calls visit(tile, bit, cell in the block) for set cells within sets of slices masks each
    // axis.
    template <class Visit>
    void for_each_in_slices(const std::array<uint32_t, D>& requested, Visit&& visit) const {
      std::array<std::array<uint64_t, kTilesPerEdge>, D>
          tile_masks;  // of the tile coordinates along each axis
      for (size_t d = 0; d < D; ++d)
        for (size_t i = 0; i < kTilesPerEdge; ++i)
          tile_masks[d][i] = kSliceMasks<D>[d][requested[d] >> (i << kShift) & 15u];
      const auto tile_coordinate = [](size_t t, size_t d) {
        return (t >> (d * kTileBits)) & (kTilesPerEdge - 1);
      };
      for (size_t t = 0; t < tiles.size(); ++t) {
        uint64_t mask = tiles[t];
        for (size_t d = 0; d < D; ++d) mask &= tile_masks[d][tile_coordinate(t, d)];
        for (; mask; mask &= mask - 1) {
          const auto number = static_cast<size_t>(__builtin_ctzll(mask));
          Cell<D> cell;
          for (size_t d = 0; d < D; ++d)
            cell[static_cast<int>(d)] = static_cast<int32_t>(
                (tile_coordinate(t, d) << kShift) + ((number >> (d * kShift)) & (kTileEdge - 1)));
          visit(t, number, cell);
        }
      }
    }

   private:
    bool any_in_slice(int axis, int slice) const {
      const auto tile = static_cast<size_t>(slice >> kShift);
      const uint64_t mask =
          kSliceMasks<D>[static_cast<size_t>(axis)][1u << (slice & (kTileEdge - 1))];
      uint64_t any = 0;
      for (size_t t = 0; t < tiles.size(); ++t)
        if (((t >> (axis * kTileBits)) & (kTilesPerEdge - 1)) == tile) any |= tiles[t] & mask;
      return any != 0;
    }
  };

  explicit SurfelBitmap(const SurfelMap<D>& surfel_map) {
    bits_.resize(surfel_map.blocks().size());
    first_surfel_.resize(surfel_map.blocks().size());
    block_of_surfel_.resize(surfel_map.size());
    for (size_t b = 0; b < bits_.size(); ++b) {
      const auto& block = *surfel_map.blocks()[b];
      first_surfel_[b].fill(kNoSurfel);
      for (int local = 0; local < SurfelMap<D>::kCells; ++local) {
        const int32_t k = block.values[static_cast<size_t>(local)];
        if (k == kNoSurfel) continue;
        const Cell<D> cell = BlockLayout<D>::cell_at(Cell<D>::Zero(), local);
        bits_[b].set(cell);
        block_of_surfel_[static_cast<size_t>(k)] = static_cast<int32_t>(b);
        int32_t& first = first_surfel_[b][tile_of(cell)];
        if (first == kNoSurfel || k < first) first = k;
      }
      add_block(block.origin, static_cast<int32_t>(b));
    }
  }

  // Number of a block; kNone if the map has no such block.
  int32_t block_number(const Cell<D>& block) const {
    const int32_t* page = page_of(block);
    return page ? page[index_in_page(block)] : kNone;
  }
  // Number of the block of a surfel.
  size_t block_of_surfel(int32_t k) const {
    return static_cast<size_t>(block_of_surfel_[static_cast<size_t>(k)]);
  }
  // Numbers of the blocks of a page; nullptr if it has none.
  const int32_t* page_of(const Cell<D>& block) const {
    if (slots_.empty()) return nullptr;
    const uint64_t key = BlockLayout<D>::key(page_index(block));
    for (size_t slot = hash_(key) & (slots_.size() - 1);; slot = (slot + 1) & (slots_.size() - 1)) {
      if (!slots_[slot].page) return nullptr;
      if (slots_[slot].key == key) return slots_[slot].page->data();
    }
  }
  static Cell<D> page_index(const Cell<D>& block) {
    Cell<D> page;
    for (int d = 0; d < D; ++d) page[d] = block[d] >> kPageShift;
    return page;
  }
  static bool same_page(int32_t a, int32_t b) { return a >> kPageShift == b >> kPageShift; }
  static size_t index_in_page(const Cell<D>& block) { return linear_index<kPageShift>(block); }

  // Cells with surfels, per block.
  const std::vector<BlockBits>& bits() const { return bits_; }

  // Index of a cell's tile within its block, and of a cell's bit within its tile.
  static size_t tile_of(const Cell<D>& cell) {
    Cell<D> tile;
    for (int d = 0; d < D; ++d) tile[d] = cell[d] >> kShift;
    return linear_index<kTileBits>(tile);
  }
  static size_t bit_of(const Cell<D>& cell) { return linear_index<kShift>(cell); }
  static Mask bit(size_t number) { return static_cast<Mask>(Mask{1} << number); }

  // Surfel of a cell; kNoSurfel if there is none.
  int32_t surfel(const Cell<D>& cell) const {
    return surfel(block_number(BlockLayout<D>::block_of(cell)), cell);
  }
  // The same with the number of its block.
  int32_t surfel(int32_t block, const Cell<D>& cell) const {
    if (block == kNone) return kNoSurfel;
    const size_t tile = tile_of(cell), number = bit_of(cell);
    const auto b = static_cast<size_t>(block);
    return bits_[b].tiles[tile] & bit(number) ? surfel(b, tile, number) : kNoSurfel;
  }
  int32_t surfel(size_t block, size_t tile, size_t number) const {
    const auto below = uint64_t{bits_[block].tiles[tile]} & ((uint64_t{1} << number) - 1);
    return first_surfel_[block][tile] + popcount(below);
  }

 private:
  // 8 blocks a side in 2D, 4 in 3D: both take 256 bytes, which a single return far from all others
  // needs
  static constexpr int kPageShift = D == 2 ? 3 : 2;
  static constexpr int kTileBits = SurfelMap<D>::kShift - kShift;
  using Page = std::array<int32_t, 1 << (D * kPageShift)>;
  struct Slot {
    uint64_t key = 0;
    std::unique_ptr<Page> page;  // null: free
  };

  // Index within a cube of 2^Shift cells a side, x fastest.
  template <int Shift>
  static size_t linear_index(const Cell<D>& cell) {
    constexpr int mask = (1 << Shift) - 1;
    int index = cell[D - 1] & mask;
    for (int d = D - 2; d >= 0; --d) index = (index << Shift) | (cell[d] & mask);
    return static_cast<size_t>(index);
  }

  void add_block(const Cell<D>& block, int32_t number) {
    if (2 * (n_pages_ + 1) > slots_.size()) grow();
    Slot& slot = slot_of(BlockLayout<D>::key(page_index(block)));
    if (!slot.page) {
      slot.page = std::make_unique<Page>();
      slot.page->fill(kNone);
      ++n_pages_;
    }
    (*slot.page)[index_in_page(block)] = number;
  }
  // Slot of a key; assigns a free one to a new key.
  Slot& slot_of(uint64_t key) {
    size_t slot = hash_(key) & (slots_.size() - 1);
    while (slots_[slot].page && slots_[slot].key != key) slot = (slot + 1) & (slots_.size() - 1);
    slots_[slot].key = key;
    return slots_[slot];
  }
  void grow() {
    std::vector<Slot> old_slots(slots_.empty() ? 64 : 2 * slots_.size());
    old_slots.swap(slots_);
    for (Slot& slot : old_slots)
      if (slot.page) slot_of(slot.key).page = std::move(slot.page);
  }

  typename BlockLayout<D>::Hash hash_;
  std::vector<Slot> slots_;
  size_t n_pages_ = 0;
  std::vector<BlockBits> bits_;  // per block
  std::vector<std::array<int32_t, kTilesPerBlock>> first_surfel_;
  std::vector<int32_t> block_of_surfel_;
};

}  // namespace stillmap
