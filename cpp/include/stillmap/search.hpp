// Coarse correlative search: the best poses of a lattice around the prior, scored on a raster of
// the smoothed field. Finds the basins that the Newton steps then descend into.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <vector>

#include "stillmap/raster.hpp"
#include "stillmap/register.hpp"

namespace stillmap {

struct SearchWindow {
  double translation;  // metres, half width along each axis
  double rotation;     // radians, half width about the vertical axis
  double max_range;    // metres, beams beyond are left out of the search
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
      : grid_(grid), prior_(prior), options_(options) {
    // a wide window is searched in steps of two cells: the Newton steps bridge that
    shift_ = window.translation > 4.0 * grid.resolution() ? 1 : 0;
    step_ = grid.resolution() * (1 << shift_);
    shifts_ = static_cast<int32_t>(std::ceil(window.translation / step_));
    std::vector<double> ranges;
    for (size_t n = 0; n < beams.points.size(); ++n) {
      const double range = beams.points[n].norm();
      if (range > window.max_range) continue;
      points_.push_back(beams.points[n]);
      weights_.push_back(static_cast<float>(options.gain * beams.weights[n]));
      ranges.push_back(range);
    }
    if (ranges.empty()) return;
    // turn by no more than moves a typical far beam by one step
    const auto far = ranges.begin() + static_cast<std::ptrdiff_t>((ranges.size() - 1) * 3 / 4);
    std::nth_element(ranges.begin(), far, ranges.end());
    angle_step_ = std::min(step_ / std::max(*far, step_), 0.035);
    angles_ = static_cast<int>(std::ceil(window.rotation / angle_step_));
  }

  // The best poses of the lattice, best first, no two of them in one basin, none much worse than
  // the best; the prior's mean when there is nothing to search.
  std::vector<Candidate<D>> best(size_t wanted) {
    if (points_.empty() || (shifts_ == 0 && angles_ == 0)) return {{prior_.pose, 0.0}};
    make_raster();
    std::vector<Candidate<D>> found;
    for (int a = -angles_; a <= angles_; ++a) found.push_back(best_shift(turned(a)));
    std::stable_sort(found.begin(), found.end(),
                     [](const auto& x, const auto& y) { return x.score > y.score; });
    std::vector<Candidate<D>> kept;
    for (const auto& candidate : found) {
      if (kept.size() == wanted || candidate.score < 0.8 * found.front().score) break;
      if (std::none_of(kept.begin(), kept.end(),
                       [&](const auto& other) { return near(candidate.pose, other.pose); }))
        kept.push_back(candidate);
    }
    return kept.empty() ? std::vector<Candidate<D>>{found.front()} : kept;
  }

  size_t poses_tried() const { return poses_tried_; }

 private:
  bool near(const Pose<D>& a, const Pose<D>& b) const {
    const typename Lie<D>::Tangent d = a.minus(b);
    return d.template head<D>().norm() < 3.0 * step_ &&
           d.template tail<Lie<D>::kRotation>().norm() < 3.0 * angle_step_;
  }

  Pose<D> turned(int a) const {
    typename Lie<D>::Tangent delta = Lie<D>::Tangent::Zero();
    delta[Lie<D>::kDof - 1] = a * angle_step_;
    return prior_.pose.moved(delta);
  }

  Cell<D> pixel_of(const Pose<D>& pose, const Vec<D>& point) const {
    return cell_of<D>((pose * point) / step_);
  }

  void make_raster() {
    Cell<D> low = Cell<D>::Constant(std::numeric_limits<int32_t>::max());
    Cell<D> high = Cell<D>::Constant(std::numeric_limits<int32_t>::min());
    for (int a = -angles_; a <= angles_; ++a) {
      const Pose<D> pose = turned(a);
      for (const auto& p : points_) {
        const Cell<D> pixel = pixel_of(pose, p);
        low = low.cwiseMin(pixel);
        high = high.cwiseMax(pixel);
      }
    }
    const Cell<D> margin = Cell<D>::Constant(shifts_);
    raster_.emplace(grid_, low - margin, high - low + 2 * margin + Cell<D>::Ones(), shift_,
                    options_.field);
  }

  // the best shift of one orientation: the beams add up their windows of the raster
  Candidate<D> best_shift(const Pose<D>& pose) {
    const int32_t edge = 2 * shifts_ + 1;
    scores_.assign(static_cast<size_t>(std::pow(edge, D)), 0.0f);
    const Cell<D> margin = Cell<D>::Constant(shifts_);
    for (size_t n = 0; n < points_.size(); ++n) {
      const Cell<D> centre = pixel_of(pose, points_[n]);
      const Cell<D> low = centre - margin;
      Cell<D> high = centre + margin;
      high[0] = low[0];  // whole rows along x
      float* to = scores_.data();
      for_each_in_box<D>(low, high, [&](const Cell<D>& row) {
        const float* from = raster_->at(row);
        for (int32_t x = 0; x < edge; ++x) to[x] += weights_[n] * from[x];
        to += edge;
      });
    }
    Candidate<D> out{pose, -std::numeric_limits<double>::infinity()};
    size_t i = 0;
    for_each_in_box<D>(-margin, margin, [&](const Cell<D>& shift) {
      Pose<D> candidate = pose;
      candidate.t += shift.template cast<double>() * step_;
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
  std::vector<Vec<D>> points_;
  std::vector<float> weights_;
  int shift_ = 0;  // a step is 2^shift cells
  double step_ = 0.0;
  int32_t shifts_ = 0;
  double angle_step_ = 0.0;
  int angles_ = 0;
  std::optional<Raster<D>> raster_;
  std::vector<float> scores_;
  size_t poses_tried_ = 0;
};

}  // namespace stillmap
