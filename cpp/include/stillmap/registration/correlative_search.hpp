// Correlative search: the best poses of a lattice around the prior, scored on a raster of the
// smoothed field, by branch and bound. Finds the basins that the Newton steps then descend into.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <queue>
#include <vector>

#include "stillmap/registration/field_pyramid.hpp"
#include "stillmap/registration/scan_registration.hpp"

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
      weights_.push_back(static_cast<int32_t>(std::lround(kWeight * beams.weights[n])));
      ranges.push_back(range);
    }
    if (ranges.empty()) return;
    // turn by no more than moves a typical far beam by one step
    const auto far = ranges.begin() + static_cast<std::ptrdiff_t>((ranges.size() - 1) * 3 / 4);
    std::nth_element(ranges.begin(), far, ranges.end());
    angle_step_ = std::min(step_ / std::max(*far, step_), 0.035);
    angles_ = static_cast<int>(std::ceil(window.rotation / angle_step_));
    while (top_ < kLargestTop && (2 << top_) <= shifts_) ++top_;
    const Eigen::Matrix<double, D, D> A = prior.information.template topLeftCorner<D, D>();
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, D, D>> axes(A);
    stiffness_ = std::max(axes.eigenvalues()[0], 0.0);
    toward_ = A.ldlt().solve(prior.information.template topRightCorner<D, 1>());
  }

  // The best poses of the lattice, best first, no two of them in one basin, none much worse than
  // the best; the prior's mean when there is nothing to search.
  std::vector<Candidate<D>> best(size_t wanted) {
    if (points_.empty() || (shifts_ == 0 && angles_ == 0)) return {{prior_.pose, 0.0}};
    lay_out();
    std::vector<Candidate<D>> kept;
    size_t limit = std::numeric_limits<size_t>::max();
    while (!open_.empty() && kept.size() < wanted && poses_tried_ < limit) {
      const Node node = open_.top();
      open_.pop();
      if (!kept.empty() && node.bound < 0.8 * kept.front().score) break;
      if (node.level > 0) {
        branch(node);
        continue;
      }
      const Candidate<D> leaf{pose_at(node), node.bound};
      if (std::any_of(kept.begin(), kept.end(),
                      [&](const auto& other) { return near(leaf.pose, other.pose); }))
        continue;
      kept.push_back(leaf);
      // the others may take as long as the best one did
      if (kept.size() == 1) limit = 2 * poses_tried_;
    }
    return kept;
  }

  size_t poses_tried() const { return poses_tried_; }

 private:
  static constexpr double kWeight = 255.0;
  static constexpr int kLargestTop = 6;

  // all shifts within 2^level steps of `low` along each axis, at one orientation
  struct Node {
    double bound;  // no pose of it has a higher score; at level 0, the score
    int level;
    int angle;
    Cell<D> low;
    size_t order;  // ties are broken by age: the same search takes the same way
    bool operator<(const Node& other) const {
      return bound != other.bound ? bound < other.bound : order > other.order;
    }
  };

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

  Pose<D> pose_at(const Node& node) const {
    Pose<D> pose = turned(node.angle);
    pose.t += node.low.template cast<double>() * step_;
    return pose;
  }

  // the raster around everything that a pose of the window can see, and the widest nodes
  void lay_out() {
    const auto turns = static_cast<size_t>(2 * angles_ + 1);
    std::vector<Cell<D>> pixels;
    pixels.reserve(turns * points_.size());
    Cell<D> low = Cell<D>::Constant(std::numeric_limits<int32_t>::max());
    Cell<D> high = Cell<D>::Constant(std::numeric_limits<int32_t>::min());
    for (int a = -angles_; a <= angles_; ++a) {
      const Pose<D> pose = turned(a);
      for (const auto& p : points_) {
        pixels.push_back(cell_of<D>((pose * p) / step_));
        low = low.cwiseMin(pixels.back());
        high = high.cwiseMax(pixels.back());
      }
    }
    // a node may reach beyond the window
    const Cell<D> before = Cell<D>::Constant(shifts_), after = Cell<D>::Constant(shifts_ + 1);
    raster_.emplace(grid_, low - before, high - low + before + after, shift_, top_, options_.field);
    for (const auto& pixel : pixels) indices_.push_back(raster_->index(pixel));
    const Cell<D> tiles = Cell<D>::Constant(2 * shifts_ >> top_), none = Cell<D>::Zero();
    for (int a = -angles_; a <= angles_; ++a)
      for_each_in_box<D>(none, tiles, [&](const Cell<D>& tile) {
        push(top_, a, (tile.array() * (1 << top_) - shifts_).matrix());
      });
  }

  void branch(const Node& node) {
    const int32_t half = 1 << (node.level - 1);
    for (int child = 0; child < 1 << D; ++child) {
      Cell<D> low = node.low;
      for (int d = 0; d < D; ++d) low[d] += (child >> d & 1) * half;
      if ((low.array() <= shifts_).all()) push(node.level - 1, node.angle, low);
    }
  }

  void push(int level, int angle, const Cell<D>& low) {
    ++poses_tried_;
    const int64_t shift = raster_->offset(low);
    const uint8_t* from = raster_->level(level) + shift;
    const size_t n_points = points_.size();
    const int64_t* at = indices_.data() + static_cast<size_t>(angle + angles_) * n_points;
    int64_t sum = 0;
    for (size_t n = 0; n < n_points; ++n) sum += weights_[n] * from[at[n]];
    const double fit = options_.gain * raster_->unit() / kWeight * static_cast<double>(sum);
    open_.push({fit - least_penalty(level, angle, low), level, angle, low, poses_tried_});
  }

  // 1/2 d^T Lambda d of a pose, or at most that of the poses of a node: with the turn given, what
  // is left is a quadratic form about some shift
  double least_penalty(int level, int angle, const Cell<D>& low) const {
    constexpr int turn = Lie<D>::kDof - 1;
    const double theta = angle * angle_step_;
    Vec<D> shift = low.template cast<double>() * step_;
    const auto A = prior_.information.template topLeftCorner<D, D>();
    const Vec<D> b = prior_.information.template topRightCorner<D, 1>();
    if (level == 0)
      return 0.5 * (shift.dot(A * shift) + 2.0 * theta * shift.dot(b) +
                    theta * theta * prior_.information(turn, turn));
    const Vec<D> across = shift.array() + ((1 << level) - 1) * step_;
    const Vec<D> nearest = (-theta * toward_).cwiseMax(shift).cwiseMin(across);
    return 0.5 * (stiffness_ * (nearest + theta * toward_).squaredNorm() +
                  theta * theta * (prior_.information(turn, turn) - b.dot(toward_)));
  }

  const Grid<D>& grid_;
  const Prior<D>& prior_;
  const RegisterOptions& options_;
  std::vector<Vec<D>> points_;
  std::vector<int32_t> weights_;
  int shift_ = 0;  // a step is 2^shift cells
  double step_ = 0.0;
  int32_t shifts_ = 0;
  double angle_step_ = 0.0;
  int angles_ = 0;
  int top_ = 0;  // level of the widest nodes
  std::optional<Raster<D>> raster_;
  std::vector<int64_t> indices_;  // of every beam's pixel, orientation by orientation
  std::priority_queue<Node> open_;
  Vec<D> toward_;           // shift that the prior goes with a turn, negated, per radian
  double stiffness_ = 0.0;  // its smallest information of a shift
  size_t poses_tried_ = 0;
};

}  // namespace stillmap
