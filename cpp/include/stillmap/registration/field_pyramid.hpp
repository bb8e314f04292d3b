// Multi-resolution raster of the likelihood field: maxima over windows of 2, 4, 8, ... pixels bound
// the score of all poses in a window.
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

// Level 0 has ln((floor + F) / floor) at the pixels of a box, quantised in units of score_unit(); F
// is the largest single Gaussian. A pixel is 2^shift cells wide. Level h has the maximum over the
// 2^h pixels that start at a pixel along each axis; outside the box F is 0.
class FieldPyramid {
 public:
  FieldPyramid(const OccupancyGrid<2>& grid, const Cell<2>& first, const Cell<2>& size, int shift,
               int levels, const LikelihoodFieldOptions& options)
      : first_(first), size_(size), shift_(shift) {
    levels_.resize(static_cast<size_t>(levels) + 1);
    levels_[0].assign(static_cast<size_t>(size.cast<int64_t>().prod()), 0);
    // wider than the field of the optimiser, since a pixel stands for its whole area
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

  // x fastest; the pixel must be inside the box.
  int64_t index(const Cell<2>& pixel) const { return offset(pixel - first_); }

  // Difference of the indices of two pixels.
  int64_t offset(const Cell<2>& difference) const {
    return difference[0] + int64_t{size_[0]} * difference[1];
  }

 private:
  using Block = OccupancyGrid<2>::Block;
  static constexpr double kMaxScore = 255.0;

  // Maxima over windows of twice the size, axis by axis.
  void max_pool(const std::vector<uint8_t>& source, int32_t radius,
                std::vector<uint8_t>& target) const {
    target = source;
    int64_t stride = 1;
    for (int d = 0; d < 2; ++d) {
      const int64_t line = stride * size_[d];
      const int64_t n_kept = line - stride * std::min<int64_t>(radius, size_[d]);
      for (int64_t begin = 0; begin < static_cast<int64_t>(target.size()); begin += line) {
        uint8_t* v = target.data() + begin;
        // ascending: reads are ahead of writes
        for (int64_t i = 0; i < n_kept; ++i) v[i] = std::max(v[i], v[i + stride * radius]);
      }
      stride = line;
    }
  }

  Cell<2> pixel_of(const Cell<2>& cell) const { return {cell[0] >> shift_, cell[1] >> shift_}; }

  // Calls visit(block, first local index, first cell) for each row along x of the blocks with end
  // points within `margin` pixels of the box.
  template <class Visit>
  void for_each_row(const OccupancyGrid<2>& grid, int margin, Visit&& visit) const {
    const Cell<2> low = (first_.array() - margin) * (1 << shift_);
    const Cell<2> high = (first_ + size_).array() * (1 << shift_) + margin * (1 << shift_);
    for_each_in_box<2>(
        BlockLayout<2>::block_of(low), BlockLayout<2>::block_of(high), [&](const Cell<2>& b) {
          const Block* block = grid.find(b);
          if (!block || !block->moments) return;
          for (int i = 0; i < BlockLayout<2>::kCells; i += BlockLayout<2>::kEdge)
            visit(*block, static_cast<size_t>(i), BlockLayout<2>::cell_at(block->origin, i));
        });
  }

  // Maximum over cells of m_k exp(-|pixel - cell|^2 / (2 sigma^2)), sigma in pixels.
  void splat_grid(const OccupancyGrid<2>& grid, double sigma) {
    const int radius = static_cast<int>(std::ceil(2.0 * sigma)), kernel_size = 2 * radius + 1;
    // per axis: [position of the cell in its pixel][distance of the pixel]
    std::vector<float> kernel;
    for (int subpixel = 0; subpixel < 1 << shift_; ++subpixel)
      for (int k = -radius; k <= radius; ++k) {
        const double d = k + 0.5 - (subpixel + 0.5) / (1 << shift_);
        kernel.push_back(static_cast<float>(std::exp(-0.5 * d * d / (sigma * sigma))));
      }
    for_each_row(grid, radius, [&](const Block& block, size_t first, const Cell<2>& row) {
      Cell<2> cell = row;
      for (size_t x = 0; x < BlockLayout<2>::kEdge; ++x, ++cell[0])
        if (block.values[first + x].alpha > 0)
          splat(cell, OccupancyGrid<2>::occupancy_ignoring_approach(block, first + x), kernel,
                radius, kernel_size);
    });
  }

  void splat(const Cell<2>& cell, double m, const std::vector<float>& kernel, int radius,
             int kernel_size) {
    const Cell<2> pixel = pixel_of(cell);
    const Cell<2> low = (pixel.array() - radius).max(first_.array());
    Cell<2> high = (pixel.array() + radius).min((first_ + size_).array() - 1);
    if ((low.array() > high.array()).any()) return;
    std::array<const float*, 2> axis_kernel;  // kernel of each axis at pixel low
    for (int d = 0; d < 2; ++d)
      axis_kernel[static_cast<size_t>(d)] = kernel.data() +
                                            (cell[d] - pixel[d] * (1 << shift_)) * kernel_size +
                                            (low[d] - pixel[d] + radius);
    const int32_t width = high[0] - low[0] + 1;
    high[0] = low[0];  // whole rows along x
    for_each_in_box<2>(low, high, [&](const Cell<2>& row) {
      const float weight = static_cast<float>(m * kMaxScore) * axis_kernel[1][row[1] - low[1]];
      uint8_t* target = levels_[0].data() + index(row);
      for (int32_t x = 0; x < width; ++x)
        target[x] = std::max(
            target[x], static_cast<uint8_t>(static_cast<int>(weight * axis_kernel[0][x] + 0.5f)));
    });
  }

  Cell<2> first_, size_;
  int shift_;
  double score_unit_ = 0.0;
  std::vector<std::vector<uint8_t>> levels_;
};

}  // namespace stillmap
