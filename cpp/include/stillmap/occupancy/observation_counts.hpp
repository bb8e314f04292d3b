// In how many looks a cell was looked at, and in how many of them nothing that moves was near: what
// was seen within a look tells no more than one glance, and where somebody stood at every glance
// nothing is known of the place itself.
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

#include "stillmap/grid/block_map.hpp"
#include "stillmap/occupancy/no_return_beams.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap {

// Of one cell. Looks are numbered from 1 as they come.
struct Glances {
  uint32_t seen = 0;       // the last look that saw it
  uint32_t disturbed = 0;  // the last look in which something that moves was near
  uint16_t looks = 0;      // these count no further than they can
  uint16_t clear = 0;
};

template <int D>
class LookCounts : public Blocks<D, Glances> {
 public:
  using Block = typename Blocks<D, Glances>::Block;
  static constexpr int kMaxReach = D == 2 ? 1024 : 128;  // cells

  // radius: metres around the end of a beam on something that moves within which a cell is not
  // clear, from the middle of the end cell to its own; lost: how far beams without a return are
  // believed, null: all of their way
  LookCounts(double resolution, double radius, std::shared_ptr<const LostBeams<D>> lost)
      : resolution_(resolution),
        radius_(radius),
        reach_(radius / resolution),
        lost_(std::move(lost)) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
    if (!(radius >= 0.0 && reach_ <= kMaxReach))
      throw std::invalid_argument("radius: expected metres that are not negative, and at most " +
                                  std::to_string(kMaxReach) + " cells");
  }

  LookCounts(LookCounts&&) noexcept = default;
  LookCounts& operator=(LookCounts&&) noexcept = default;
  LookCounts(const LookCounts&) = delete;
  LookCounts& operator=(const LookCounts&) = delete;

  double resolution() const { return resolution_; }
  double radius() const { return radius_; }

  Block* find_or_add(const Cell<D>& block) {
    return Blocks<D, Glances>::find_or_add(block, Glances{});
  }

  size_t memory_bytes() const { return this->blocks().size() * (sizeof(Block) + 64); }

  // dynamic (M,): which hits ended on something that moves. look (T,): number of each scan's look,
  // not falling, and all of them beyond those that were added before.
  void add(const Scans<D>& scans, const bool* dynamic, const int64_t* look, int threads) {
    if (scans.n_scans == 0) return;
    if (look[0] <= newest_) throw std::invalid_argument("look: was added to before, or falls");
    for (size_t t = 1; t < scans.n_scans; ++t)
      if (look[t] < look[t - 1]) throw std::invalid_argument("look: must not fall");
    auto bounds = shares_of(scans.offset, scans.n_scans, threads);
    for (size_t& t : bounds)  // no look is cut
      while (t > 0 && t < scans.n_scans && look[t] == look[t - 1]) ++t;
    std::vector<LookCounts> others;
    for (size_t i = 2; i < bounds.size(); ++i) others.emplace_back(resolution_, radius_, lost_);
    parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
      (i == 0 ? *this : others[i - 1]).add_share(scans, dynamic, look, first, last);
    });
    for (const auto& other : others) merge(other);
    newest_ = look[scans.n_scans - 1];
  }

 private:
  static constexpr uint16_t kMost = std::numeric_limits<uint16_t>::max();

  void add_share(const Scans<D>& scans, const bool* dynamic, const int64_t* look, size_t first,
                 size_t last) {
    Cursor<LookCounts> cursor(*this);
    for (size_t t = first; t < last;) {
      size_t end = t + 1;
      while (end < last && look[end] == look[t]) ++end;
      ++now_;
      disturb(cursor, scans, dynamic, t, end);
      glance(cursor, scans, t, end);
      t = end;
    }
  }

  // Marks the cells near the ends of beams on what moves.
  void disturb(Cursor<LookCounts>& cursor, const Scans<D>& scans, const bool* dynamic, size_t first,
               size_t last) {
    std::vector<Cell<D>> ends;
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n] && dynamic[n])
        ends.push_back(cell_of<D>(Segment<D>(pose, scans.points + n * D, resolution_).end));
    });
    const auto before = [](const Cell<D>& a, const Cell<D>& b) {
      return std::lexicographical_compare(a.data(), a.data() + D, b.data(), b.data() + D);
    };
    std::sort(ends.begin(), ends.end(), before);
    ends.erase(std::unique(ends.begin(), ends.end()), ends.end());
    const double farthest = reach_ * reach_ * (1.0 + 1e-9);  // whole numbers of cells are within
    for (const Cell<D>& end : ends)
      for_each_near<D>(end, static_cast<int>(reach_ + 1e-9), [&](const Cell<D>& cell) {
        if ((cell - end).template cast<double>().squaredNorm() <= farthest)
          at(cursor, cell).disturbed = now_;
      });
  }

  // Counts the cells that beams cross or end in, those that `add_scans` and `add_lost` add to.
  void glance(Cursor<LookCounts>& cursor, const Scans<D>& scans, size_t first, size_t last) {
    const auto tells = [](double length) { return to_fixed(length) != 0; };
    Walker walker(cursor, [&](Glances* g, double length) {
      if (g->seen != now_ && tells(length)) count(*g);
    });
    const auto believe = [&](const Cell<D>& cell, double length, bool believed) {
      if (believed && tells(length)) count(at(cursor, cell));
    };
    using Way = typename LostBeams<D>::template Way<decltype(believe)>;
    std::optional<Way> way;
    if (lost_) way.emplace(*lost_, believe);
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      const Segment<D> beam(pose, scans.points + n * D, resolution_);
      if (way && !scans.hit[n]) {
        way->follow(beam, in_a_row(scans, t, n));
        return;
      }
      traverse<D>(beam.start, beam.end, walker);
      if (scans.hit[n]) count(*walker.counts());
    });
  }

  static Glances& at(Cursor<LookCounts>& cursor, const Cell<D>& cell) {
    return cursor.block(cell)->counts[static_cast<size_t>(Grid<D>::local_of(cell))];
  }

  void count(Glances& cell) {
    if (cell.seen == now_) return;
    cell.seen = now_;
    cell.looks = sum(cell.looks, 1);
    if (cell.disturbed != now_) cell.clear = sum(cell.clear, 1);
  }

  static uint16_t sum(uint16_t a, uint16_t b) {
    return static_cast<uint16_t>(std::min<uint32_t>(uint32_t{a} + b, kMost));
  }

  // looks of their own alone
  void merge(const LookCounts& other) {
    for (const auto& theirs : other.blocks()) {
      Block* mine = find_or_add(theirs->origin);
      for (size_t i = 0; i < mine->counts.size(); ++i) {
        Glances& cell = mine->counts[i];
        cell.looks = sum(cell.looks, theirs->counts[i].looks);
        cell.clear = sum(cell.clear, theirs->counts[i].clear);
      }
    }
  }

  double resolution_;
  double radius_;
  double reach_;  // the same in cells
  std::shared_ptr<const LostBeams<D>> lost_;
  uint32_t now_ = 0;
  int64_t newest_ = std::numeric_limits<int64_t>::min();
};

}  // namespace stillmap
