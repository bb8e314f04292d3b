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

// ln((floor + F) / floor) at the pixels of a box, F being the largest single contribution. A pixel
// is 2^shift grid cells wide.
template <int D>
class Raster {
 public:
  Raster(const Grid<D>& grid, const Cell<D>& first, const Cell<D>& size, int shift,
         const FieldOptions& options)
      : first_(first), size_(size), shift_(shift) {
    logs_.assign(static_cast<size_t>(size.template cast<int64_t>().prod()), 0.0f);
    // wider than the field that is climbed: a pixel stands for its whole area
    const double pixel = grid.resolution() * (1 << shift);
    add_peaks(grid, std::max(1.5 * options.sigma / pixel, 1.0));
    const auto floor = static_cast<float>(options.floor);
    for (float& v : logs_)
      if (v > 0.0f) v = std::log((floor + v) / floor);
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
  // the box in which something was hit
  template <class Visit>
  void for_each_row(const Grid<D>& grid, int margin, Visit&& visit) const {
    const Cell<D> low = (first_.array() - margin) * (1 << shift_);
    const Cell<D> high = (first_ + size_).array() * (1 << shift_) + margin * (1 << shift_);
    for_each_in_box<D>(Grid<D>::block_of(low), Grid<D>::block_of(high), [&](const Cell<D>& b) {
      const Block* block = grid.find(b);
      if (!block || !block->moments) return;
      for (int i = 0; i < Grid<D>::kCells; i += Grid<D>::kEdge)
        visit(*block, static_cast<size_t>(i), Grid<D>::cell_at(block->origin, i));
    });
  }

  // max over cells of m_k exp(-|pixel - cell|^2 / (2 sigma^2)), sigma in pixels
  void add_peaks(const Grid<D>& grid, double sigma) {
    const int reach = static_cast<int>(std::ceil(2.0 * sigma)), edge = 2 * reach + 1;
    // along each axis, by the cell's place within its pixel and the pixel's distance
    std::vector<float> table;
    for (int place = 0; place < 1 << shift_; ++place)
      for (int k = -reach; k <= reach; ++k) {
        const double d = k + 0.5 - (place + 0.5) / (1 << shift_);
        table.push_back(static_cast<float>(std::exp(-0.5 * d * d / (sigma * sigma))));
      }
    for_each_row(grid, reach, [&](const Block& block, size_t first, const Cell<D>& row) {
      Cell<D> cell = row;
      for (size_t x = 0; x < Grid<D>::kEdge; ++x, ++cell[0])
        if (block.counts[first + x].alpha > 0)
          splat(cell, Grid<D>::presence(block, first + x), table, reach, edge);
    });
  }

  void splat(const Cell<D>& cell, double m, const std::vector<float>& table, int reach, int edge) {
    const Cell<D> pixel = pixel_of(cell);
    const Cell<D> low = (pixel.array() - reach).max(first_.array());
    Cell<D> high = (pixel.array() + reach).min((first_ + size_).array() - 1);
    if ((low.array() > high.array()).any()) return;
    std::array<const float*, D> g;  // of each axis, at pixel low
    for (int d = 0; d < D; ++d)
      g[static_cast<size_t>(d)] =
          table.data() + (cell[d] - pixel[d] * (1 << shift_)) * edge + (low[d] - pixel[d] + reach);
    const int32_t width = high[0] - low[0] + 1;
    high[0] = low[0];  // whole rows along x
    for_each_in_box<D>(low, high, [&](const Cell<D>& row) {
      auto weight = static_cast<float>(m);
      for (int d = 1; d < D; ++d) weight *= g[static_cast<size_t>(d)][row[d] - low[d]];
      float* to = logs_.data() + index(row);
      for (int32_t x = 0; x < width; ++x) to[x] = std::max(to[x], weight * g[0][x]);
    });
  }

  Cell<D> first_, size_;
  int shift_;
  std::vector<float> logs_;
};

}  // namespace stillmap
