// Support of a surfel by static surfels on a line through it: walls go on, what stands alone does
// not. See docs/estimator.md.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/window_query.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct LineSupportOptions {
  double radius;      // cells, of the surfels that support
  double gap;         // cells, nearer ones belong to the same thing
  double half_width;  // cells, of a line
};

class LineSupport {
 public:
  static constexpr size_t kDirections = 12;  // of lines, over half a turn

  // p_static (E,) of each surfel.
  LineSupport(const SurfelMap<2>& surfel_map, const float* p_static,
              const LineSupportOptions& options)
      : surfel_map_(surfel_map),
        p_static_(p_static),
        reach_(static_cast<int32_t>(std::floor(options.radius))),
        window_(window_rows<2>(options.radius, false)),
        masks_(surfel_map),
        lines_(make_lines(options)) {}

  // (E,) largest sum of P(static) on one of the lines.
  std::vector<float> compute(int threads) const {
    std::vector<float> support(surfel_map_.size());
    parallel_for_ranges(split_evenly(support.size(), threads),
                        [&](size_t, size_t begin, size_t end) {
                          WindowQuery<2> query(surfel_map_, masks_);
                          for (size_t k = begin; k < end; ++k) support[k] = support_of(query, k);
                        });
    return support;
  }

 private:
  // For each offset in the window the lines that it lies on, a bit each.
  std::vector<uint16_t> make_lines(const LineSupportOptions& options) const {
    constexpr double pi = 3.14159265358979323846;
    const auto edge = static_cast<size_t>(2 * reach_ + 1);
    std::vector<uint16_t> lines(edge * edge, 0);
    for (int32_t y = -reach_; y <= reach_; ++y)
      for (int32_t x = -reach_; x <= reach_; ++x) {
        const double distance = std::hypot(x, y);
        if (distance <= 0.0 || distance < options.gap || distance > options.radius) continue;
        for (size_t i = 0; i < kDirections; ++i) {
          const double angle = pi * static_cast<double>(i) / static_cast<double>(kDirections);
          const double across = std::abs(x * std::sin(angle) - y * std::cos(angle));
          if (across < options.half_width)
            lines[index_of(Cell<2>(x, y))] |= static_cast<uint16_t>(1u << i);
        }
      }
    return lines;
  }

  size_t index_of(const Cell<2>& offset) const {
    return static_cast<size_t>((offset[1] + reach_) * (2 * reach_ + 1) + offset[0] + reach_);
  }

  float support_of(WindowQuery<2>& query, size_t k) const {
    const Cell<2> centre = surfel_map_.cell(static_cast<int32_t>(k));
    std::array<float, kDirections> sums{};
    query.for_each(centre, window_, [&](int32_t other) {
      const uint16_t on = lines_[index_of(surfel_map_.cell(other) - centre)];
      if (!on) return;
      const float p = p_static_[static_cast<size_t>(other)];
      for (size_t i = 0; i < kDirections; ++i)
        if (on >> i & 1) sums[i] += p;
    });
    return *std::max_element(sums.begin(), sums.end());
  }

  const SurfelMap<2>& surfel_map_;
  const float* p_static_;
  int32_t reach_;
  CellRows<2> window_;
  RowMasks<2> masks_;
  std::vector<uint16_t> lines_;
};

}  // namespace stillmap
