// Access to the cells of a block-sparse map, cell by cell or along a beam.
#pragma once

#include <cstdint>
#include <type_traits>
#include <utility>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"

namespace stillmap {

// Looks cells up and remembers the last block, which makes access to nearby cells fast.
template <class GridType>
class BlockCursor {
 public:
  static constexpr int D = std::remove_const_t<GridType>::kDimension;
  using Block = std::conditional_t<std::is_const_v<GridType>, const typename GridType::Block,
                                   typename GridType::Block>;

  explicit BlockCursor(GridType& grid) : grid_(grid) {}

  // Block of a cell. nullptr if a const grid has none; a non-const grid adds it.
  Block* block(const Cell<D>& cell) {
    const Cell<D> index = GridType::block_of(cell);
    if (!valid_ || index != block_index_) {
      if constexpr (std::is_const_v<GridType>) {
        block_ = grid_.find(index);
      } else {
        block_ = grid_.find_or_add(index);
      }
      block_index_ = index;
      valid_ = true;
    }
    return block_;
  }

  // Counts of a cell; nullptr if it is unobserved.
  const CellCounts* find_observed(const Cell<D>& cell) {
    const auto* found = block(cell);
    if (!found) return nullptr;
    const CellCounts& c = found->values[static_cast<size_t>(GridType::local_of(cell))];
    return c.alpha + c.beta > 0 ? &c : nullptr;
  }

 private:
  GridType& grid_;
  Cell<D> block_index_ = Cell<D>::Zero();
  Block* block_ = nullptr;
  bool valid_ = false;
};

// Visitor for `traverse` that calls visit(value pointer, chord length) or visit(value pointer,
// cell) for each cell; the pointer is nullptr where a const grid has no block. It looks blocks up
// only when the ray leaves one.
template <class GridType, class Visit>
class RayWalker {
 public:
  static constexpr int D = std::remove_const_t<GridType>::kDimension;
  using G = std::remove_const_t<GridType>;
  using Block = typename BlockCursor<GridType>::Block;
  using ValuePointer = decltype(std::declval<Block&>().values.data());

  RayWalker(BlockCursor<GridType>& cursor, Visit visit) : cursor_(cursor), visit_(visit) {}

  void start(const Cell<D>& cell) {
    cell_ = cell;
    enter();
  }

  void visit(double length) {
    if constexpr (std::is_invocable_v<Visit, ValuePointer, const Cell<D>&>) {
      visit_(value_, cell_);
    } else {
      visit_(value_, length);
    }
  }

  template <int Axis>
  void step(int32_t direction) {
    constexpr int stride = 1 << (Axis * G::kShift);
    cell_[Axis] += direction;
    local_[Axis] += direction;
    if (static_cast<uint32_t>(local_[Axis]) >= static_cast<uint32_t>(G::kEdge)) {
      enter();
    } else if (!std::is_const_v<GridType> || value_) {
      value_ += direction * stride;
    }
  }

  // Cell, block and value at the current position.
  const Cell<D>& cell() const { return cell_; }
  Block* block() const { return block_; }
  ValuePointer value() const { return value_; }

 private:
  void enter() {
    block_ = cursor_.block(cell_);
    value_ = block_ ? block_->values.data() + G::local_of(cell_) : nullptr;
    for (int d = 0; d < D; ++d) local_[d] = cell_[d] & (G::kEdge - 1);
  }

  BlockCursor<GridType>& cursor_;
  Visit visit_;
  Cell<D> cell_ = Cell<D>::Zero();
  Cell<D> local_ = Cell<D>::Zero();  // coordinates within the block
  Block* block_ = nullptr;
  ValuePointer value_ = nullptr;
};

}  // namespace stillmap
