// A block-sparse map in whose cells surfaces have forward filters: what all kinds of it share.
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <limits>
#include <stdexcept>
#include <unordered_set>
#include <utility>
#include <vector>

#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/occupancy/cell_filters.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

inline int32_t checked_bin(int64_t time_bin) {
  if (time_bin < 0 || time_bin > std::numeric_limits<int32_t>::max())
    throw std::invalid_argument("time_bin: expected an index from 0 to 2^31 - 1");
  return static_cast<int32_t>(time_bin);
}

// CellValue: of each cell, with a member `int32_t filter`, the index of its filter or -1.
template <int D, class CellValue>
class FilterMap : public BlockMap<D, CellValue> {
 public:
  using Map = BlockMap<D, CellValue>;
  using typename Map::Block;
  using ConstCursor = BlockCursor<const FilterMap>;

  FilterMap(double resolution, FilterOptions options)
      : resolution_(resolution), filters_(std::move(options)) {}

  double resolution() const { return resolution_; }
  size_t size() const { return filters_.size(); }

  // P(static) of the cell in which a beam ended, or of the best one within the hit radius;
  // `otherwise` where no beam ended before.
  float p_static_at(ConstCursor& cursor, const Vec<D>& end, float otherwise) {
    return find_best(cursor, end, otherwise, filters_);
  }
  float p_static_at(ConstCursor& cursor, const Vec<D>& end, float otherwise) const {
    return find_best(cursor, end, otherwise, filters_);
  }

  // Calls visit(cell, P(standing)) for the cells of a block in which beams ended.
  // odds_factor: by which the prior odds of the static classes differ from those of the weights.
  template <class Visit>
  void for_each_surface_in(const Block& block, float odds_factor, Visit&& visit) const {
    for (int i = 0; i < Map::kCells; ++i) {
      const CellValue& cell = block.values[static_cast<size_t>(i)];
      if (cell.filter < 0) continue;
      const auto p = filters_.posterior(cell.filter);
      const float scale = odds_factor / (odds_factor * p.p_static + 1.0f - p.p_static);
      visit(Map::cell_at(block.origin, i), p.p_standing * scale);
    }
  }

  size_t changed_count() const { return changed_.size(); }

  // The first `most` of the blocks that changed since they were taken last, in the order in which
  // they changed.
  std::vector<Cell<D>> take_changed_blocks(size_t most) {
    const auto end =
        changed_.begin() + static_cast<std::ptrdiff_t>(std::min(most, changed_.size()));
    std::vector<Cell<D>> out(changed_.begin(), end);
    changed_.erase(changed_.begin(), end);
    for (const Cell<D>& origin : out) is_changed_.erase(Map::key(origin));
    last_touched_ = nullptr;
    return out;
  }

 protected:
  // Calls visit(filter) for the end cell, and its neighbours with centres within the hit radius.
  template <class Visit>
  void for_each_filter_near(ConstCursor& cursor, const Vec<D>& end, Visit&& visit) const {
    const Cell<D> own = cell_of<D>(end);
    const double radius = filters_.options().hit_radius, limit = radius * radius;
    double squared[D][3];  // distance to the centres of the cells before, here and after
    Cell<D> low = own, high = own;
    for (int d = 0; d < D; ++d) {
      for (int k = 0; k < 3; ++k) {
        const double off = own[d] + k - 0.5 - end[d];
        squared[d][k] = off * off;
      }
      low[d] -= squared[d][0] <= limit;
      high[d] += squared[d][2] <= limit;
    }
    const auto visit_within = [&](const Block& block, const Cell<D>& cell) {
      double distance = 0.0;
      for (int d = 0; d < D; ++d) distance += squared[d][cell[d] - own[d] + 1];
      if (distance > limit && cell != own) return;
      const int32_t k = block.values[static_cast<size_t>(Map::local_of(cell))].filter;
      if (k >= 0) visit(k);
    };
    // block by block: each is looked up once
    for_each_in_box<D>(Map::block_of(low), Map::block_of(high), [&](const Cell<D>& origin) {
      const Cell<D> first = Map::cell_at(origin, 0), last = Map::cell_at(origin, Map::kCells - 1);
      const auto* block = cursor.block(first);
      if (!block) return;
      for_each_in_box<D>(low.cwiseMax(first), high.cwiseMin(last),
                         [&](const Cell<D>& cell) { visit_within(*block, cell); });
    });
  }

  // Where a cell lies after the motion (from the old map to the new one) of a scan.
  Cell<D> move_cell(const Cell<D>& cell, int32_t tag, const std::vector<Pose<D>>& motion) const {
    if (tag < 0 || static_cast<size_t>(tag) >= motion.size()) return cell;
    const Vec<D> centre = (cell.template cast<double>().array() + 0.5).matrix();
    const Pose<D>& T = motion[static_cast<size_t>(tag)];
    const Vec<D> moved = (T * Vec<D>(centre * resolution_)) / resolution_;
    if (!all_below<D>(moved, Map::kMaxCell))
      throw std::invalid_argument("motion: a cell would be too far away");
    return cell_of<D>(moved);
  }

  CellValue& cell_at_or_new(const Cell<D>& cell) {
    Block* block = find_or_add(Map::block_of(cell));
    return block->values[static_cast<size_t>(Map::local_of(cell))];
  }

  // Gives a cell the filter of one in another map, or adds its evidence.
  void take_over_filter(CellValue& at, const CellFilters& from, int32_t k) {
    if (at.filter < 0) {
      at.filter = filters_.copy(from, k);
    } else {
      filters_.merge(at.filter, from, k);
    }
  }

  // Every block that a beam touches counts as changed.
  Block* find_or_add(const Cell<D>& origin) {
    Block* block = Map::find_or_add(origin, CellValue{});
    if (block == last_touched_) return block;
    last_touched_ = block;
    note_changed(origin);
    return block;
  }

  void note_changed(const Cell<D>& origin) {
    if (is_changed_.insert(Map::key(origin)).second) changed_.push_back(origin);
  }

  double resolution_;
  CellFilters filters_;

 private:
  template <class Filters>
  float find_best(ConstCursor& cursor, const Vec<D>& end, float otherwise, Filters& filters) const {
    float best = -1.0f;
    for_each_filter_near(cursor, end,
                         [&](int32_t k) { best = std::max(best, filters.p_static(k)); });
    return best < 0.0f ? otherwise : best;
  }

  std::deque<Cell<D>> changed_;  // blocks
  std::unordered_set<uint64_t, typename Map::Hash> is_changed_;
  Block* last_touched_ = nullptr;
};

}  // namespace stillmap
