// A dense picture of the smoothed field, for looking up many poses.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "stillmap/field.hpp"

namespace stillmap {

template <int D, class Visit>
inline void for_each_in_box(const Cell<D>& low, const Cell<D>& high, Visit&& visit) {
  if ((low.array() > high.array()).any()) return;
  Cell<D> at = low;
  while (true) {
    visit(at);
    int d = 0;
    for (; d < D; ++d) {
      if (++at[d] <= high[d]) break;
      at[d] = low[d];
    }
    if (d == D) return;
  }
}

// ln((base + F) / floor) at the pixels of a box, F being the largest single contribution. A pixel
// is 2^shift grid cells wide.
template <int D>
class Raster {
 public:
  Raster(const Grid<D>& grid, const Cell<D>& first, const Cell<D>& size, int shift,
         const FieldOptions& options)
      : first_(first), size_(size), shift_(shift) {
    const auto pixels = static_cast<size_t>(size.template cast<int64_t>().prod());
    const auto floor = static_cast<float>(options.floor);
    const auto unseen = static_cast<float>(options.floor + options.unknown);
    logs_.assign(pixels, std::log(unseen / floor));
    mark_seen(grid);
    // wider than the field that is climbed: a pixel stands for its whole area
    const double pixel = grid.resolution() * (1 << shift);
    const std::vector<float> peaks =
        contributions(grid, std::max(1.5 * options.sigma / pixel, 1.0));
    for (size_t i = 0; i < pixels; ++i)
      if (peaks[i] > 0.0f)
        logs_[i] = std::log(((logs_[i] == 0.0f ? floor : unseen) + peaks[i]) / floor);
  }

  // x runs fastest; the pixel must lie in the box
  const float* at(const Cell<D>& pixel) const { return logs_.data() + index(pixel); }

 private:
  using Block = typename Grid<D>::Block;

  size_t index(const Cell<D>& pixel) const {
    int64_t i = 0;
    for (int d = D - 1; d >= 0; --d) i = i * size_[d] + (pixel[d] - first_[d]);
    return static_cast<size_t>(i);
  }

  Cell<D> pixel_of(const Cell<D>& cell) const {
    Cell<D> pixel;
    for (int d = 0; d < D; ++d) pixel[d] = cell[d] >> shift_;
    return pixel;
  }

  // visit(counts of kEdge cells along x, first of them) for all blocks within `margin` pixels of
  // the box that `wanted` accepts
  template <class Wanted, class Visit>
  void for_each_row(const Grid<D>& grid, int margin, Wanted&& wanted, Visit&& visit) const {
    const Cell<D> low = (first_.array() - margin) * (1 << shift_);
    const Cell<D> high = (first_ + size_).array() * (1 << shift_) + margin * (1 << shift_);
    for_each_in_box<D>(Grid<D>::block_of(low), Grid<D>::block_of(high), [&](const Cell<D>& b) {
      const Block* block = grid.find(b);
      if (!block || !wanted(*block)) return;
      for (int i = 0; i < Grid<D>::kCells; i += Grid<D>::kEdge)
        visit(block->counts.data() + i, Grid<D>::cell_at(block->origin, i));
    });
  }

  void mark_seen(const Grid<D>& grid) {
    auto any = [](const Block&) { return true; };
    for_each_row(grid, 0, any, [&](const Counts* counts, const Cell<D>& cell) {
      const Cell<D> row = pixel_of(cell);
      for (int d = 1; d < D; ++d)
        if (row[d] < first_[d] || row[d] >= first_[d] + size_[d]) return;
      const int begin = std::max(0, first_[0] * (1 << shift_) - cell[0]);
      const int end = std::min(Grid<D>::kEdge, (first_[0] + size_[0]) * (1 << shift_) - cell[0]);
      if (begin >= end) return;
      Cell<D> start = row;
      start[0] = first_[0];
      float* to = logs_.data() + index(start);
      for (int x = begin; x < end; ++x)
        if (counts[x].alpha + counts[x].beta > 0) to[((cell[0] + x) >> shift_) - first_[0]] = 0.0f;
    });
  }

  // max over cells of m_k exp(-|pixel - cell|^2 / (2 sigma^2)), sigma in pixels
  std::vector<float> contributions(const Grid<D>& grid, double sigma) const {
    std::vector<float> peaks(logs_.size(), 0.0f);
    const int reach = static_cast<int>(std::ceil(2.0 * sigma)), edge = 2 * reach + 1;
    // along each axis, by the cell's place within its pixel and the pixel's distance
    std::vector<float> table;
    for (int place = 0; place < 1 << shift_; ++place)
      for (int k = -reach; k <= reach; ++k) {
        const double d = k + 0.5 - (place + 0.5) / (1 << shift_);
        table.push_back(static_cast<float>(std::exp(-0.5 * d * d / (sigma * sigma))));
      }
    auto hit = [](const Block& block) { return block.moments != nullptr; };
    for_each_row(grid, reach, hit, [&](const Counts* counts, const Cell<D>& row) {
      Cell<D> cell = row;
      for (int x = 0; x < Grid<D>::kEdge; ++x, ++cell[0])
        if (counts[x].alpha > 0) splat(cell, occupancy(counts[x]), table, reach, edge, peaks);
    });
    return peaks;
  }

  void splat(const Cell<D>& cell, double m, const std::vector<float>& table, int reach, int edge,
             std::vector<float>& peaks) const {
    const Cell<D> pixel = pixel_of(cell);
    const Cell<D> low = (pixel.array() - reach).max(first_.array());
    Cell<D> high = (pixel.array() + reach).min((first_ + size_).array() - 1);
    if ((low.array() > high.array()).any()) return;
    std::array<const float*, D> g;  // of each axis, at pixel low
    for (int d = 0; d < D; ++d)
      g[static_cast<size_t>(d)] =
          table.data() + (cell[d] - (pixel[d] << shift_)) * edge + (low[d] - pixel[d] + reach);
    const int32_t width = high[0] - low[0] + 1;
    high[0] = low[0];  // whole rows along x
    for_each_in_box<D>(low, high, [&](const Cell<D>& row) {
      auto weight = static_cast<float>(m);
      for (int d = 1; d < D; ++d) weight *= g[static_cast<size_t>(d)][row[d] - low[d]];
      float* to = peaks.data() + index(row);
      for (int32_t x = 0; x < width; ++x) to[x] = std::max(to[x], weight * g[0][x]);
    });
  }

  Cell<D> first_, size_;
  int shift_;
  std::vector<float> logs_;
};

}  // namespace stillmap
