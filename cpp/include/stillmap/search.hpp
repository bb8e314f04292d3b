// Coarse correlative search: the best pose of a lattice around the prior, scored on a raster of
// the smoothed field. Finds the basin that the Newton steps then descend into.
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "stillmap/register.hpp"

namespace stillmap {

struct SearchWindow {
  double translation;  // metres, half width along each axis
  double rotation;     // radians, half width about the vertical axis
  double max_range;    // metres, beams beyond are left out of the search
};

// ln((floor + F) / floor) at the cells of a box, F being the largest single contribution.
template <int D>
class Raster {
 public:
  Raster(const Grid<D>& grid, const Cell<D>& first, const Cell<D>& size, double sigma, double floor)
      : first_(first),
        size_(size),
        values_(static_cast<size_t>(size.template cast<int64_t>().prod()), 0.0f) {
    const double sigma_cells = sigma / grid.resolution();
    const int reach = static_cast<int>(std::ceil(2.0 * sigma_cells));
    make_kernel(sigma_cells, reach);
    const Cell<D> margin = Cell<D>::Constant(reach);
    const Cell<D> low = Grid<D>::block_of(first - margin);
    const Cell<D> high = Grid<D>::block_of(first + size + margin);
    for_each_in_box(low, high, [&](const Cell<D>& b) {
      const auto* block = grid.find(b);
      if (!block || !block->moments) return;
      for (int i = 0; i < Grid<D>::kCells; ++i) {
        const Counts& c = block->counts[static_cast<size_t>(i)];
        if (c.alpha > 0) splat(Grid<D>::cell_at(block->origin, i), reach, occupancy(c));
      }
    });
    for (float& v : values_)
      if (v > 0.0f) v = static_cast<float>(std::log((floor + static_cast<double>(v)) / floor));
  }

  // x runs fastest; `cell` must lie in the box
  const float* at(const Cell<D>& cell) const {
    int64_t index = 0;
    for (int d = D - 1; d >= 0; --d) index = index * size_[d] + (cell[d] - first_[d]);
    return values_.data() + index;
  }

  template <class Visit>
  static void for_each_in_box(const Cell<D>& low, const Cell<D>& high, Visit&& visit) {
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

 private:
  void make_kernel(double sigma_cells, int reach) {
    for_each_in_box(Cell<D>::Constant(-reach), Cell<D>::Constant(reach), [&](const Cell<D>& o) {
      const double g =
          std::exp(-0.5 * o.template cast<double>().squaredNorm() / (sigma_cells * sigma_cells));
      kernel_.push_back(static_cast<float>(g));
    });
  }

  void splat(const Cell<D>& cell, int reach, double m) {
    const Cell<D> low = (cell.array() - reach).max(first_.array()).matrix();
    const Cell<D> high = (cell.array() + reach).min((first_ + size_).array() - 1).matrix();
    if ((low.array() > high.array()).any()) return;
    const int edge = 2 * reach + 1;
    const auto weight = static_cast<float>(m);
    // rows along x, so that the inner loop is contiguous
    Cell<D> row_high = high;
    row_high[0] = low[0];
    for_each_in_box(low, row_high, [&](const Cell<D>& row) {
      float* to = const_cast<float*>(at(row));
      int64_t k = 0;
      for (int d = D - 1; d >= 0; --d) k = k * edge + (row[d] - cell[d] + reach);
      const float* from = kernel_.data() + k;
      for (int32_t x = 0; x <= high[0] - low[0]; ++x) to[x] = std::max(to[x], weight * from[x]);
    });
  }

  Cell<D> first_, size_;
  std::vector<float> values_;
  std::vector<float> kernel_;
};

template <int D>
struct SearchResult {
  Pose<D> pose;
  size_t candidates = 0;
};

template <int D>
class CorrelativeSearch {
 public:
  CorrelativeSearch(const Grid<D>& grid, const WeightedBeams<D>& beams, const Prior<D>& prior,
                    const SearchWindow& window, const RegisterOptions& options)
      : grid_(grid), prior_(prior), options_(options), scale_(1.0 / grid.resolution()) {
    // cells of the raster that a shift may reach
    shifts_ = static_cast<int32_t>(std::ceil(window.translation * scale_));
    double reach = 0.0;
    std::vector<double> ranges;
    for (size_t n = 0; n < beams.points.size(); ++n) {
      const double range = beams.points[n].norm();
      if (range > window.max_range || beams.weights[n] <= 0.0) continue;
      beams_.points.push_back(beams.points[n]);
      beams_.weights.push_back(options.gain * beams.weights[n]);
      ranges.push_back(range);
      reach = std::max(reach, range);
    }
    if (ranges.empty()) return;
    // turn by no more than moves a typical far beam by one cell
    const auto far = ranges.begin() + static_cast<std::ptrdiff_t>((ranges.size() - 1) * 3 / 4);
    std::nth_element(ranges.begin(), far, ranges.end());
    angle_step_ = std::min(grid.resolution() / std::max(*far, grid.resolution()), 0.035);
    angles_ = static_cast<int>(std::ceil(window.rotation / angle_step_));
  }

  SearchResult<D> best() {
    SearchResult<D> out;
    out.pose = prior_.pose;
    if (beams_.points.empty() || (shifts_ == 0 && angles_ == 0)) return out;
    make_raster();
    double best_score = -std::numeric_limits<double>::infinity();
    for (int a = -angles_; a <= angles_; ++a) score_angle(a, best_score, out);
    return out;
  }

 private:
  Pose<D> turned(int a) const {
    typename Lie<D>::Tangent delta = Lie<D>::Tangent::Zero();
    delta[Lie<D>::kDof - 1] = a * angle_step_;
    return prior_.pose.moved(delta);
  }

  void make_raster() {
    Cell<D> low = Cell<D>::Constant(std::numeric_limits<int32_t>::max());
    Cell<D> high = Cell<D>::Constant(std::numeric_limits<int32_t>::min());
    for (int a = -angles_; a <= angles_; ++a) {
      const Pose<D> pose = turned(a);
      for (const auto& p : beams_.points) {
        const Cell<D> cell = cell_of<D>((pose * p) * scale_);
        low = low.cwiseMin(cell);
        high = high.cwiseMax(cell);
      }
    }
    const Cell<D> margin = Cell<D>::Constant(shifts_);
    raster_.emplace_back(grid_, low - margin, high - low + 2 * margin + Cell<D>::Ones(),
                         1.5 * options_.field.sigma, options_.floor);
  }

  // every shift of one orientation: the beams add their windows of the raster
  void score_angle(int a, double& best_score, SearchResult<D>& out) {
    const Pose<D> pose = turned(a);
    const int32_t edge = 2 * shifts_ + 1;
    scores_.assign(static_cast<size_t>(std::pow(edge, D)), 0.0f);
    const Cell<D> margin = Cell<D>::Constant(shifts_);
    for (size_t n = 0; n < beams_.points.size(); ++n) {
      const Cell<D> centre = cell_of<D>((pose * beams_.points[n]) * scale_);
      const auto w = static_cast<float>(beams_.weights[n]);
      Cell<D> low = centre - margin, high = centre + margin;
      high[0] = low[0];
      float* to = scores_.data();
      Raster<D>::for_each_in_box(low, high, [&](const Cell<D>& row) {
        const float* from = raster_.back().at(row);
        for (int32_t x = 0; x < edge; ++x) to[x] += w * from[x];
        to += edge;
      });
    }
    size_t i = 0;
    Raster<D>::for_each_in_box(-margin, margin, [&](const Cell<D>& shift) {
      Pose<D> candidate = pose;
      candidate.t += shift.template cast<double>() * grid_.resolution();
      const typename Lie<D>::Tangent d = candidate.minus(prior_.pose);
      const double score = static_cast<double>(scores_[i++]) - 0.5 * d.dot(prior_.information * d);
      if (score > best_score) {
        best_score = score;
        out.pose = candidate;
      }
    });
    out.candidates += i;
  }

  const Grid<D>& grid_;
  const Prior<D>& prior_;
  const RegisterOptions& options_;
  double scale_;
  WeightedBeams<D> beams_;
  int32_t shifts_ = 0;
  double angle_step_ = 0.0;
  int angles_ = 0;
  std::vector<Raster<D>> raster_;
  std::vector<float> scores_;
};

}  // namespace stillmap
