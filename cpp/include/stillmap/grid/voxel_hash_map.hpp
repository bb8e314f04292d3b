// Hash map from voxels to values whose memory can be reclaimed.
#pragma once

#include <cstdint>
#include <stdexcept>
#include <utility>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

// Open addressing with linear probing. Entries are never erased one by one: keep_if rebuilds the
// table, so probing needs no tombstones and values keep their order of insertion.
template <int D, class Value>
class VoxelHashMap {
 public:
  // Cells beyond would share keys.
  static constexpr int32_t kMaxCell = 1 << 20;

  size_t size() const { return values_.size(); }
  const Cell<D>& cell(size_t k) const { return cells_[k]; }
  const Value& value(size_t k) const { return values_[k]; }

  const Value* find(const Cell<D>& cell) const {
    if (values_.empty()) return nullptr;
    const uint64_t key = BlockLayout<D>::key(cell);
    for (size_t slot = hash_(key) & mask();; slot = (slot + 1) & mask()) {
      const Slot& s = slots_[slot];
      if (s.index < 0) return nullptr;
      if (s.key == key) return &values_[static_cast<size_t>(s.index)];
    }
  }

  // Inserts Value{} if the voxel is new.
  Value& find_or_add(const Cell<D>& cell) {
    for (int d = 0; d < D; ++d)
      if (cell[d] <= -kMaxCell || cell[d] >= kMaxCell)
        throw std::invalid_argument("point: too far away to be counted in cells");
    if (2 * (values_.size() + 1) > slots_.size()) grow();
    const uint64_t key = BlockLayout<D>::key(cell);
    Slot& s = slot_of(key);
    if (s.index < 0) {
      s = {key, static_cast<int32_t>(values_.size())};
      cells_.push_back(cell);
      values_.emplace_back();
    }
    return values_[static_cast<size_t>(s.index)];
  }

  // Removes the voxels for which keep(cell) is false.
  template <class Keep>
  void keep_if(Keep&& keep) {
    size_t n_kept = 0;
    for (size_t k = 0; k < values_.size(); ++k) {
      if (!keep(cells_[k])) continue;
      cells_[n_kept] = cells_[k];
      values_[n_kept++] = std::move(values_[k]);
    }
    cells_.resize(n_kept);
    values_.resize(n_kept);
    size_t slots = kMinSlots;
    while (slots < 4 * n_kept) slots *= 2;
    rehash(slots);
  }

 private:
  static constexpr size_t kMinSlots = 64;

  struct Slot {
    uint64_t key = 0;
    int32_t index = -1;  // into values_; -1: free
  };

  size_t mask() const { return slots_.size() - 1; }

  Slot& slot_of(uint64_t key) {
    size_t slot = hash_(key) & mask();
    while (slots_[slot].index >= 0 && slots_[slot].key != key) slot = (slot + 1) & mask();
    return slots_[slot];
  }

  void grow() { rehash(slots_.empty() ? kMinSlots : 2 * slots_.size()); }

  void rehash(size_t slots) {
    std::vector<Slot>(slots).swap(slots_);
    for (size_t k = 0; k < cells_.size(); ++k) {
      const uint64_t key = BlockLayout<D>::key(cells_[k]);
      slot_of(key) = {key, static_cast<int32_t>(k)};
    }
  }

  typename BlockLayout<D>::Hash hash_;
  std::vector<Slot> slots_;
  std::vector<Cell<D>> cells_;
  std::vector<Value> values_;
};

}  // namespace stillmap
