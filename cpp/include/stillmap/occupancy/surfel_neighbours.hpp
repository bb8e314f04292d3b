// Neighbouring surfels of each surfel.
#pragma once

#include <cmath>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/window_query.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Surfels within a radius (cells) of each other, by the distance of their means. Pose and range
// noise shift end points between them, so a hit of one is a hit of its neighbours.
template <int D>
class SurfelNeighbours {
 public:
  SurfelNeighbours() = default;
  SurfelNeighbours(const SurfelMap<D>& surfel_map, double radius, int threads) {
    const std::vector<size_t> bounds = split_evenly(surfel_map.size(), threads);
    const RowMasks<D> masks(surfel_map);
    std::vector<SurfelNeighbours> parts(bounds.size() - 1);
    parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
      parts[i].add(surfel_map, masks, radius, first, last);
    });
    size_t pairs = 0;
    for (const SurfelNeighbours& part : parts) pairs += part.indices_.size();
    indices_.reserve(pairs);
    begin_.reserve(surfel_map.size() + 1);
    for (SurfelNeighbours& part : parts) {
      for (size_t i = 1; i < part.begin_.size(); ++i)
        begin_.push_back(indices_.size() + part.begin_[i]);
      indices_.insert(indices_.end(), part.indices_.begin(), part.indices_.end());
      part = SurfelNeighbours();
    }
  }

  const int32_t* begin(int32_t other) const {
    return indices_.data() + begin_[static_cast<size_t>(other)];
  }
  const int32_t* end(int32_t other) const {
    return indices_.data() + begin_[static_cast<size_t>(other) + 1];
  }

 private:
  void add(const SurfelMap<D>& surfel_map, const RowMasks<D>& masks, double radius, size_t first,
           size_t last) {
    const CellRows<D> window = window_rows<D>(std::ceil(radius), true);
    WindowQuery<D> query(surfel_map, masks);
    for (size_t i = first; i < last; ++i) {
      const auto k = static_cast<int32_t>(i);
      query.for_each(surfel_map.cell(k), window, [&](int32_t other) {
        if (other == k) return;
        const Vec<D> offset = surfel_map.surfel(other).mean - surfel_map.surfel(k).mean;
        if (offset.squaredNorm() <= radius * radius) indices_.push_back(other);
      });
      begin_.push_back(indices_.size());
    }
  }

  std::vector<int32_t> indices_;
  std::vector<size_t> begin_{0};
};

}  // namespace stillmap
