// Map M-step (10), E-step (8) and expected log likelihood (5), (7) of Haehnel et al. 2003.
#pragma once

#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Sums the lengths on the approach to an end point, without the end cell.
template <int D>
class ApproachAccumulator : public CellTracker<D> {
 public:
  ApproachAccumulator(OccupancyGrid<D>& grid, Fixed sign)
      : cursor_(grid), cells_(grid.approach() / grid.resolution()), sign_(sign) {}

  void add(const BeamSegment<D>& beam) {
    if (cells_ <= 0.0) return;
    const Vec<D> back = beam.start - beam.end;
    const double length = back.norm();
    const Vec<D> start = length > cells_ ? beam.end + back * (cells_ / length) : beam.start;
    traverse<D>(start, beam.end, *this);
  }

  void visit(double length) {
    auto& moments = OccupancyGrid<D>::moments_of(*cursor_.block(this->cell));
    const auto local = static_cast<size_t>(BlockLayout<D>::local_of(this->cell));
    moments[local][D] += sign_ * to_fixed(length);
  }

 private:
  BlockCursor<OccupancyGrid<D>> cursor_;
  double cells_;
  Fixed sign_;
};

// Adds a return with P(static) = p_static to its end cell.
template <int D>
inline void add_end_point(typename OccupancyGrid<D>::Block& block, const Cell<D>& cell,
                          const Vec<D>& end, double p_static, Fixed sign, bool with_moments) {
  const auto local = static_cast<size_t>(BlockLayout<D>::local_of(cell));
  block.values[local].alpha += sign * to_fixed(p_static);       // alpha_j
  block.values[local].beta += sign * to_fixed(1.0 - p_static);  // first sum of beta_j
  if (!with_moments) return;
  auto& moment = OccupancyGrid<D>::moments_of(block)[local];
  for (int d = 0; d < D; ++d)
    moment[static_cast<size_t>(d)] += sign * to_fixed(p_static * (end[d] - cell[d]));
}

// Adds alpha_j and beta_j of (10) for the scans [first, last). With sign -1 it removes scans that
// were added before, exactly, since sums are integers. hits_only: without beams without a return.
template <int D>
inline void add_scans(OccupancyGrid<D>& grid, const Scans<D>& scans, const float* e, Fixed sign,
                      size_t first, size_t last, bool hits_only = false) {
  BlockCursor<OccupancyGrid<D>> cursor(grid);
  // second sum of beta_j: chord length of the beam in j, independent of e
  RayWalker walker(cursor,
                   [=](CellCounts* j, double length) { j->beta += sign * to_fixed(length); });
  ApproachAccumulator<D> approach(grid, sign);
  for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
    if (hits_only && !scans.hit[n]) return;
    const BeamSegment<D> beam(pose, scans.points + n * D, grid.resolution());
    traverse<D>(beam.start, beam.end, walker);
    if (!scans.hit[n])
      return;  // (1 - zeta) = 0: the end cell of a maximum-range beam is not observed
    approach.add(beam);
    add_end_point<D>(*walker.block(), walker.cell(), beam.end, checked_probability(e[n]), sign,
                     grid.with_moments());
  });
}

// Adds the part of the sums that depends on e: that of the end cells.
template <int D>
inline void add_end_points(OccupancyGrid<D>& grid, const Scans<D>& scans, const float* e,
                           Fixed sign) {
  BlockCursor<OccupancyGrid<D>> cursor(grid);
  for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t, int64_t n, const Pose<D>& pose) {
    if (!scans.hit[n]) return;
    const BeamSegment<D> beam(pose, scans.points + n * D, grid.resolution());
    const Cell<D> end = cell_of<D>(beam.end);
    add_end_point<D>(*cursor.block(end), end, beam.end, checked_probability(e[n]), sign,
                     grid.with_moments());
  });
}

template <int D>
inline void add_beams(OccupancyGrid<D>& grid, const Scans<D>& scans, const float* e, Fixed sign,
                      int threads, bool hits_only) {
  const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
  std::vector<OccupancyGrid<D>> others;
  for (size_t i = 2; i < bounds.size(); ++i) others.push_back(grid.sibling());
  parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
    add_scans<D>(i == 0 ? grid : others[i - 1], scans, e, sign, first, last, hits_only);
  });
  for (const auto& other : others) grid.merge(other);
}

// E-step (8): P(static | return in a cell of occupancy m).
inline double static_responsibility(double prior, double m) {
  const double hit = prior * m;
  const double total = hit + (1.0 - prior) * (1.0 - m);
  return total > 0.0 ? hit / total : prior;
}

// E-step (6), (8) for all beams: NaN if unusable, the prior at maximum range and where the end cell
// is unobserved.
template <int D>
inline void e_step(const OccupancyGrid<D>& grid, const Scans<D>& scans, double prior, int threads,
                   float* e) {
  std::fill(e + scans.offset[0], e + scans.offset[scans.n_scans],
            std::numeric_limits<float>::quiet_NaN());
  const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
  parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
    BlockCursor<const OccupancyGrid<D>> cursor(grid);
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      e[n] = static_cast<float>(prior);
      if (!scans.hit[n]) return;
      const BeamSegment<D> beam(pose, scans.points + n * D, grid.resolution());
      if (const CellCounts* c = cursor.find_observed(cell_of<D>(beam.end)))
        e[n] = static_cast<float>(static_responsibility(prior, occupancy(*c)));
    });
  });
}

// Terms of the expected log likelihood of one scan.
struct LogLikelihoodTerms {
  double end = 0.0;        // (5), first two rows
  double traversed = 0.0;  // (5), last row, weighted by the lengths l_j
  double gamma = 0.0;      // (7)
  double entropy = 0.0;    // entropy of e: added to the others it gives the lower bound of EM
};

// ln with a floor, so that one impossible beam has a finite cost
inline double safe_log(double p) { return std::log(p > 1e-12 ? p : 1e-12); }
inline double x_log_p(double x, double p) { return x > 0.0 ? x * safe_log(p) : 0.0; }

// (5) and (7) per scan; with e in {0, 1} this is (4). Unobserved cells contribute nothing.
template <int D>
inline void log_likelihood(const OccupancyGrid<D>& grid, const Scans<D>& scans, const float* e,
                           double prior, int threads, LogLikelihoodTerms* terms) {
  const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
  parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
    BlockCursor<const OccupancyGrid<D>> cursor(grid);
    double traversed = 0.0;
    RayWalker walker(cursor, [&](const CellCounts* j, double length) {
      if (j && j->alpha > 0) traversed += length * safe_log(1.0 - occupancy(*j));
    });
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      LogLikelihoodTerms& sum = terms[t];
      const double en = checked_probability(e[n]);
      sum.gamma += x_log_p(en, prior) + x_log_p(1.0 - en, 1.0 - prior);
      sum.entropy -= x_log_p(en, en) + x_log_p(1.0 - en, 1.0 - en);
      const BeamSegment<D> beam(pose, scans.points + n * D, grid.resolution());
      traversed = 0.0;
      traverse<D>(beam.start, beam.end, walker);
      sum.traversed += traversed;
      const CellCounts* c = walker.value();
      if (!scans.hit[n] || !c || c->alpha + c->beta == 0) return;
      const double m = occupancy(*c);
      sum.end += x_log_p(en, m) + x_log_p(1.0 - en, 1.0 - m);
    });
  });
}

}  // namespace stillmap
