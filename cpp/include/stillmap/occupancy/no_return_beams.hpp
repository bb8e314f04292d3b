// Beams without a return: which of them tell something, and up to where.
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

// A single beam without a return got lost, whatever stands there; several in a row may tell.
template <int D>
inline bool has_no_return_neighbours(const Scans<D>& scans, size_t t, int64_t n) {
  constexpr int kMinRun = 3;
  auto is_no_return = [&](int64_t m) {
    return m >= scans.offset[t] && m < scans.offset[t + 1] && !scans.hit[m] &&
           usable<D>(scans.points + m * D);
  };
  int has_no_return_neighbours = 1;
  for (int64_t m = n - 1; has_no_return_neighbours < kMinRun && is_no_return(m); --m)
    ++has_no_return_neighbours;
  for (int64_t m = n + 1; has_no_return_neighbours < kMinRun && is_no_return(m); ++m)
    ++has_no_return_neighbours;
  return has_no_return_neighbours >= kMinRun;
}

// How far beams without a return are believed.
template <int D>
struct NoReturnLimits {
  const std::vector<Cell<D>>& stop_cells;  // cells from which on they say nothing
  double end_margin;                       // cells before their end from which on they say nothing
};

// Adds the lengths that beams without a return cover, as add_scans does: what they are believed
// about to one grid, the rest to another. Both together are the sums of (10), to the bit.
template <int D>
class NoReturnBeams : private CellIndex<D> {
 public:
  explicit NoReturnBeams(const NoReturnLimits<D>& no_return) : end_margin_(no_return.end_margin) {
    for (const Cell<D>& cell : no_return.stop_cells) this->index_of(cell) = 0;
  }

  void add(OccupancyGrid<D>& grid, OccupancyGrid<D>& rest, const Scans<D>& scans, size_t first,
           size_t last) const {
    BlockCursor<OccupancyGrid<D>> trusted_cursor(grid), rest_cursor(rest);
    BeamWalk walk(*this, [&](const Cell<D>& cell, double length, bool trusted) {
      auto* block = (trusted ? trusted_cursor : rest_cursor).block(cell);
      block->values[static_cast<size_t>(BlockLayout<D>::local_of(cell))].beta += to_fixed(length);
    });
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n]) return;
      const BeamSegment<D> beam(pose, scans.points + n * D, grid.resolution());
      walk.traverse_beam(beam, has_no_return_neighbours(scans, t, n));
    });
  }

  // Walks along beams: visit(cell, length in it, whether it is believed in); a cell that is left
  // too late, or behind a stop, is not. Lone beams are not believed at all.
  template <class Visit>
  class BeamWalk {
   public:
    BeamWalk(const NoReturnBeams& is_no_return, Visit visit)
        : stops_(is_no_return), end_margin_(is_no_return.end_margin_), visit_(std::move(visit)) {}

    void traverse_beam(const BeamSegment<D>& beam, bool has_no_return_neighbours) {
      trusted_ = has_no_return_neighbours ? (beam.end - beam.start).norm() - end_margin_ : 0.0;
      travelled_ = 0.0;
      traverse<D>(beam.start, beam.end, *this);
    }

    void start(const Cell<D>& first) { cell_ = first; }
    void visit(double length) {
      travelled_ += length;
      if (travelled_ > trusted_ || at_stop_cell()) trusted_ = 0.0;
      visit_(cell_, length, trusted_ > 0.0);
    }
    template <int Axis>
    void step(int32_t direction) {
      cell_[Axis] += direction;
    }

   private:
    bool at_stop_cell() {
      const auto* block = stops_.block(cell_);
      return block && block->values[static_cast<size_t>(BlockLayout<D>::local_of(cell_))] !=
                          CellIndex<D>::kNone;
    }

    BlockCursor<const CellIndex<D>> stops_;
    double end_margin_;
    Visit visit_;
    Cell<D> cell_ = Cell<D>::Zero();
    double trusted_ = 0.0, travelled_ = 0.0;
  };

 private:
  double end_margin_;
};

template <int D>
inline void add_no_return_beams(OccupancyGrid<D>& grid, OccupancyGrid<D>& rest,
                                const Scans<D>& scans, const NoReturnLimits<D>& no_return,
                                int threads) {
  const NoReturnBeams<D> is_no_return(no_return);
  const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
  std::vector<OccupancyGrid<D>> thread_grids, thread_rests;  // of the other threads
  for (size_t i = 2; i < bounds.size(); ++i) {
    thread_grids.emplace_back(grid.resolution(), grid.approach());
    thread_rests.emplace_back(rest.resolution(), rest.approach());
  }
  parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
    is_no_return.add(i == 0 ? grid : thread_grids[i - 1], i == 0 ? rest : thread_rests[i - 1],
                     scans, first, last);
  });
  for (const auto& other : thread_grids) grid.merge(other);
  for (const auto& other : thread_rests) rest.merge(other);
}

}  // namespace stillmap
