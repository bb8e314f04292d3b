// Beams without a return: which of them tell something, and up to where.
#pragma once

#include <utility>
#include <vector>

#include "stillmap/grid/cell_index.hpp"
#include "stillmap/occupancy/beam_counting.hpp"

namespace stillmap {

// A single beam without a return got lost, whatever stands there; several in a row may tell.
template <int D>
inline bool in_a_row(const Scans<D>& scans, size_t t, int64_t n) {
  constexpr int enough = 3;
  auto lost = [&](int64_t m) {
    return m >= scans.offset[t] && m < scans.offset[t + 1] && !scans.hit[m] &&
           usable<D>(scans.points + m * D);
  };
  int in_a_row = 1;
  for (int64_t m = n - 1; in_a_row < enough && lost(m); --m) ++in_a_row;
  for (int64_t m = n + 1; in_a_row < enough && lost(m); ++m) ++in_a_row;
  return in_a_row >= enough;
}

// How far beams without a return are believed.
template <int D>
struct NoReturn {
  const std::vector<Cell<D>>& stops;  // cells from which on they say nothing
  double beyond;                      // cells before their end from which on they say nothing
};

// Adds the lengths that beams without a return cover, as add_scans does: what they are believed
// about to one grid, the rest to another. Both together are the sums of (10), to the bit.
template <int D>
class LostBeams : private CellIndex<D> {
 public:
  explicit LostBeams(const NoReturn<D>& no_return) : beyond_(no_return.beyond) {
    for (const Cell<D>& cell : no_return.stops) this->place_of(cell) = 0;
  }

  void add(Grid<D>& grid, Grid<D>& rest, const Scans<D>& scans, size_t first, size_t last) const {
    Cursor<Grid<D>> believed_in(grid), not_in(rest);
    Way way(*this, [&](const Cell<D>& cell, double length, bool believed) {
      auto* block = (believed ? believed_in : not_in).block(cell);
      block->counts[static_cast<size_t>(Grid<D>::local_of(cell))].beta += to_fixed(length);
    });
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n]) return;
      const Segment<D> beam(pose, scans.points + n * D, grid.resolution());
      way.follow(beam, in_a_row(scans, t, n));
    });
  }

  // Walks along beams: visit(cell, length in it, whether it is believed in); a cell that is left
  // too late, or behind a stop, is not. Lone beams are not believed at all.
  template <class Visit>
  class Way {
   public:
    Way(const LostBeams& lost, Visit visit)
        : stops_(lost), beyond_(lost.beyond_), visit_(std::move(visit)) {}

    void follow(const Segment<D>& beam, bool in_a_row) {
      believed_ = in_a_row ? (beam.end - beam.start).norm() - beyond_ : 0.0;
      travelled_ = 0.0;
      traverse<D>(beam.start, beam.end, *this);
    }

    void start(const Cell<D>& first) { cell_ = first; }
    void visit(double length) {
      travelled_ += length;
      if (travelled_ > believed_ || stopped()) believed_ = 0.0;
      visit_(cell_, length, believed_ > 0.0);
    }
    template <int Axis>
    void step(int32_t direction) {
      cell_[Axis] += direction;
    }

   private:
    bool stopped() {
      const auto* block = stops_.block(cell_);
      return block &&
             block->counts[static_cast<size_t>(Grid<D>::local_of(cell_))] != CellIndex<D>::kNone;
    }

    Cursor<const CellIndex<D>> stops_;
    double beyond_;
    Visit visit_;
    Cell<D> cell_ = Cell<D>::Zero();
    double believed_ = 0.0, travelled_ = 0.0;
  };

 private:
  double beyond_;
};

template <int D>
inline void add_lost(Grid<D>& grid, Grid<D>& rest, const Scans<D>& scans,
                     const NoReturn<D>& no_return, int threads) {
  const LostBeams<D> lost(no_return);
  const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
  std::vector<Grid<D>> grids, rests;  // of the other threads
  for (size_t i = 2; i < bounds.size(); ++i) {
    grids.emplace_back(grid.resolution(), grid.approach());
    rests.emplace_back(rest.resolution(), rest.approach());
  }
  parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
    lost.add(i == 0 ? grid : grids[i - 1], i == 0 ? rest : rests[i - 1], scans, first, last);
  });
  for (const auto& other : grids) grid.merge(other);
  for (const auto& other : rests) rest.merge(other);
}

}  // namespace stillmap
