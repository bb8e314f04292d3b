// Whether a scan at some pose would have to look through what the map knows to be there.
#pragma once

#include "stillmap/occupancy/beam_counting.hpp"

namespace stillmap {

// Weighted share of the beams that cross a cell of at least that occupancy (15) more than `margin`
// metres before they end. Points are end points in the moving frame, T_sensor where beams begin.
template <int D>
inline double share_through(const Grid<D>& grid, const std::vector<Vec<D>>& points,
                            const std::vector<double>& weights, const Pose<D>& pose,
                            const Vec<D>& sensor, double margin, double occupied) {
  Cursor<const Grid<D>> cursor(grid);
  bool crosses = false;
  Walker walker(cursor, [&](const Counts* j, double) {
    if (j && j->alpha > 0 && occupancy(*j) >= occupied) crosses = true;
  });
  const Vec<D> start = (pose * sensor) / grid.resolution();
  double through = 0.0, total = 0.0;
  for (size_t n = 0; n < points.size(); ++n) {
    const Vec<D> end = (pose * points[n]) / grid.resolution();
    total += weights[n];
    const Vec<D> way = end - start;
    const double length = way.norm(), kept = length - margin / grid.resolution();
    if (kept <= 0.0 || !all_below<D>(start, Grid<D>::kMaxCell) ||
        !all_below<D>(end, Grid<D>::kMaxCell))
      continue;
    crosses = false;
    traverse<D>(start, start + way * (kept / length), walker);
    if (crosses) through += weights[n];
  }
  return total > 0.0 ? through / total : 0.0;
}

}  // namespace stillmap
