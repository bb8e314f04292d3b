// Something for each cell, sparsely: values in blocks of cells as Grid has them.
#pragma once

#include <array>
#include <memory>
#include <unordered_map>
#include <utility>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

// A grid to walk through as Grid is, with values of another kind instead of counts.
template <int D, class Value>
class BlockMap : public BlockLayout<D> {
 public:
  using BlockLayout<D>::kCells;

  struct Block {
    Cell<D> origin;                    // block coordinates
    std::array<Value, kCells> values;  // of each cell
  };

  const Block* find(const Cell<D>& block) const {
    const auto it = index_.find(BlockLayout<D>::key(block));
    return it == index_.end() ? nullptr : blocks_[it->second].get();
  }

  // in the order in which they were added
  const std::vector<std::unique_ptr<Block>>& blocks() const { return blocks_; }

 protected:
  Block* find_or_add(const Cell<D>& block, const Value& value) {
    if (last_ && last_->origin == block) return last_;
    const auto [it, added] = index_.try_emplace(BlockLayout<D>::key(block), blocks_.size());
    if (added) {
      blocks_.push_back(std::make_unique<Block>());
      blocks_.back()->origin = block;
      blocks_.back()->values.fill(value);
    }
    last_ = blocks_[it->second].get();
    return last_;
  }

  // Keeps the blocks that keep(block coordinates) says, in their order.
  template <class Keep>
  void keep_if(Keep&& keep) {
    last_ = nullptr;
    size_t kept = 0;
    for (size_t k = 0; k < blocks_.size(); ++k) {
      const uint64_t key = BlockLayout<D>::key(blocks_[k]->origin);
      if (!keep(blocks_[k]->origin)) {
        index_.erase(key);
        continue;
      }
      index_[key] = kept;
      if (kept != k) blocks_[kept] = std::move(blocks_[k]);
      ++kept;
    }
    blocks_.resize(kept);
  }

 private:
  std::vector<std::unique_ptr<Block>> blocks_;
  Block* last_ = nullptr;
  std::unordered_map<uint64_t, size_t, typename BlockLayout<D>::Hash> index_;
};

}  // namespace stillmap
