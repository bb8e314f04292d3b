// Beams without a return: which of them are evidence of free space, and up to which range.
#pragma once

#include <utility>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/cell_index.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// A single missing return is noise; a run of at least three neighbouring beams is evidence.
template <int D>
inline bool in_no_return_run(const Scans<D>& scans, size_t t, int64_t n) {
  constexpr int kMinRun = 3;
  auto is_no_return = [&](int64_t m) {
    return m >= scans.offset[t] && m < scans.offset[t + 1] && !scans.hit[m] &&
           usable<D>(scans.points + m * D);
  };
  int run = 1;
  for (int64_t m = n - 1; run < kMinRun && is_no_return(m); --m) ++run;
  for (int64_t m = n + 1; run < kMinRun && is_no_return(m); ++m) ++run;
  return run >= kMinRun;
}

// Range up to which beams without a return count as free space.
template <int D>
struct NoReturnLimits {
  const std::vector<Cell<D>>& stop_cells;  // beams count up to the first of these
  double end_margin;                       // cells before the end of a beam that do not count
};

// Adds the lengths travelled by beams without a return, as add_scans does: the trusted part to one
// grid, the rest to another; a part without a grid is left out. The two sum to (10), to the bit.
template <int D>
class NoReturnBeams : private CellIndex<D> {
 public:
  explicit NoReturnBeams(const NoReturnLimits<D>& limits) : end_margin_(limits.end_margin) {
    for (const Cell<D>& cell : limits.stop_cells) this->index_of(cell) = 0;
  }

  void add(OccupancyGrid<D>* grid, OccupancyGrid<D>* rest, const Scans<D>& scans, size_t first,
           size_t last) const {
    OccupancyGrid<D>& any = grid ? *grid : *rest;
    BlockCursor<OccupancyGrid<D>> trusted_cursor(any), rest_cursor(rest ? *rest : any);
    BeamWalk walk(*this, [&](const Cell<D>& cell, double length, bool trusted) {
      if (!(trusted ? grid : rest)) return;
      auto* block = (trusted ? trusted_cursor : rest_cursor).block(cell);
      block->values[static_cast<size_t>(BlockLayout<D>::local_of(cell))].beta += to_fixed(length);
    });
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n]) return;
      const BeamSegment<D> beam(pose, scans.points + n * D, any.resolution());
      walk.traverse_beam(beam, in_no_return_run(scans, t, n));
    });
  }

  // Traverses beams and calls visit(cell, chord length, trusted). A cell is not trusted if the beam
  // leaves it within end_margin of its end or after a stop cell; isolated beams are not trusted at
  // all.
  template <class Visit>
  class BeamWalk : public CellTracker<D> {
   public:
    BeamWalk(const NoReturnBeams& beams, Visit visit)
        : stop_cells_(beams), end_margin_(beams.end_margin_), visit_(std::move(visit)) {}

    void traverse_beam(const BeamSegment<D>& beam, bool in_run) {
      trusted_range_ = in_run ? (beam.end - beam.start).norm() - end_margin_ : 0.0;
      travelled_ = 0.0;
      traverse<D>(beam.start, beam.end, *this);
    }

    void visit(double length) {
      travelled_ += length;
      if (travelled_ > trusted_range_ || at_stop_cell()) trusted_range_ = 0.0;
      visit_(this->cell, length, trusted_range_ > 0.0);
    }

   private:
    bool at_stop_cell() {
      const auto* block = stop_cells_.block(this->cell);
      const auto local = static_cast<size_t>(BlockLayout<D>::local_of(this->cell));
      return block && block->values[local] != CellIndex<D>::kNone;
    }

    BlockCursor<const CellIndex<D>> stop_cells_;
    double end_margin_;
    Visit visit_;
    double trusted_range_ = 0.0, travelled_ = 0.0;
  };

 private:
  double end_margin_;
};

template <int D>
inline void add_no_return_beams(OccupancyGrid<D>* grid, OccupancyGrid<D>* rest,
                                const Scans<D>& scans, const NoReturnLimits<D>& limits,
                                int threads) {
  const NoReturnBeams<D> beams(limits);
  const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
  std::vector<OccupancyGrid<D>> thread_grids, thread_rests;  // of the other threads
  for (size_t i = 2; i < bounds.size(); ++i) {
    if (grid) thread_grids.push_back(grid->sibling());
    if (rest) thread_rests.push_back(rest->sibling());
  }
  parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
    const auto of_thread = [i](OccupancyGrid<D>* target, auto& others) {
      return i == 0 || !target ? target : &others[i - 1];
    };
    beams.add(of_thread(grid, thread_grids), of_thread(rest, thread_rests), scans, first, last);
  });
  for (const auto& other : thread_grids) grid->merge(other);
  for (const auto& other : thread_rests) rest->merge(other);
}

}  // namespace stillmap
