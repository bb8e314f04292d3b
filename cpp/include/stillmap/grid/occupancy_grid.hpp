// Block-sparse counts alpha, beta of (10), and what registration wants to know besides: the first
// moments of the end points, and what beams crossed just before they ended.
// Sums are integers (fixed point), so they do not depend on the order of the terms: scans, chunks,
// threads and whole grids merge to the same bits.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <memory>
#include <stdexcept>
#include <unordered_map>
#include <utility>
#include <vector>

#include "stillmap/grid/ray_traversal.hpp"

namespace stillmap {

using Fixed = int64_t;
constexpr double kFixedOne = 16777216.0;  // 2^24: a float32 in [0, 1] keeps all of its bits

inline Fixed to_fixed(double value) { return std::llrint(value * kFixedOne); }
inline double from_fixed(Fixed value) { return static_cast<double>(value) / kFixedOne; }

struct Counts {
  Fixed alpha = 0;  // expected number of static hits
  Fixed beta = 0;   // expected number of dynamic hits + traversed length in cells
};

// m_j of (15); the caller excludes cells nobody looked at.
inline double occupancy(const Counts& c) {
  return static_cast<double>(c.alpha) / static_cast<double>(c.alpha + c.beta);
}

template <int D>
class Grid {
 public:
  static constexpr int kDimension = D;
  static constexpr int kShift = D == 2 ? 5 : 3;
  static constexpr int kEdge = 1 << kShift;
  static constexpr int kCells = D == 2 ? kEdge * kEdge : kEdge * kEdge * kEdge;
  // coordinates beyond are refused; block coordinates fit the 21 bits that a key has for each
  static constexpr int32_t kMaxCell = D == 2 ? 1 << 24 : 1 << 23;
  // sum of e * (end point - cell corner), in cells; last, the length by which beams covered the
  // cell on the approach to their end points
  using Moment = std::array<Fixed, D + 1>;

  struct Block {
    Cell<D> origin;  // block coordinates
    std::array<Counts, kCells> counts{};
    std::unique_ptr<std::array<Moment, kCells>> moments;  // only where something was hit, or nearly
  };

  // approach: metres before an end point in which a beam says nothing against what it crosses
  // when scans are registered; (10) counts them all the same
  explicit Grid(double resolution, double approach = 0.0)
      : resolution_(resolution), approach_(approach) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
    if (!(approach >= 0.0) || !std::isfinite(approach))
      throw std::invalid_argument("approach: expected a length in metres that is not negative");
  }

  Grid(Grid&&) noexcept = default;
  Grid& operator=(Grid&&) noexcept = default;
  Grid(const Grid&) = delete;  // grids are large: copies would be accidents
  Grid& operator=(const Grid&) = delete;

  double resolution() const { return resolution_; }
  double approach() const { return approach_; }
  const std::vector<std::unique_ptr<Block>>& blocks() const { return blocks_; }

  const Block* find(const Cell<D>& block) const {
    const auto it = index_.find(key(block));
    return it == index_.end() ? nullptr : blocks_[it->second].get();
  }

  Block* find_or_add(const Cell<D>& block) {
    const auto [it, added] = index_.try_emplace(key(block), blocks_.size());
    if (added) {
      blocks_.push_back(std::make_unique<Block>());
      blocks_.back()->origin = block;
    }
    return blocks_[it->second].get();
  }

  static Cell<D> block_of(const Cell<D>& cell) {
    Cell<D> block;
    for (int d = 0; d < D; ++d) block[d] = cell[d] >> kShift;
    return block;
  }

  // x runs fastest
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

  void merge(const Grid& other) {
    if (other.resolution_ != resolution_ || other.approach_ != approach_)
      throw std::invalid_argument("merge: the grids differ in resolution or approach");
    for (const auto& theirs : other.blocks_) {
      Block* mine = find_or_add(theirs->origin);
      for (size_t i = 0; i < kCells; ++i) {
        mine->counts[i].alpha += theirs->counts[i].alpha;
        mine->counts[i].beta += theirs->counts[i].beta;
      }
      if (!theirs->moments) continue;
      auto& moments = moments_of(*mine);
      for (size_t i = 0; i < kCells; ++i)
        for (size_t d = 0; d <= D; ++d) moments[i][d] += (*theirs->moments)[i][d];
    }
  }

  // m_j of (15) without the lengths on the approach: beams that graze a wall cross its cells before
  // they end on it, and that says nothing against the wall. The block must have moments.
  static double presence(const Block& block, size_t local) {
    const Counts& c = block.counts[local];
    // the walk along the approach may differ from the whole walk by a rounding
    const Fixed passed = std::max<Fixed>(c.beta - (*block.moments)[local][D], 0);
    return static_cast<double>(c.alpha) / static_cast<double>(c.alpha + passed);
  }

  static std::array<Moment, kCells>& moments_of(Block& block) {
    if (!block.moments) block.moments = std::make_unique<std::array<Moment, kCells>>();
    return *block.moments;
  }

  size_t memory_bytes() const {
    size_t bytes = blocks_.size() * (sizeof(Block) + 64);
    for (const auto& block : blocks_)
      if (block->moments) bytes += sizeof(*block->moments);
    return bytes;
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

 private:
  double resolution_;
  double approach_;
  std::vector<std::unique_ptr<Block>> blocks_;
  std::unordered_map<uint64_t, size_t, Hash> index_;
};

// Finds cells quickly when neighbours are asked for in a row: remembers the last block.
template <class GridType>
class Cursor {
 public:
  static constexpr int D = std::remove_const_t<GridType>::kDimension;
  using Block = std::conditional_t<std::is_const_v<GridType>, const typename GridType::Block,
                                   typename GridType::Block>;

  explicit Cursor(GridType& grid) : grid_(grid) {}

  // A const grid yields nullptr where it has no block; others get the block they need.
  Block* block(const Cell<D>& cell) {
    const Cell<D> wanted = GridType::block_of(cell);
    if (!known_ || wanted != at_) {
      if constexpr (std::is_const_v<GridType>) {
        block_ = grid_.find(wanted);
      } else {
        block_ = grid_.find_or_add(wanted);
      }
      at_ = wanted;
      known_ = true;
    }
    return block_;
  }

  // nullptr where nobody looked
  const Counts* seen(const Cell<D>& cell) {
    const auto* found = block(cell);
    if (!found) return nullptr;
    const Counts& c = found->counts[static_cast<size_t>(GridType::local_of(cell))];
    return c.alpha + c.beta > 0 ? &c : nullptr;
  }

 private:
  GridType& grid_;
  Cell<D> at_ = Cell<D>::Zero();
  Block* block_ = nullptr;
  bool known_ = false;
};

// Follows a beam through a grid: `visit` gets the counts of each cell (nullptr where a const grid
// has no block) and the length in it, or which cell it is. Only a step out of a block looks
// anything up.
template <class GridType, class Visit>
class Walker {
 public:
  static constexpr int D = std::remove_const_t<GridType>::kDimension;
  using G = std::remove_const_t<GridType>;
  using Block = typename Cursor<GridType>::Block;
  using CountsPointer = decltype(std::declval<Block&>().counts.data());

  Walker(Cursor<GridType>& cursor, Visit visit) : cursor_(cursor), visit_(visit) {}

  void start(const Cell<D>& cell) {
    cell_ = cell;
    enter();
  }

  void visit(double length) {
    if constexpr (std::is_invocable_v<Visit, CountsPointer, const Cell<D>&>) {
      visit_(counts_, cell_);
    } else {
      visit_(counts_, length);
    }
  }

  template <int Axis>
  void step(int32_t direction) {
    constexpr int stride = 1 << (Axis * G::kShift);
    cell_[Axis] += direction;
    place_[Axis] += direction;
    if (static_cast<uint32_t>(place_[Axis]) >= static_cast<uint32_t>(G::kEdge)) {
      enter();
    } else if (!std::is_const_v<GridType> || counts_) {
      counts_ += direction * stride;
    }
  }

  // the cell it has reached
  const Cell<D>& cell() const { return cell_; }
  Block* block() const { return block_; }
  CountsPointer counts() const { return counts_; }

 private:
  void enter() {
    block_ = cursor_.block(cell_);
    counts_ = block_ ? block_->counts.data() + G::local_of(cell_) : nullptr;
    for (int d = 0; d < D; ++d) place_[d] = cell_[d] & (G::kEdge - 1);
  }

  Cursor<GridType>& cursor_;
  Visit visit_;
  Cell<D> cell_ = Cell<D>::Zero();
  Cell<D> place_ = Cell<D>::Zero();  // within the block
  Block* block_ = nullptr;
  CountsPointer counts_ = nullptr;
};

}  // namespace stillmap
