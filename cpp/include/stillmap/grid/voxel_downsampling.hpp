// Points that stand for all: the first one in each cell.
#pragma once

#include <vector>

#include "stillmap/grid/voxel_hash_map.hpp"
#include "stillmap/occupancy/beam_counting.hpp"

namespace stillmap {

// Indices, rising, of the first usable points (N, D) with a positive weight in cells of an edge
// of that many metres.
template <int D>
inline std::vector<int64_t> first_in_cells(const float* points, const float* weights, size_t n,
                                           double edge) {
  VoxelTable<D, char> taken;
  std::vector<int64_t> kept;
  for (size_t i = 0; i < n; ++i) {
    const float* p = points + i * D;
    if (!usable<D>(p) || !(weights[i] > 0.0f)) continue;
    const Vec<D> x = point_at<D>(p) / edge;
    if (!all_below<D>(x, (VoxelTable<D, char>::kMaxCell)))
      throw std::invalid_argument("points: too far away to be counted in cells");
    const size_t before = taken.size();
    taken.find_or_add(cell_of<D>(x));
    if (taken.size() > before) kept.push_back(static_cast<int64_t>(i));
  }
  return kept;
}

}  // namespace stillmap
