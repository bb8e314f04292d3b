// The sums of (10), the E-step (8), the likelihood (1), (5).
#pragma once

#include <array>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <string>
#include <vector>

#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// T scans of beams as flat arrays; nothing is owned.
template <int D>
struct Scans {
  const float* points;    // (M, D), sensor frame; NaN: unusable
  const bool* hit;        // (M,), false: maximum range (zeta = 1) or unusable
  const int64_t* offset;  // (T + 1,), relative to points
  const double* poses;    // (T, D + 1, D + 1), T_map_sensor
  size_t n_scans;
};

template <int D>
inline bool usable(const float* point) {
  for (int d = 0; d < D; ++d)
    if (!std::isfinite(point[d])) return false;
  return true;
}

template <int D>
inline Vec<D> point_at(const float* p) {
  return Eigen::Map<const Eigen::Matrix<float, D, 1>>(p).template cast<double>();
}

// One beam in units of cells; refuses coordinates whose cells cannot be counted.
template <int D>
struct Segment {
  Vec<D> start, end;

  Segment(const Pose<D>& T_map_sensor, const float* point, double resolution)
      : start(T_map_sensor.t / resolution), end((T_map_sensor * point_at<D>(point)) / resolution) {
    if (!all_below<D>(start, Grid<D>::kMaxCell) || !all_below<D>(end, Grid<D>::kMaxCell))
      throw std::invalid_argument("beam: a pose or end point is not finite or too far away");
  }
};

inline double probability(float e) {
  if (!(e >= 0.0f && e <= 1.0f)) throw std::invalid_argument("e: expected probabilities in [0, 1]");
  return static_cast<double>(e);
}

// Calls work(scan, beam, pose) for every usable beam of the scans [first, last).
template <int D, class Work>
inline void for_each_beam(const Scans<D>& scans, size_t first, size_t last, Work&& work) {
  for (size_t t = first; t < last; ++t) {
    const Pose<D> pose = pose_from<D>(scans.poses + t * (D + 1) * (D + 1));
    for (int64_t n = scans.offset[t]; n < scans.offset[t + 1]; ++n)
      if (usable<D>(scans.points + n * D)) work(t, n, pose);
  }
}

// Adds the lengths on the approach to an end point, without the end cell, as beta_j has them.
template <int D>
class Approach {
 public:
  Approach(Grid<D>& grid, Fixed sign)
      : cursor_(grid), cells_(grid.approach() / grid.resolution()), sign_(sign) {}

  void add(const Segment<D>& beam) {
    if (cells_ <= 0.0) return;
    const Vec<D> back = beam.start - beam.end;
    const double length = back.norm();
    const Vec<D> start = length > cells_ ? beam.end + back * (cells_ / length) : beam.start;
    traverse<D>(start, beam.end, *this);
  }

  void start(const Cell<D>& first) { cell_ = first; }
  void visit(double length) {
    auto& moments = Grid<D>::moments_of(*cursor_.block(cell_));
    moments[static_cast<size_t>(Grid<D>::local_of(cell_))][D] += sign_ * to_fixed(length);
  }
  template <int Axis>
  void step(int32_t direction) {
    cell_[Axis] += direction;
  }

 private:
  Cursor<Grid<D>> cursor_;
  double cells_;
  Fixed sign_;
  Cell<D> cell_ = Cell<D>::Zero();
};

// A hit, static with some probability, in its end cell.
template <int D>
inline void add_end(typename Grid<D>::Block& block, const Cell<D>& cell, const Vec<D>& end,
                    double static_share, Fixed sign) {
  const auto local = static_cast<size_t>(Grid<D>::local_of(cell));
  block.counts[local].alpha += sign * to_fixed(static_share);       // alpha_j
  block.counts[local].beta += sign * to_fixed(1.0 - static_share);  // first sum of beta_j
  auto& moment = Grid<D>::moments_of(block)[local];
  for (int d = 0; d < D; ++d)
    moment[static_cast<size_t>(d)] += sign * to_fixed(static_share * (end[d] - cell[d]));
}

// alpha_j and beta_j of (10) for the scans [first, last). Sums are integers: with sign -1 scans
// that were added before are taken out again without a trace.
template <int D>
inline void add_scans(Grid<D>& grid, const Scans<D>& scans, const float* e, Fixed sign,
                      size_t first, size_t last) {
  Cursor<Grid<D>> cursor(grid);
  // second sum of beta_j: the length by which the beam covers j, whatever e is
  Walker walker(cursor, [=](Counts* j, double length) { j->beta += sign * to_fixed(length); });
  Approach<D> approach(grid, sign);
  for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
    const Segment<D> beam(pose, scans.points + n * D, grid.resolution());
    traverse<D>(beam.start, beam.end, walker);
    if (!scans.hit[n]) return;  // (1 - zeta) = 0: the end cell of a maximum-range beam says nothing
    approach.add(beam);
    add_end<D>(*walker.block(), walker.cell(), beam.end, probability(e[n]), sign);
  });
}

// What of these sums depends on e: those of the end cells.
template <int D>
inline void add_ends(Grid<D>& grid, const Scans<D>& scans, const float* e, Fixed sign) {
  Cursor<Grid<D>> cursor(grid);
  for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t, int64_t n, const Pose<D>& pose) {
    if (!scans.hit[n]) return;
    const Segment<D> beam(pose, scans.points + n * D, grid.resolution());
    const Cell<D> end = cell_of<D>(beam.end);
    add_end<D>(*cursor.block(end), end, beam.end, probability(e[n]), sign);
  });
}

template <int D>
inline void add_beams(Grid<D>& grid, const Scans<D>& scans, const float* e, Fixed sign,
                      int threads) {
  const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
  std::vector<Grid<D>> others;
  for (size_t i = 2; i < bounds.size(); ++i)
    others.emplace_back(grid.resolution(), grid.approach());
  parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
    add_scans<D>(i == 0 ? grid : others[i - 1], scans, e, sign, first, last);
  });
  for (const auto& other : others) grid.merge(other);
}

// (8): the probability that something static reflected a beam that ends in a cell of occupancy m.
inline double expectation(double prior, double m) {
  const double hit = prior * m;
  const double total = hit + (1.0 - prior) * (1.0 - m);
  return total > 0.0 ? hit / total : prior;
}

// (6), (8) for every beam: NaN when unusable, the prior at maximum range and where the end cell
// was never looked at.
template <int D>
inline void e_step(const Grid<D>& grid, const Scans<D>& scans, double prior, int threads,
                   float* e) {
  std::fill(e + scans.offset[0], e + scans.offset[scans.n_scans],
            std::numeric_limits<float>::quiet_NaN());
  const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
  parallel_shares(bounds, [&](size_t, size_t first, size_t last) {
    Cursor<const Grid<D>> cursor(grid);
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      e[n] = static_cast<float>(prior);
      if (!scans.hit[n]) return;
      const Segment<D> beam(pose, scans.points + n * D, grid.resolution());
      if (const Counts* c = cursor.seen(cell_of<D>(beam.end)))
        e[n] = static_cast<float>(expectation(prior, occupancy(*c)));
    });
  });
}

// Terms of the expected log likelihood of one scan.
struct LogLikelihood {
  double end = 0.0;        // (5), first two rows
  double traversed = 0.0;  // (5), last row, weighted by the lengths l_j
  double gamma = 0.0;      // (7)
  double entropy = 0.0;    // of e: turns the expected log likelihood into the bound of EM
};

// ln with a floor, so that one impossible beam costs much but not everything
inline double safe_log(double p) { return std::log(p > 1e-12 ? p : 1e-12); }
inline double x_log(double x, double p) { return x > 0.0 ? x * safe_log(p) : 0.0; }

// (5) and (7) scan by scan; with e in {0, 1} this is (4). Cells nobody looked at are unknown and
// contribute nothing.
template <int D>
inline void log_likelihood(const Grid<D>& grid, const Scans<D>& scans, const float* e, double prior,
                           int threads, LogLikelihood* terms) {
  const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
  parallel_shares(bounds, [&](size_t, size_t first, size_t last) {
    Cursor<const Grid<D>> cursor(grid);
    double traversed = 0.0;
    Walker walker(cursor, [&](const Counts* j, double length) {
      if (j && j->alpha > 0) traversed += length * safe_log(1.0 - occupancy(*j));
    });
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      LogLikelihood& sum = terms[t];
      const double en = probability(e[n]);
      sum.gamma += x_log(en, prior) + x_log(1.0 - en, 1.0 - prior);
      sum.entropy -= x_log(en, en) + x_log(1.0 - en, 1.0 - en);
      const Segment<D> beam(pose, scans.points + n * D, grid.resolution());
      traversed = 0.0;
      traverse<D>(beam.start, beam.end, walker);
      sum.traversed += traversed;
      const Counts* c = walker.counts();
      if (!scans.hit[n] || !c || c->alpha + c->beta == 0) return;
      const double m = occupancy(*c);
      sum.end += x_log(en, m) + x_log(1.0 - en, 1.0 - m);
    });
  });
}

}  // namespace stillmap
