// Voxel downsampling: keeps the first point of each voxel.
#pragma once

#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/grid/voxel_hash_map.hpp"

namespace stillmap {

// Ascending indices of the first usable point (N, D) with a positive weight (N,) in each voxel;
// edge in metres.
template <int D>
inline std::vector<int64_t> voxel_downsample(const float* points, const float* weights, size_t n,
                                             double edge) {
  VoxelHashMap<D, char> occupied;
  std::vector<int64_t> indices;
  for (size_t i = 0; i < n; ++i) {
    const float* p = points + i * D;
    if (!usable<D>(p) || !(weights[i] > 0.0f)) continue;
    const Vec<D> x = point_at<D>(p) / edge;
    if (!all_below<D>(x, (VoxelHashMap<D, char>::kMaxCell)))
      throw std::invalid_argument("points: too far away to be counted in cells");
    const size_t n_before = occupied.size();
    occupied.find_or_add(cell_of<D>(x));
    if (occupied.size() > n_before) indices.push_back(static_cast<int64_t>(i));
  }
  return indices;
}

}  // namespace stillmap
