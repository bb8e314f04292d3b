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

// ln((base + F) / floor) at the cells of a box, F being the largest single contribution.
template <int D>
class Raster {
 public:
  Raster(const Grid<D>& grid, const Cell<D>& first, const Cell<D>& size,
         const FieldOptions& options)
      : first_(first),
        size_(size),
        values_(static_cast<size_t>(size.template cast<int64_t>().prod()), 0.0f) {
    // a little wider than the field that is climbed: cells stand for their whole area here
    const double sigma_cells = 1.5 * options.sigma / grid.resolution();
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
    std::vector<float> base(values_.size(), static_cast<float>(options.floor + options.unknown));
    for_each_in_box(Grid<D>::block_of(first), Grid<D>::block_of(first + size),
                    [&](const Cell<D>& b) {
                      const auto* block = grid.find(b);
                      if (!block) return;
                      for (int i = 0; i < Grid<D>::kCells; ++i) {
                        const Counts& c = block->counts[static_cast<size_t>(i)];
                        const Cell<D> cell = Grid<D>::cell_at(block->origin, i);
                        if (c.alpha + c.beta > 0 && contains(cell))
                          base[static_cast<size_t>(at(cell) - values_.data())] =
                              static_cast<float>(options.floor);
                      }
                    });
    const auto floor = static_cast<float>(options.floor);
    for (size_t i = 0; i < values_.size(); ++i)
      values_[i] = std::log((base[i] + values_[i]) / floor);
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

  bool contains(const Cell<D>& cell) const {
    return (cell.array() >= first_.array()).all() &&
           (cell.array() < (first_ + size_).array()).all();
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
struct Candidate {
  Pose<D> pose;
  double score;
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

  // The best poses of the lattice, best first, no two of them neighbours; the prior's mean when
  // there is nothing to search.
  std::vector<Candidate<D>> best(size_t wanted) {
    if (beams_.points.empty() || (shifts_ == 0 && angles_ == 0)) return {{prior_.pose, 0.0}};
    make_raster();
    std::vector<Candidate<D>> found;
    for (int a = -angles_; a <= angles_; ++a) found.push_back(best_shift(turned(a)));
    std::stable_sort(found.begin(), found.end(),
                     [](const auto& x, const auto& y) { return x.score > y.score; });
    std::vector<Candidate<D>> kept;
    for (const auto& candidate : found) {
      if (kept.size() == wanted) break;
      if (std::none_of(kept.begin(), kept.end(),
                       [&](const auto& other) { return near(candidate.pose, other.pose); }))
        kept.push_back(candidate);
    }
    return kept;
  }

  size_t poses_tried() const { return poses_tried_; }

 private:
  // within the basin of the Newton steps of each other
  bool near(const Pose<D>& a, const Pose<D>& b) const {
    const typename Lie<D>::Tangent d = a.minus(b);
    return d.template head<D>().norm() < 3.0 * grid_.resolution() &&
           d.template tail<Lie<D>::kRotation>().norm() < 3.0 * angle_step_;
  }

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
                         options_.field);
  }

  // the best shift of one orientation: the beams add up their windows of the raster
  Candidate<D> best_shift(const Pose<D>& pose) {
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
    Candidate<D> out{pose, -std::numeric_limits<double>::infinity()};
    size_t i = 0;
    Raster<D>::for_each_in_box(-margin, margin, [&](const Cell<D>& shift) {
      Pose<D> candidate = pose;
      candidate.t += shift.template cast<double>() * grid_.resolution();
      const typename Lie<D>::Tangent d = candidate.minus(prior_.pose);
      const double score = static_cast<double>(scores_[i++]) - 0.5 * d.dot(prior_.information * d);
      if (score > out.score) out = {candidate, score};
    });
    poses_tried_ += i;
    return out;
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
  size_t poses_tried_ = 0;
};

}  // namespace stillmap
