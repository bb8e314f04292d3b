// Per cell, the number of time bins in which it was observed, and in which it was observed without
// a dynamic object nearby. Beams within a time bin count once, since they are correlated.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <string>
#include <utility>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/no_return_beams.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Counts of one cell. Time bins are numbered from 1 in order of arrival.
struct CellVisits {
  uint32_t last_seen = 0;       // last time bin that observed it
  uint32_t last_disturbed = 0;  // last time bin with a dynamic object nearby
  uint16_t observed = 0;        // saturates
  uint16_t clear = 0;
};

template <int D>
class ObservationCounts : public BlockMap<D, CellVisits> {
 public:
  using Block = typename BlockMap<D, CellVisits>::Block;
  static constexpr int kMaxRadiusCells = D == 2 ? 1024 : 128;

  // radius: metres between the centres of a cell and of the end cell of a dynamic beam within which
  // the cell is not clear; no_return: trusted range of beams without a return, null: all of it.
  ObservationCounts(double resolution, double radius,
                    std::shared_ptr<const NoReturnBeams<D>> no_return)
      : resolution_(resolution),
        radius_(radius),
        radius_cells_(radius / resolution),
        no_return_(std::move(no_return)) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
    if (!(radius >= 0.0 && radius_cells_ <= kMaxRadiusCells))
      throw std::invalid_argument("radius: expected metres that are not negative, and at most " +
                                  std::to_string(kMaxRadiusCells) + " cells");
  }

  ObservationCounts(ObservationCounts&&) noexcept = default;
  ObservationCounts& operator=(ObservationCounts&&) noexcept = default;
  ObservationCounts(const ObservationCounts&) = delete;
  ObservationCounts& operator=(const ObservationCounts&) = delete;

  double resolution() const { return resolution_; }
  double radius() const { return radius_; }

  Block* find_or_add(const Cell<D>& block) {
    return BlockMap<D, CellVisits>::find_or_add(block, CellVisits{});
  }

  // is_dynamic (M,): returns from moving objects. time_bin (T,): time bin of each scan,
  // non-decreasing and later than in previous calls.
  void add(const Scans<D>& scans, const bool* is_dynamic, const int64_t* time_bin, int threads) {
    if (scans.n_scans == 0) return;
    if (time_bin[0] <= last_time_bin_)
      throw std::invalid_argument("time_bin: must not fall, nor repeat in a later call");
    for (size_t t = 1; t < scans.n_scans; ++t)
      if (time_bin[t] < time_bin[t - 1]) throw std::invalid_argument("time_bin: must not fall");
    auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
    for (size_t& t : bounds)  // keep the scans of a time bin together
      while (t > 0 && t < scans.n_scans && time_bin[t] == time_bin[t - 1]) ++t;
    std::vector<ObservationCounts> thread_counts;
    for (size_t i = 2; i < bounds.size(); ++i)
      thread_counts.emplace_back(resolution_, radius_, no_return_);
    parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
      (i == 0 ? *this : thread_counts[i - 1]).add_range(scans, is_dynamic, time_bin, first, last);
    });
    for (const auto& other : thread_counts) merge(other);
    last_time_bin_ = time_bin[scans.n_scans - 1];
  }

 private:
  static constexpr uint16_t kMaxCount = std::numeric_limits<uint16_t>::max();

  void add_range(const Scans<D>& scans, const bool* is_dynamic, const int64_t* time_bin,
                 size_t first, size_t last) {
    BlockCursor<ObservationCounts> cursor(*this);
    for (size_t t = first; t < last;) {
      size_t end = t + 1;
      while (end < last && time_bin[end] == time_bin[t]) ++end;
      ++bin_;
      mark_dynamic(cursor, scans, is_dynamic, t, end);
      count_observed(cursor, scans, t, end);
      t = end;
    }
  }

  // Marks the cells near the end points of dynamic beams.
  void mark_dynamic(BlockCursor<ObservationCounts>& cursor, const Scans<D>& scans,
                    const bool* is_dynamic, size_t first, size_t last) {
    std::vector<Cell<D>> ends;
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n] && is_dynamic[n])
        ends.push_back(cell_of<D>(BeamSegment<D>(pose, scans.points + n * D, resolution_).end));
    });
    const auto less = [](const Cell<D>& a, const Cell<D>& b) {
      return std::lexicographical_compare(a.data(), a.data() + D, b.data(), b.data() + D);
    };
    std::sort(ends.begin(), ends.end(), less);
    ends.erase(std::unique(ends.begin(), ends.end()), ends.end());
    // the tolerance includes cells at exactly the radius
    const double max_squared = radius_cells_ * radius_cells_ * (1.0 + 1e-9);
    for (const Cell<D>& end : ends)
      for_each_in_cube<D>(end, static_cast<int>(radius_cells_ + 1e-9), [&](const Cell<D>& cell) {
        if ((cell - end).template cast<double>().squaredNorm() <= max_squared)
          visits_at(cursor, cell).last_disturbed = bin_;
      });
  }

  // Counts the cells that beams cross or end in, those that add_scans and add_no_return_beams
  // update.
  void count_observed(BlockCursor<ObservationCounts>& cursor, const Scans<D>& scans, size_t first,
                      size_t last) {
    const auto is_nonzero = [](double length) { return to_fixed(length) != 0; };
    RayWalker walker(cursor, [&](CellVisits* visits, double length) {
      if (visits->last_seen != bin_ && is_nonzero(length)) count(*visits);
    });
    const auto count_if_trusted = [&](const Cell<D>& cell, double length, bool trusted) {
      if (trusted && is_nonzero(length)) count(visits_at(cursor, cell));
    };
    using BeamWalk = typename NoReturnBeams<D>::template BeamWalk<decltype(count_if_trusted)>;
    std::optional<BeamWalk> walk;
    if (no_return_) walk.emplace(*no_return_, count_if_trusted);
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      const BeamSegment<D> beam(pose, scans.points + n * D, resolution_);
      if (walk && !scans.hit[n]) {
        walk->traverse_beam(beam, in_no_return_run(scans, t, n));
        return;
      }
      traverse<D>(beam.start, beam.end, walker);
      if (scans.hit[n]) count(*walker.value());
    });
  }

  static CellVisits& visits_at(BlockCursor<ObservationCounts>& cursor, const Cell<D>& cell) {
    return cursor.block(cell)->values[static_cast<size_t>(BlockLayout<D>::local_of(cell))];
  }

  void count(CellVisits& cell) {
    if (cell.last_seen == bin_) return;
    cell.last_seen = bin_;
    cell.observed = saturating_add(cell.observed, 1);
    if (cell.last_disturbed != bin_) cell.clear = saturating_add(cell.clear, 1);
  }

  static uint16_t saturating_add(uint16_t a, uint16_t b) {
    return static_cast<uint16_t>(std::min<uint32_t>(uint32_t{a} + b, kMaxCount));
  }

  // Adds the counts of disjoint time bins.
  void merge(const ObservationCounts& other) {
    for (const auto& source : other.blocks()) {
      Block* target = find_or_add(source->origin);
      for (size_t i = 0; i < target->values.size(); ++i) {
        CellVisits& cell = target->values[i];
        cell.observed = saturating_add(cell.observed, source->values[i].observed);
        cell.clear = saturating_add(cell.clear, source->values[i].clear);
      }
    }
  }

  double resolution_;
  double radius_;
  double radius_cells_;  // radius in cells
  std::shared_ptr<const NoReturnBeams<D>> no_return_;
  uint32_t bin_ = 0;
  int64_t last_time_bin_ = std::numeric_limits<int64_t>::min();
};

}  // namespace stillmap
