// Block-sparse map from cells to values of any type.
#pragma once

#include <array>
#include <limits>
#include <memory>
#include <unordered_map>
#include <utility>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

// Has the block layout of OccupancyGrid, so BlockCursor and RayWalker work on both.
// Values: container of the values of a block.
template <int D, class Value, class Values = std::array<Value, BlockLayout<D>::kCells>>
class BlockMap : public BlockLayout<D> {
 public:
  using BlockLayout<D>::kCells;

  struct Block {
    Cell<D> origin;  // in blocks
    Values values;   // one per cell
  };

  static constexpr size_t kNoBlock = std::numeric_limits<size_t>::max();

  const Block* find(const Cell<D>& block) const {
    const size_t number = find_number(block);
    return number == kNoBlock ? nullptr : blocks_[number].get();
  }
  // Index in `blocks`; kNoBlock if there is none.
  size_t find_number(const Cell<D>& block) const {
    const auto it = index_.find(BlockLayout<D>::key(block));
    return it == index_.end() ? kNoBlock : it->second;
  }

  // In order of insertion.
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

  // Removes the blocks for which keep(block coordinates) is false; the others keep their order.
  template <class Keep>
  void keep_if(Keep&& keep) {
    last_ = nullptr;
    size_t n_kept = 0;
    for (size_t k = 0; k < blocks_.size(); ++k) {
      const uint64_t key = BlockLayout<D>::key(blocks_[k]->origin);
      if (!keep(blocks_[k]->origin)) {
        index_.erase(key);
        continue;
      }
      index_[key] = n_kept;
      if (n_kept != k) blocks_[n_kept] = std::move(blocks_[k]);
      ++n_kept;
    }
    blocks_.resize(n_kept);
  }

 private:
  std::vector<std::unique_ptr<Block>> blocks_;
  Block* last_ = nullptr;
  std::unordered_map<uint64_t, size_t, typename BlockLayout<D>::Hash> index_;
};

}  // namespace stillmap
