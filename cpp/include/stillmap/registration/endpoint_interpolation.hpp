// Interpolates end points between neighbouring beams on one flat surface. At long range and grazing
// incidence beams leave gaps on a wall, and registration would lock on to the pattern of the gaps
// instead of sliding along the wall.
#pragma once

#include <cmath>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

struct InterpolationOptions {
  double max_gap;        // metres between neighbouring end points
  double tolerance;      // metres, deviation of three successive end points from a line
  double max_gap_ratio;  // of a gap to the gap next to it
};

class EndPointInterpolator {
 public:
  EndPointInterpolator(OccupancyGrid<2>& grid, const Scans<2>& scans, const float* e, Fixed sign,
                       const InterpolationOptions& options)
      : cursor_(grid),
        scans_(scans),
        e_(e),
        sign_(sign),
        options_(options),
        resolution_(grid.resolution()) {}

  void add() {
    for (size_t t = 0; t < scans_.n_scans; ++t) {
      first_ = scans_.offset[t];
      last_ = scans_.offset[t + 1] - 1;
      pose_ = pose_from<2>(scans_.poses + t * 9);
      for (int64_t n = first_; n < last_; ++n)
        if (is_hit(n) && is_hit(n + 1) &&
            (is_collinear(n, n + 1, n - 1) || is_collinear(n + 1, n, n + 2)))
          interpolate(point(n), point(n + 1),
                      std::min(checked_probability(e_[n]), checked_probability(e_[n + 1])));
    }
  }

 private:
  bool is_hit(int64_t n) const { return n >= first_ && n <= last_ && scans_.hit[n]; }
  Vec<2> point(int64_t n) const { return point_at<2>(scans_.points + n * 2); }

  // Whether the surface from `previous` to a continues straight to b.
  bool is_collinear(int64_t a, int64_t b, int64_t previous) const {
    if (!is_hit(previous)) return false;
    const Vec<2> step = point(b) - point(a), previous_step = point(a) - point(previous);
    const double gap = step.norm(), previous_gap = previous_step.norm();
    if (gap > options_.max_gap || gap > options_.max_gap_ratio * previous_gap) return false;
    const double along = previous_step.dot(step) / (gap > 0.0 ? gap : 1.0);
    const double off = std::sqrt(std::max(previous_step.squaredNorm() - along * along, 0.0));
    return along > 0.0 && off < options_.tolerance;
  }

  void interpolate(const Vec<2>& from, const Vec<2>& to, double weight) {
    for (const Vec<2>& end : {from, to})
      if (!all_below<2>((pose_ * end) / resolution_, BlockLayout<2>::kMaxCell))
        throw std::invalid_argument("beam: a pose or end point is not finite or too far away");
    const auto n_steps = static_cast<int>(std::ceil((to - from).norm() / resolution_));
    for (int i = 1; i < n_steps; ++i) {
      const Vec<2> point =
          (pose_ * (from + (to - from) * (static_cast<double>(i) / n_steps))) / resolution_;
      const Cell<2> cell = cell_of<2>(point);
      auto* block = cursor_.block(cell);
      const auto local = static_cast<size_t>(BlockLayout<2>::local_of(cell));
      block->values[local].alpha += sign_ * to_fixed(weight);
      auto& moment = OccupancyGrid<2>::moments_of(*block)[local];
      for (int d = 0; d < 2; ++d)
        moment[static_cast<size_t>(d)] += sign_ * to_fixed(weight * (point[d] - cell[d]));
    }
  }

  BlockCursor<OccupancyGrid<2>> cursor_;
  const Scans<2>& scans_;
  const float* e_;
  Fixed sign_;
  InterpolationOptions options_;
  double resolution_;
  int64_t first_ = 0, last_ = 0;
  Pose<2> pose_;
};

}  // namespace stillmap
