// Causal E-step: the forward filters of a bank of two-state hidden Markov models in every cell,
// updated scan by scan. What a cell says about a beam follows from earlier scans and this one only.
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
#include "stillmap/occupancy/observation.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

struct FilterOptions {
  std::vector<double> rho;      // stationary probability of being occupied, in (0, 1)
  std::vector<double> tau;      // seconds, correlation time
  std::vector<double> weights;  // prior probability of each class
  size_t n_static;              // the first classes are static
  double p_detection;           // P(return | occupied)
  double bin_seconds;           // length of a time bin
  double lateral_std;           // cells, standard deviation of a beam's lateral position
  double hit_radius;            // cells, a hit counts for cells whose centre is within it as well
  double max_log_ratio;         // nats by which a class may fall behind the best one
};

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

  static constexpr size_t kMaxClasses = 32;

  OccupancyFilter(double resolution, FilterOptions options)
      : resolution_(resolution), options_(std::move(options)), tables_(options_.lateral_std) {
    for (size_t c = 0; c < classes(); ++c) {
      rho_.push_back(static_cast<float>(options_.rho[c]));
      log_weight_.push_back(static_cast<float>(std::log(options_.weights[c])));
      for (int gap = 0; gap < kTabulatedGaps; ++gap) persistence_.push_back(persistence(c, gap));
    }
  }

  OccupancyFilter(OccupancyFilter&&) noexcept = default;
  OccupancyFilter& operator=(OccupancyFilter&&) noexcept = default;
  OccupancyFilter(const OccupancyFilter&) = delete;  // copies of large maps would be accidental
  OccupancyFilter& operator=(const OccupancyFilter&) = delete;

  double resolution() const { return resolution_; }
  size_t classes() const { return options_.rho.size(); }
  size_t size() const { return filters_.size(); }
  size_t memory_bytes() const {
    return this->blocks().size() * (sizeof(Block) + 64) + filters_.capacity() * sizeof(Filter) +
           state_.capacity() * sizeof(float);
  }

  // Adds the beams of one scan. margin: (M,) cells before the end of each beam that it has not
  // passed. tag: of the scan, for `take_over`.
  void add(const Scans<D>& scans, const float* margin, int64_t time_bin, int32_t tag) {
    if (time_bin < 0 || time_bin > std::numeric_limits<int32_t>::max())
      throw std::invalid_argument("time_bin: expected an index from 0 to 2^31 - 1");
    const auto bin = static_cast<int32_t>(time_bin);
    for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n]) record_pass(segment(scans, n, pose), margin[n], bin, tag);
    });
    for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n]) record_hit(segment(scans, n, pose).end, bin, tag);
    });
  }

  // Initializes a cell from another map: occupied by static surface, or free.
  // log_ratio: nats by which dynamic classes fall behind.
  void prime(const Cell<D>& cell, bool is_occupied, double log_ratio) {
    Block* block = find_or_add(Map::block_of(cell));
    PassedCell& at = block->values[static_cast<size_t>(Map::local_of(cell))];
    if (!is_occupied) {
      at.passed_bins = std::max(at.passed_bins, kMaxPasses);
      return;
    }
    if (at.filter < 0) at.filter = make_filter(cell, at, at.tag);
    float* log_likelihood = state_.data() + (static_cast<size_t>(at.filter) * 2 + 1) * classes();
    for (size_t c = 0; c < classes(); ++c)
      if (c >= options_.n_static) log_likelihood[c] -= static_cast<float>(log_ratio);
    normalize(log_likelihood);
  }

  // P(static) of the cell in which a beam ended, or of the best one within the hit radius;
  // `otherwise` where no beam ended before. known: P(static) of each filter, negative where it has
  // not been computed yet: most beams of a scan end in the cells of others.
  float p_static_at(const Vec<D>& end, float otherwise, std::vector<float>& known) const {
    float best = -1.0f;
    for_each_filter_near(end, [&](int32_t k) {
      float& p = known[static_cast<size_t>(k)];
      if (p < 0.0f) p = posterior(k).p_static;
      best = std::max(best, p);
    });
    return best < 0.0f ? otherwise : best;
  }

  struct Posterior {
    float p_static;    // of the static classes
    float p_standing;  // of the static classes, occupied now
  };

  // With the observation of the open time bin.
  Posterior posterior(int32_t k) const {
    const Filter& filter = filters_[static_cast<size_t>(k)];
    const float* state = state_.data() + static_cast<size_t>(k) * 2 * classes();
    float best = -std::numeric_limits<float>::infinity();
    float log_joint[kMaxClasses], p_occupied[kMaxClasses];
    for (size_t c = 0; c < classes(); ++c) {
      float p = state[c], log_likelihood = state[classes() + c];
      if (filter.has_open_bin()) step(c, filter, p, log_likelihood);
      log_joint[c] = log_likelihood + log_weight_[c];
      p_occupied[c] = p;
      best = std::max(best, log_joint[c]);
    }
    float total = 0.0f, fixed = 0.0f, standing = 0.0f;
    for (size_t c = 0; c < classes(); ++c) {
      const float joint = std::exp(log_joint[c] - best);
      total += joint;
      if (c >= options_.n_static) continue;
      fixed += joint;
      standing += joint * p_occupied[c];
    }
    return {fixed / total, standing / total};
  }

  // Calls visit(cell, P(standing)) for the cells of a block that beams passed or ended in.
  // odds_factor: by which the prior odds of the static classes differ from those of the weights.
  template <class Visit>
  void for_each_known_in(const Block& block, float odds_factor, Visit&& visit) const {
    for (int i = 0; i < Map::kCells; ++i) {
      const PassedCell& cell = block.values[static_cast<size_t>(i)];
      if (cell.filter >= 0) {
        const Posterior p = posterior(cell.filter);
        const float scale = odds_factor / (odds_factor * p.p_static + 1.0f - p.p_static);
        visit(Map::cell_at(block.origin, i), p.p_standing * scale);
      } else if (cell.passed_bins > 0) {
        visit(Map::cell_at(block.origin, i), 0.0f);
      }
    }
  }

  // The blocks that changed since the last call, in the order in which they changed first.
  std::vector<Cell<D>> take_changed_blocks() {
    std::vector<Cell<D>> out;
    out.swap(changed_);
    is_changed_.clear();
    last_touched_ = nullptr;
    return out;
  }

  // An empty filter of the same kind.
  OccupancyFilter sibling() const { return OccupancyFilter(resolution_, options_); }

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
  static constexpr int kTabulatedGaps = 64;
  static constexpr int32_t kNoBin = -1;
  static constexpr float kHitMark = -1.0f, kMinReliability = 0.05f, kClearlyPassed = 0.5f;
  static constexpr float kMinProbability = 1e-6f;  // floor: no state becomes impossible
  static constexpr int kMaxPasses = 32;            // that a new filter takes account of

  struct Filter {
    Cell<D> cell;
    int32_t tag;
    int32_t open_bin = kNoBin, last_bin = kNoBin;  // being observed; of the last observation before
    float p_missed = 1.0f;  // P(all beams of the open bin missed the surface); kHitMark: a hit

    bool has_open_bin() const { return open_bin != kNoBin; }
  };

  BeamSegment<D> segment(const Scans<D>& scans, int64_t n, const Pose<D>& pose) const {
    return BeamSegment<D>(pose, scans.points + n * D, resolution_);
  }

  float persistence(size_t c, int64_t gap) const {
    return static_cast<float>(
        std::exp(-static_cast<double>(gap) * options_.bin_seconds / options_.tau[c]));
  }

  // Forward step of one class: the observation of the open bin.
  void step(size_t c, const Filter& filter, float& p, float& log_likelihood) const {
    const int64_t gap = filter.last_bin == kNoBin ? 0 : int64_t{filter.open_bin} - filter.last_bin;
    const bool is_hit = filter.p_missed == kHitMark;
    step(c, gap, is_hit, is_hit ? 1.0f : 1.0f - filter.p_missed, p, log_likelihood);
  }

  void step(size_t c, int64_t gap, bool is_hit, float reliability, float& p,
            float& log_likelihood) const {
    const float kept = gap < kTabulatedGaps
                           ? persistence_[c * kTabulatedGaps + static_cast<size_t>(gap)]
                           : persistence(c, gap);
    p = rho_[c] + kept * (p - rho_[c]);
    const auto detection = static_cast<float>(options_.p_detection);
    if (is_hit) {
      log_likelihood += std::log(std::max(p * detection, kMinProbability));
      p = 1.0f;
      return;
    }
    const float missed = p * (1.0f - detection * reliability);
    const float total = missed + 1.0f - p;
    log_likelihood += std::log(total);
    p = std::max(missed / total, kMinProbability);
  }

  // Applies the observation of the open bin, if there is one, and opens another.
  void open(int32_t k, int32_t bin) {
    Filter& filter = filters_[static_cast<size_t>(k)];
    if (filter.open_bin == bin) return;
    if (filter.has_open_bin()) {
      float* state = state_.data() + static_cast<size_t>(k) * 2 * classes();
      for (size_t c = 0; c < classes(); ++c) step(c, filter, state[c], state[classes() + c]);
      normalize(state + classes());
      filter.last_bin = filter.open_bin;
    }
    // scans may come late: a bin before the last one has no gap
    filter.open_bin = std::max(bin, filter.last_bin);
    filter.p_missed = 1.0f;
  }

  // Relative to the best class, which others fall behind by a bounded ratio: so what stood for
  // hours is soon known to be gone.
  void normalize(float* log_likelihood) const {
    const float best = *std::max_element(log_likelihood, log_likelihood + classes());
    const auto least = static_cast<float>(-options_.max_log_ratio);
    for (size_t c = 0; c < classes(); ++c)
      log_likelihood[c] = std::max(log_likelihood[c] - best, least);
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
        miss(cell->filter, bin, reliability);
      } else if (reliability >= kClearlyPassed && cell->last_bin != bin) {
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

  void miss(int32_t k, int32_t bin, float reliability) {
    open(k, bin);
    Filter& filter = filters_[static_cast<size_t>(k)];
    if (filter.p_missed != kHitMark) filter.p_missed *= 1.0f - reliability;
  }

  void record_hit(const Vec<D>& end, int32_t bin, int32_t tag) {
    const Cell<D> cell = cell_of<D>(end);
    Block* block = find_or_add(Map::block_of(cell));
    PassedCell& at = block->values[static_cast<size_t>(Map::local_of(cell))];
    if (at.filter < 0) at.filter = make_filter(cell, at, tag);
    at.tag = tag;
    for_each_filter_near(end, [&](int32_t k) {
      open(k, bin);
      filters_[static_cast<size_t>(k)].p_missed = kHitMark;
      filters_[static_cast<size_t>(k)].tag = tag;
    });
  }

  // A filter after the passes of a cell in which no beam ended so far. Likelihoods are relative to
  // that of a first hit, as only cells with hits are considered.
  int32_t make_filter(const Cell<D>& cell, const PassedCell& at, int32_t tag) {
    Filter filter;
    filter.cell = cell;
    filter.tag = tag;
    filter.last_bin = at.last_bin;
    filters_.push_back(filter);
    for (size_t c = 0; c < classes(); ++c) state_.push_back(rho_[c]);
    for (size_t c = 0; c < classes(); ++c)
      state_.push_back(-std::log(rho_[c] * static_cast<float>(options_.p_detection)));
    float* state = state_.data() + (filters_.size() - 1) * 2 * classes();
    for (int pass = 0; pass < std::min(at.passed_bins, kMaxPasses); ++pass)
      for (size_t c = 0; c < classes(); ++c)
        step(c, pass ? 1 : 0, false, kClearlyPassed, state[c], state[classes() + c]);
    normalize(state + classes());
    return static_cast<int32_t>(filters_.size() - 1);
  }

  // Calls visit(filter) for the end cell, and its neighbours with centres within the hit radius.
  template <class Visit>
  void for_each_filter_near(const Vec<D>& end, Visit&& visit) const {
    const Cell<D> own = cell_of<D>(end);
    BlockCursor<const OccupancyFilter> cursor(*this);
    const double limit = options_.hit_radius * options_.hit_radius;
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
    const int32_t tag =
        has_filter ? from.filters_[static_cast<size_t>(source.filter)].tag : source.tag;
    const Cell<D> to = move_cell(cell, tag, motion);
    PassedCell& at = find_or_add(Map::block_of(to))->values[static_cast<size_t>(Map::local_of(to))];
    at.last_bin = std::max(at.last_bin, source.last_bin);
    at.passed_bins = std::max(at.passed_bins, source.passed_bins);
    at.tag = std::max(at.tag, source.tag);
    if (has_filter) add_evidence(from, source.filter, to, at);
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

  void add_evidence(const OccupancyFilter& from, int32_t k, const Cell<D>& to, PassedCell& at) {
    const size_t n = classes();
    const Filter& source = from.filters_[static_cast<size_t>(k)];
    const float* theirs = from.state_.data() + static_cast<size_t>(k) * 2 * n;
    if (at.filter < 0) {
      at.filter = static_cast<int32_t>(filters_.size());
      filters_.push_back(source);
      filters_.back().cell = to;
      state_.insert(state_.end(), theirs, theirs + 2 * n);
      return;
    }
    Filter& filter = filters_[static_cast<size_t>(at.filter)];
    float* ours = state_.data() + static_cast<size_t>(at.filter) * 2 * n;
    const bool is_newer = source.tag >= filter.tag;
    for (size_t c = 0; c < n; ++c) {
      if (is_newer) ours[c] = theirs[c];
      ours[n + c] += theirs[n + c];
    }
    normalize(ours + n);
    if (!is_newer) return;
    const Cell<D> cell = filter.cell;
    filter = source;
    filter.cell = cell;
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
  FilterOptions options_;
  IntersectionTables tables_;
  std::vector<float> rho_, log_weight_, persistence_;
  std::vector<Filter> filters_;
  std::vector<float> state_;      // (filters, 2, classes): P(occupied), log likelihood
  std::vector<Cell<D>> changed_;  // blocks
  std::unordered_set<uint64_t, typename Map::Hash> is_changed_;
  Block* last_touched_ = nullptr;
};

}  // namespace stillmap
