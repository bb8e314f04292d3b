// Causal E-step: a map whose cells have forward filters, updated scan by scan. What a cell says
// about a beam follows from earlier scans and this one only.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <limits>
#include <stdexcept>
#include <unordered_set>
#include <utility>
#include <vector>

#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/cell_filters.hpp"
#include "stillmap/occupancy/observation.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

// What is known of a cell in which no beam ended: in how many time bins beams passed.
struct PassedCell {
  int32_t filter = -1;    // index of the cell's filter; -1: no beam ended here
  int32_t last_bin = -1;  // in which a beam passed; -1: none did
  int32_t tag = -1;       // of the scan that passed last
  int32_t passed_bins = 0;
};

template <int D>
class OccupancyFilter : public BlockMap<D, PassedCell> {
 public:
  using Map = BlockMap<D, PassedCell>;
  using typename Map::Block;
  using ConstCursor = BlockCursor<const OccupancyFilter>;

  static constexpr size_t kMaxClasses = CellFilters::kMaxClasses;

  OccupancyFilter(double resolution, FilterOptions options)
      : resolution_(resolution), filters_(std::move(options)), tables_(lateral_std()) {}

  OccupancyFilter(OccupancyFilter&&) noexcept = default;
  OccupancyFilter& operator=(OccupancyFilter&&) noexcept = default;
  OccupancyFilter(const OccupancyFilter&) = delete;  // copies of large maps would be accidental
  OccupancyFilter& operator=(const OccupancyFilter&) = delete;

  double resolution() const { return resolution_; }
  size_t size() const { return filters_.size(); }
  size_t memory_bytes() const {
    return this->blocks().size() * (sizeof(Block) + 64) + filters_.memory_bytes();
  }

  // Adds the beams of one scan. margin: (M,) cells before the end of each beam that it has not
  // passed. tag: of the scan, for `take_over`.
  void add(const Scans<D>& scans, const float* margin, int64_t time_bin, int32_t tag) {
    if (time_bin < 0 || time_bin > std::numeric_limits<int32_t>::max())
      throw std::invalid_argument("time_bin: expected an index from 0 to 2^31 - 1");
    const auto bin = static_cast<int32_t>(time_bin);
    for_each_hit(scans, [&](const BeamSegment<D>& beam, int64_t n) {
      record_pass(beam, margin[n], bin, tag);
    });
    for_each_hit(scans, [&](const BeamSegment<D>& beam, int64_t) { add_filter(beam.end, tag); });
    ConstCursor cursor(*this);
    for_each_hit(scans, [&](const BeamSegment<D>& beam, int64_t) {
      for_each_filter_near(cursor, beam.end, [&](int32_t k) { filters_.hit(k, bin, tag); });
    });
  }

  // Initializes a cell from another map: occupied by static surface, or free.
  // log_ratio: nats by which dynamic classes fall behind.
  void prime(const Cell<D>& cell, bool is_occupied, double log_ratio) {
    PassedCell& at = cell_at_or_new(cell);
    if (!is_occupied) {
      at.passed_bins = std::max(at.passed_bins, CellFilters::kMaxPasses);
      return;
    }
    if (at.filter < 0) at.filter = filters_.add(at.passed_bins, at.last_bin, at.tag);
    filters_.favour_static(at.filter, log_ratio);
  }

  // P(static) of the cell in which a beam ended, or of the best one within the hit radius;
  // `otherwise` where no beam ended before. known: P(static) of each filter, negative where it has
  // not been computed yet: most beams of a scan end in the cells of others.
  float p_static_at(ConstCursor& cursor, const Vec<D>& end, float otherwise,
                    std::vector<float>& known) const {
    float best = -1.0f;
    for_each_filter_near(cursor, end, [&](int32_t k) {
      float& p = known[static_cast<size_t>(k)];
      if (p < 0.0f) p = filters_.posterior(k).p_static;
      best = std::max(best, p);
    });
    return best < 0.0f ? otherwise : best;
  }

  // Calls visit(cell, P(standing)) for the cells of a block in which beams ended.
  // odds_factor: by which the prior odds of the static classes differ from those of the weights.
  template <class Visit>
  void for_each_surface_in(const Block& block, float odds_factor, Visit&& visit) const {
    for (int i = 0; i < Map::kCells; ++i) {
      const PassedCell& cell = block.values[static_cast<size_t>(i)];
      if (cell.filter < 0) continue;
      const auto p = filters_.posterior(cell.filter);
      const float scale = odds_factor / (odds_factor * p.p_static + 1.0f - p.p_static);
      visit(Map::cell_at(block.origin, i), p.p_standing * scale);
    }
  }

  // The same for the cells that beams passed as well.
  template <class Visit>
  void for_each_known_in(const Block& block, float odds_factor, Visit&& visit) const {
    for_each_surface_in(block, odds_factor, visit);
    for (int i = 0; i < Map::kCells; ++i) {
      const PassedCell& cell = block.values[static_cast<size_t>(i)];
      if (cell.filter < 0 && cell.passed_bins > 0) visit(Map::cell_at(block.origin, i), 0.0f);
    }
  }

  // Whether beams ended in a block.
  bool has_surface(const Block& block) const {
    return std::any_of(block.values.begin(), block.values.end(),
                       [](const PassedCell& cell) { return cell.filter >= 0; });
  }

  // The blocks that changed since the last call, in the order in which they changed first.
  std::vector<Cell<D>> take_changed_blocks() {
    std::vector<Cell<D>> out;
    out.swap(changed_);
    is_changed_.clear();
    last_touched_ = nullptr;
    return out;
  }

  // Removes the blocks with free space only that are farther from a centre, in cells. Memory then
  // grows with the surface that was seen, not with the volume.
  void forget_free_space(const Vec<D>& centre, double radius) {
    last_touched_ = nullptr;
    const double limit = radius * radius;
    this->keep_if([&](const Cell<D>& origin) {
      const Vec<D> middle = (origin.template cast<double>().array() + 0.5) * Map::kEdge;
      if ((middle - centre).squaredNorm() <= limit) return true;
      return has_surface(*this->find(origin));
    });
  }

  // An empty filter of the same kind.
  OccupancyFilter sibling() const { return OccupancyFilter(resolution_, filters_.options()); }

  // Adds the cells of a part of the blocks of another filter, each moved by the motion (from the
  // old map to the new one) of the scan that observed it last. Cells that meet add their evidence.
  // Returns the number of the first block that is left.
  size_t take_over(const OccupancyFilter& from, const std::vector<Pose<D>>& motion, size_t first,
                   size_t count) {
    const size_t last =
        std::min(first + std::min(count, from.blocks().size()), from.blocks().size());
    for (size_t b = first; b < last; ++b) {
      const Block& block = *from.blocks()[b];
      for (int i = 0; i < Map::kCells; ++i)
        take_over_cell(from, block.values[static_cast<size_t>(i)], Map::cell_at(block.origin, i),
                       motion);
    }
    return last;
  }

 private:
  static constexpr float kMinReliability = 0.05f;

  double lateral_std() const { return filters_.options().lateral_std; }

  template <class Visit>
  void for_each_hit(const Scans<D>& scans, Visit&& visit) const {
    for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n]) visit(BeamSegment<D>(pose, scans.points + n * D, resolution_), n);
    });
  }

  void record_pass(const BeamSegment<D>& beam, float margin, int32_t bin, int32_t tag) {
    const Vec<D> chord = beam.end - beam.start;
    const double length = chord.norm(), usable = length - static_cast<double>(margin);
    if (!(usable > 0.0)) return;
    const Vec<D> direction = chord / length;
    const auto pass = [&](PassedCell* cell, const Cell<D>& at) {
      const Vec<D> off = (at.template cast<double>().array() + 0.5).matrix() - beam.start;
      const double along = off.dot(direction);
      const auto reliability =
          tables_.isotropic(static_cast<float>(std::max(off.squaredNorm() - along * along, 0.0)));
      if (reliability < kMinReliability) return;
      if (cell->filter >= 0) {
        filters_.miss(cell->filter, bin, reliability);
      } else if (reliability >= CellFilters::kClearlyPassed && cell->last_bin != bin) {
        ++cell->passed_bins;
        cell->last_bin = bin;
      }
      cell->tag = tag;
    };
    BlockCursor<OccupancyFilter> cursor(*this);
    RayWalker<OccupancyFilter, decltype(pass)> walker(cursor, pass);
    const Vec<D> last = beam.start + usable * direction;
    traverse<D>(beam.start, last, walker);
    walker.visit(0.0);
  }

  // The filter of the cell in which a beam ended.
  void add_filter(const Vec<D>& end, int32_t tag) {
    PassedCell& at = cell_at_or_new(cell_of<D>(end));
    if (at.filter < 0) at.filter = filters_.add(at.passed_bins, at.last_bin, tag);
    at.tag = tag;
  }

  // Calls visit(filter) for the end cell, and its neighbours with centres within the hit radius.
  template <class Visit>
  void for_each_filter_near(ConstCursor& cursor, const Vec<D>& end, Visit&& visit) const {
    const Cell<D> own = cell_of<D>(end);
    const double radius = filters_.options().hit_radius, limit = radius * radius;
    for_each_in_cube<D>(own, 1, [&](const Cell<D>& cell) {
      const Vec<D> centre = (cell.template cast<double>().array() + 0.5).matrix();
      if (cell != own && (centre - end).squaredNorm() > limit) return;
      const auto* block = cursor.block(cell);
      if (!block) return;
      const int32_t k = block->values[static_cast<size_t>(Map::local_of(cell))].filter;
      if (k >= 0) visit(k);
    });
  }

  void take_over_cell(const OccupancyFilter& from, const PassedCell& source, const Cell<D>& cell,
                      const std::vector<Pose<D>>& motion) {
    const bool has_filter = source.filter >= 0;
    if (!has_filter && source.passed_bins == 0) return;
    const int32_t tag = has_filter ? from.filters_.tag(source.filter) : source.tag;
    PassedCell& at = cell_at_or_new(move_cell(cell, tag, motion));
    at.last_bin = std::max(at.last_bin, source.last_bin);
    at.passed_bins = std::max(at.passed_bins, source.passed_bins);
    at.tag = std::max(at.tag, source.tag);
    if (!has_filter) return;
    if (at.filter < 0) {
      at.filter = filters_.copy(from.filters_, source.filter);
    } else {
      filters_.merge(at.filter, from.filters_, source.filter);
    }
  }

  Cell<D> move_cell(const Cell<D>& cell, int32_t tag, const std::vector<Pose<D>>& motion) const {
    if (tag < 0 || static_cast<size_t>(tag) >= motion.size()) return cell;
    const Vec<D> centre = (cell.template cast<double>().array() + 0.5).matrix();
    const Pose<D>& T = motion[static_cast<size_t>(tag)];
    const Vec<D> moved = (T * Vec<D>(centre * resolution_)) / resolution_;
    if (!all_below<D>(moved, Map::kMaxCell))
      throw std::invalid_argument("motion: a cell would be too far away");
    return cell_of<D>(moved);
  }

  PassedCell& cell_at_or_new(const Cell<D>& cell) {
    Block* block = find_or_add(Map::block_of(cell));
    return block->values[static_cast<size_t>(Map::local_of(cell))];
  }

  // Every block that a beam touches counts as changed.
  Block* find_or_add(const Cell<D>& origin) {
    Block* block = Map::find_or_add(origin, PassedCell{});
    if (block == last_touched_) return block;
    last_touched_ = block;
    if (is_changed_.insert(Map::key(origin)).second) changed_.push_back(origin);
    return block;
  }

  friend class BlockCursor<OccupancyFilter>;

  double resolution_;
  CellFilters filters_;
  IntersectionTables tables_;
  std::vector<Cell<D>> changed_;  // blocks
  std::unordered_set<uint64_t, typename Map::Hash> is_changed_;
  Block* last_touched_ = nullptr;
};

}  // namespace stillmap
