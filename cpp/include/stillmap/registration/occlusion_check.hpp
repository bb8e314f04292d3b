// Consistency check of a pose: share of the beams that would pass through occupied cells.
#pragma once

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

// Weighted share of beams that cross a cell of at least min_occupancy (15) more than `margin`
// metres before their end point. points: metres, moving frame; sensor: origin of the beams in that
// frame.
template <int D>
inline double occluded_share(const OccupancyGrid<D>& grid, const std::vector<Vec<D>>& points,
                             const std::vector<double>& weights, const Pose<D>& pose,
                             const Vec<D>& sensor, double margin, double min_occupancy) {
  BlockCursor<const OccupancyGrid<D>> cursor(grid);
  bool crosses_occupied = false;
  RayWalker walker(cursor, [&](const CellCounts* j, double) {
    if (j && j->alpha > 0 && occupancy(*j) >= min_occupancy) crosses_occupied = true;
  });
  const Vec<D> start = (pose * sensor) / grid.resolution();
  double occluded = 0.0, total = 0.0;
  for (size_t n = 0; n < points.size(); ++n) {
    const Vec<D> end = (pose * points[n]) / grid.resolution();
    total += weights[n];
    const Vec<D> direction = end - start;
    const double length = direction.norm(), checked_length = length - margin / grid.resolution();
    if (checked_length <= 0.0 || !all_below<D>(start, BlockLayout<D>::kMaxCell) ||
        !all_below<D>(end, BlockLayout<D>::kMaxCell))
      continue;
    crosses_occupied = false;
    traverse<D>(start, start + direction * (checked_length / length), walker);
    if (crosses_occupied) occluded += weights[n];
  }
  return total > 0.0 ? occluded / total : 0.0;
}

}  // namespace stillmap
