// Which elements of a surface lie near each other.
#pragma once

#include <cmath>
#include <vector>

#include "stillmap/grid/window_query.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap {

// The elements near each, by the distance of their means: pose and range noise move end points
// about, so that a hit of one is a hit of all.
template <int D>
class Neighbours {
 public:
  Neighbours() = default;
  Neighbours(const Surface<D>& surface, double reach, int threads) {
    const std::vector<size_t> bounds = even_shares(surface.size(), threads);
    std::vector<Neighbours> shares(bounds.size() - 1);
    parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
      shares[i].add(surface, reach, first, last);
    });
    size_t pairs = 0;
    for (const Neighbours& share : shares) pairs += share.near_.size();
    near_.reserve(pairs);
    begin_.reserve(surface.size() + 1);
    for (Neighbours& share : shares) {
      for (size_t i = 1; i < share.begin_.size(); ++i)
        begin_.push_back(near_.size() + share.begin_[i]);
      near_.insert(near_.end(), share.near_.begin(), share.near_.end());
      share = Neighbours();
    }
  }

  const int32_t* begin(int32_t k) const { return near_.data() + begin_[static_cast<size_t>(k)]; }
  const int32_t* end(int32_t k) const { return near_.data() + begin_[static_cast<size_t>(k) + 1]; }

 private:
  void add(const Surface<D>& surface, double reach, size_t first, size_t last) {
    const CellRows<D> window = rows_around<D>(std::ceil(reach), true);
    Around<D> around(surface);
    for (size_t i = first; i < last; ++i) {
      const auto from = static_cast<int32_t>(i);
      around.each(surface.cell(from), window, [&](int32_t k) {
        if (k == from) return;
        const Vec<D> apart = surface.element(k).mean - surface.element(from).mean;
        if (apart.squaredNorm() <= reach * reach) near_.push_back(k);
      });
      begin_.push_back(near_.size());
    }
  }

  std::vector<int32_t> near_;
  std::vector<size_t> begin_{0};
};

}  // namespace stillmap
