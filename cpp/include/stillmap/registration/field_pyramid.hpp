// A dense picture of the smoothed field for looking up many poses, and its maxima over windows of
// 2, 4, 8, ... pixels: what any pose of a whole window can reach at most.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/registration/likelihood_field.hpp"

namespace stillmap {

// ln((floor + F) / floor) at the pixels of a box in steps of `unit()`, F being the largest single
// contribution. A pixel is 2^shift grid cells wide. Level h has at each pixel the maximum over the
// 2^h pixels that begin there along each axis; beyond the box there is nothing.
template <int D>
class FieldPyramid {
 public:
  FieldPyramid(const OccupancyGrid<D>& grid, const Cell<D>& first, const Cell<D>& size, int shift,
               int levels, const LikelihoodFieldOptions& options)
      : first_(first), size_(size), shift_(shift) {
    levels_.resize(static_cast<size_t>(levels) + 1);
    levels_[0].assign(static_cast<size_t>(size.template cast<int64_t>().prod()), 0);
    // wider than the field that is climbed: a pixel stands for its whole area
    const double pixel = grid.resolution() * (1 << shift);
    splat_grid(grid, std::max(1.5 * options.sigma / pixel, 1.0));
    const double largest = std::log((options.floor + 1.0) / options.floor);
    score_unit_ = largest / kMaxScore;
    std::array<uint8_t, 256> logs{};
    for (size_t v = 1; v < logs.size(); ++v) {
      const double F = static_cast<double>(v) / kMaxScore;
      logs[v] = static_cast<uint8_t>(
          std::lround(std::log((options.floor + F) / options.floor) / score_unit_));
    }
    for (uint8_t& v : levels_[0]) v = logs[v];
    for (size_t h = 1; h < levels_.size(); ++h) max_pool(levels_[h - 1], 1 << (h - 1), levels_[h]);
  }

  double score_unit() const { return score_unit_; }
  const uint8_t* level(int h) const { return levels_[static_cast<size_t>(h)].data(); }

  // x runs fastest; the pixel must lie in the box
  int64_t index(const Cell<D>& pixel) const { return offset(pixel - first_); }

  // between the indices of two pixels that far apart
  int64_t offset(const Cell<D>& difference) const {
    int64_t i = 0;
    for (int d = D - 1; d >= 0; --d) i = i * size_[d] + difference[d];
    return i;
  }

 private:
  using Block = typename OccupancyGrid<D>::Block;
  static constexpr double kMaxScore = 255.0;

  // maxima over twice the window: each axis in turn
  void max_pool(const std::vector<uint8_t>& source, int32_t radius,
                std::vector<uint8_t>& target) const {
    target = source;
    int64_t stride = 1;
    for (int d = 0; d < D; ++d) {
      const int64_t line = stride * size_[d];
      const int64_t kept = line - stride * std::min<int64_t>(radius, size_[d]);
      for (int64_t at = 0; at < static_cast<int64_t>(target.size()); at += line) {
        uint8_t* v = target.data() + at;
        // ascending: what is read lies ahead of what was written
        for (int64_t i = 0; i < kept; ++i) v[i] = std::max(v[i], v[i + stride * radius]);
      }
      stride = line;
    }
  }

  Cell<D> pixel_of(const Cell<D>& cell) const {
    Cell<D> pixel;
    for (int d = 0; d < D; ++d) pixel[d] = cell[d] >> shift_;
    return pixel;
  }

  // visit(counts of kEdge cells along x, first of them) for all blocks within `margin` pixels of
  // the box in which something was hit
  template <class Visit>
  void for_each_row(const OccupancyGrid<D>& grid, int margin, Visit&& visit) const {
    const Cell<D> low = (first_.array() - margin) * (1 << shift_);
    const Cell<D> high = (first_ + size_).array() * (1 << shift_) + margin * (1 << shift_);
    for_each_in_box<D>(
        BlockLayout<D>::block_of(low), BlockLayout<D>::block_of(high), [&](const Cell<D>& b) {
          const Block* block = grid.find(b);
          if (!block || !block->moments) return;
          for (int i = 0; i < BlockLayout<D>::kCells; i += BlockLayout<D>::kEdge)
            visit(*block, static_cast<size_t>(i), BlockLayout<D>::cell_at(block->origin, i));
        });
  }

  // max over cells of m_k exp(-|pixel - cell|^2 / (2 sigma^2)), sigma in pixels
  void splat_grid(const OccupancyGrid<D>& grid, double sigma) {
    const int radius = static_cast<int>(std::ceil(2.0 * sigma)), kernel_size = 2 * radius + 1;
    // along each axis, by the cell's place within its pixel and the pixel's distance
    std::vector<float> kernel;
    for (int subpixel = 0; subpixel < 1 << shift_; ++subpixel)
      for (int k = -radius; k <= radius; ++k) {
        const double d = k + 0.5 - (subpixel + 0.5) / (1 << shift_);
        kernel.push_back(static_cast<float>(std::exp(-0.5 * d * d / (sigma * sigma))));
      }
    for_each_row(grid, radius, [&](const Block& block, size_t first, const Cell<D>& row) {
      Cell<D> cell = row;
      for (size_t x = 0; x < BlockLayout<D>::kEdge; ++x, ++cell[0])
        if (block.values[first + x].alpha > 0)
          splat(cell, OccupancyGrid<D>::occupancy_ignoring_approach(block, first + x), kernel,
                radius, kernel_size);
    });
  }

  void splat(const Cell<D>& cell, double m, const std::vector<float>& kernel, int radius,
             int kernel_size) {
    const Cell<D> pixel = pixel_of(cell);
    const Cell<D> low = (pixel.array() - radius).max(first_.array());
    Cell<D> high = (pixel.array() + radius).min((first_ + size_).array() - 1);
    if ((low.array() > high.array()).any()) return;
    std::array<const float*, D> axis_kernel;  // of each axis, at pixel low
    for (int d = 0; d < D; ++d)
      axis_kernel[static_cast<size_t>(d)] = kernel.data() +
                                            (cell[d] - pixel[d] * (1 << shift_)) * kernel_size +
                                            (low[d] - pixel[d] + radius);
    const int32_t width = high[0] - low[0] + 1;
    high[0] = low[0];  // whole rows along x
    for_each_in_box<D>(low, high, [&](const Cell<D>& row) {
      auto weight = static_cast<float>(m * kMaxScore);
      for (int d = 1; d < D; ++d) weight *= axis_kernel[static_cast<size_t>(d)][row[d] - low[d]];
      uint8_t* target = levels_[0].data() + index(row);
      for (int32_t x = 0; x < width; ++x)
        target[x] = std::max(
            target[x], static_cast<uint8_t>(static_cast<int>(weight * axis_kernel[0][x] + 0.5f)));
    });
  }

  Cell<D> first_, size_;
  int shift_;
  double score_unit_ = 0.0;
  std::vector<std::vector<uint8_t>> levels_;
};

}  // namespace stillmap
