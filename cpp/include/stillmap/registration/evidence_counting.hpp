// Counts (10) of a 2D map as far as its evidence needs them: in cells near returns. Most of a beam
// passes through free space, which is no evidence, and is not followed there.
#pragma once

#include <cstdint>
#include <unordered_map>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/beam_counting.hpp"
#include "stillmap/registration/surface_information.hpp"

namespace stillmap {

// Tiles of 4 x 4 cells in which maps have returns: a mask of 8 x 8 tiles per block.
class ReturnTiles {
 public:
  static constexpr int kEdge = 4;  // cells

  // other: a second map, may be nullptr. everywhere: all tiles, whatever the maps hold.
  ReturnTiles(const OccupancyGrid<2>& grid, const OccupancyGrid<2>* other, bool everywhere)
      : everywhere(everywhere), grid_(grid), other_(other) {}

  const bool everywhere;

  // The maps may get more free space, but no returns, between calls.
  uint64_t mask_of(const Cell<2>& block) {
    const auto [it, added] = masks_.try_emplace(BlockLayout<2>::key(block), 0);
    if (added) it->second = mask_of(grid_, block) | (other_ ? mask_of(*other_, block) : 0);
    return it->second;
  }

  // Of a tile within its block.
  static uint64_t bit_of(const Cell<2>& tile) {
    return uint64_t{1} << ((tile[0] & 7) | ((tile[1] & 7) << 3));
  }

 private:
  static uint64_t mask_of(const OccupancyGrid<2>& grid, const Cell<2>& block) {
    const auto* stored = grid.find(block);
    uint64_t tiles = 0;
    for (size_t local = 0; stored && local < stored->values.size(); ++local)  // 32 rows of 32 cells
      tiles |= uint64_t{stored->values[local].alpha > 0} << ((local >> 2 & 7) | local >> 7 << 3);
    return tiles;
  }

  const OccupancyGrid<2>& grid_;
  const OccupancyGrid<2>* other_;
  std::unordered_map<uint64_t, uint64_t, BlockLayout<2>::Hash> masks_;
};

// Adds the lengths that beams travel in the tiles; a visitor for `traverse` in units of tiles.
class TileWalker : public CellTracker<2> {
 public:
  TileWalker(OccupancyGrid<2>& grid, ReturnTiles& tiles)
      : tiles_(tiles), cursor_(grid), walker_(cursor_, AddLength()) {}

  void add(const BeamSegment<2>& beam) {
    if (tiles_.everywhere) {
      traverse<2>(beam.start, beam.end, walker_);
      return;
    }
    constexpr double tiles = 1.0 / ReturnTiles::kEdge;
    beam_ = &beam;
    direction_ = (beam.end - beam.start).normalized();
    travelled_ = 0.0;
    was_inside_ = false;
    traverse<2>(beam.start * tiles, beam.end * tiles, *this);
    enter();
    if (was_inside_) traverse<2>(first_, beam.end, walker_);
  }

  void visit(double length) {
    enter();
    travelled_ += length * ReturnTiles::kEdge;
  }

 private:
  struct AddLength {
    void operator()(CellCounts* j, double length) const { j->beta += to_fixed(length); }
  };

  // Follows the beam through the tiles before `cell`, which is a tile, if that is none of them.
  void enter() {
    const Cell<2> block(cell[0] >> 3, cell[1] >> 3);
    if (block != block_) mask_ = tiles_.mask_of(block);
    block_ = block;
    const bool is_inside = mask_ & ReturnTiles::bit_of(cell);
    if (is_inside == was_inside_) return;
    if (is_inside) {
      first_ = position();
    } else {
      const double rest = traverse<2>(first_, position(), walker_);
      AddLength()(walker_.value(), rest);
    }
    was_inside_ = is_inside;
  }
  Vec<2> position() const { return beam_->start + travelled_ * direction_; }

  ReturnTiles& tiles_;
  BlockCursor<OccupancyGrid<2>> cursor_;
  RayWalker<OccupancyGrid<2>, AddLength> walker_;
  const BeamSegment<2>* beam_ = nullptr;
  Vec<2> direction_ = Vec<2>::Zero(), first_ = Vec<2>::Zero();
  double travelled_ = 0.0;  // cells
  bool was_inside_ = false;
  Cell<2> block_ = Cell<2>::Constant(BlockLayout<2>::kMaxCell);  // no block
  uint64_t mask_ = 0;                                            // of the block
};

// P(static) of the end points of one scan, less what they have in common with their neighbours.
inline std::vector<float> independent_weights(const Scans<2>& scan, const float* e,
                                              double correlation_length) {
  std::vector<float> weights(e + scan.offset[0], e + scan.offset[1]);
  std::vector<Vec<2>> ends;
  for (int64_t n = scan.offset[0]; n < scan.offset[1]; ++n)
    if (scan.hit[n]) ends.push_back(point_at<2>(scan.points + 2 * n));
  const auto shares = evidence_shares(ends, correlation_length);
  auto share = shares.begin();
  for (size_t n = 0; n < weights.size(); ++n)
    if (scan.hit[scan.offset[0] + static_cast<int64_t>(n)])
      weights[n] *= static_cast<float>(*share++);
  return weights;
}

// Adds the counts of scans, each by itself, to a grid without moments. Alpha is whole; beta is that
// of `tiles`.
inline void count_near_returns(OccupancyGrid<2>& grid, const std::vector<Scans<2>>& scans,
                               const float* e, double correlation_length, ReturnTiles& tiles) {
  for (const auto& scan : scans) {
    const auto weights = independent_weights(scan, e, correlation_length);
    const int64_t first = scan.offset[0], offset[2] = {0, scan.offset[1] - first};
    const Scans<2> beams{scan.points + 2 * first, scan.hit + first, offset, scan.poses, 1};
    add_end_points<2>(grid, beams, weights.data(), 1);
  }
  TileWalker walker(grid, tiles);
  for (const auto& scan : scans)
    for_each_beam<2>(scan, 0, 1, [&](size_t, int64_t n, const Pose<2>& pose) {
      walker.add(BeamSegment<2>(pose, scan.points + 2 * n, grid.resolution()));
    });
}

}  // namespace stillmap
