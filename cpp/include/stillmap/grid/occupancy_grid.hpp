// Block-sparse counts alpha, beta of (10). For registration it also keeps the first moments of the
// end points and the length that beams travelled just before their end points.
// Sums are fixed-point integers and so do not depend on the order of the terms: scans, chunks,
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

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"

namespace stillmap {

using Fixed = int64_t;
constexpr double kFixedOne = 16777216.0;  // 2^24: exact for any float32 in [0, 1]

inline Fixed to_fixed(double value) { return std::llrint(value * kFixedOne); }
inline double from_fixed(Fixed value) { return static_cast<double>(value) / kFixedOne; }

struct CellCounts {
  Fixed alpha = 0;  // expected number of static hits
  Fixed beta = 0;   // expected number of dynamic hits + traversed length in cells
};

// Occupancy m_j of (15); undefined for unobserved cells, which the caller excludes.
inline double occupancy(const CellCounts& c) {
  return static_cast<double>(c.alpha) / static_cast<double>(c.alpha + c.beta);
}

template <int D>
class OccupancyGrid : public BlockLayout<D> {
 public:
  using BlockLayout<D>::kCells;

  // Sum of e (end point - cell corner) in cells. The last entry is the length in cells that beams
  // travelled through the cell on the approach to their end points.
  using Moment = std::array<Fixed, D + 1>;

  struct Block {
    Cell<D> origin;  // in blocks
    std::array<CellCounts, kCells> values{};
    // Allocated by the first end point or approach.
    std::unique_ptr<std::array<Moment, kCells>> moments;
  };

  // approach: length in metres before an end point whose traversal registration ignores; the counts
  // of (10) include it. with_moments: false saves most of the memory of blocks with end points,
  // but only the counts are there then.
  explicit OccupancyGrid(double resolution, double approach = 0.0, bool with_moments = true)
      : resolution_(resolution), approach_(approach), with_moments_(with_moments) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
    if (!(approach >= 0.0) || !std::isfinite(approach))
      throw std::invalid_argument("approach: expected a length in metres that is not negative");
    if (approach > 0.0 && !with_moments)
      throw std::invalid_argument("moments: needed for the crossings before an end point");
  }

  // An empty grid of the same kind.
  OccupancyGrid sibling() const { return OccupancyGrid(resolution_, approach_, with_moments_); }

  OccupancyGrid(OccupancyGrid&&) noexcept = default;
  OccupancyGrid& operator=(OccupancyGrid&&) noexcept = default;
  OccupancyGrid(const OccupancyGrid&) = delete;  // copies of large grids would be accidental
  OccupancyGrid& operator=(const OccupancyGrid&) = delete;

  double resolution() const { return resolution_; }
  double approach() const { return approach_; }
  bool with_moments() const { return with_moments_; }
  const std::vector<std::unique_ptr<Block>>& blocks() const { return blocks_; }

  const Block* find(const Cell<D>& block) const {
    const auto it = index_.find(BlockLayout<D>::key(block));
    return it == index_.end() ? nullptr : blocks_[it->second].get();
  }

  Block* find_or_add(const Cell<D>& block) {
    const auto [it, added] = index_.try_emplace(BlockLayout<D>::key(block), blocks_.size());
    if (added) {
      blocks_.push_back(std::make_unique<Block>());
      blocks_.back()->origin = block;
    }
    return blocks_[it->second].get();
  }

  void merge(const OccupancyGrid& other) {
    if (other.resolution_ != resolution_ || other.approach_ != approach_)
      throw std::invalid_argument("merge: the grids differ in resolution or approach");
    for (const auto& source : other.blocks_) {
      Block* target = find_or_add(source->origin);
      for (size_t i = 0; i < kCells; ++i) {
        target->values[i].alpha += source->values[i].alpha;
        target->values[i].beta += source->values[i].beta;
      }
      if (!source->moments) continue;
      auto& moments = moments_of(*target);
      for (size_t i = 0; i < kCells; ++i)
        for (size_t d = 0; d <= D; ++d) moments[i][d] += (*source->moments)[i][d];
    }
  }

  // Occupancy (15) without the traversals on the approach to an end point: beams at grazing
  // incidence cross the cells of a wall before they end on it, which is no evidence against the
  // wall. Requires moments in the block.
  static double occupancy_ignoring_approach(const Block& block, size_t local) {
    const CellCounts& c = block.values[local];
    // the two traversals may differ by rounding
    const Fixed passed = std::max<Fixed>(c.beta - (*block.moments)[local][D], 0);
    return static_cast<double>(c.alpha) / static_cast<double>(c.alpha + passed);
  }

  static std::array<Moment, kCells>& moments_of(Block& block) {
    if (!block.moments) block.moments = std::make_unique<std::array<Moment, kCells>>();
    return *block.moments;
  }

 private:
  double resolution_;
  double approach_;
  bool with_moments_;
  std::vector<std::unique_ptr<Block>> blocks_;
  std::unordered_map<uint64_t, size_t, typename BlockLayout<D>::Hash> index_;
};

}  // namespace stillmap
