// Correlative scan matching (Olson 2009): best poses on a lattice around the prior, scored on a
// pyramid of the likelihood field by branch and bound. They start the local optimisation.
#pragma once

#include <algorithm>
#include <cmath>
#include <limits>
#include <optional>
#include <queue>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/registration/field_pyramid.hpp"
#include "stillmap/registration/scan_registration.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

struct SearchWindow {
  double translation;  // metres, half width along each axis
  double rotation;     // radians, half width about the vertical axis
  double max_range;    // metres, longer beams are ignored
};

struct Candidate {
  Pose<2> pose;
  double score;
};

class CorrelativeSearch {
 public:
  CorrelativeSearch(const OccupancyGrid<2>& grid, const WeightedBeams& beams,
                    const PosePrior& prior, const SearchWindow& window,
                    const ScanRegistrationOptions& options)
      : grid_(grid), prior_(prior), options_(options) {
    // a wide window is searched in steps of two cells, within reach of the local optimisation
    step_shift_ = window.translation > 4.0 * grid.resolution() ? 1 : 0;
    step_ = grid.resolution() * (1 << step_shift_);
    half_steps_ = static_cast<int32_t>(std::ceil(window.translation / step_));
    std::vector<double> ranges;
    for (size_t n = 0; n < beams.points.size(); ++n) {
      const double range = beams.points[n].norm();
      if (range > window.max_range) continue;
      points_.push_back(beams.points[n]);
      weights_.push_back(static_cast<int32_t>(std::lround(kWeight * beams.weights[n])));
      ranges.push_back(range);
    }
    if (ranges.empty()) return;
    // angle step: moves a far beam (third quartile) by one step
    const auto far_range =
        ranges.begin() + static_cast<std::ptrdiff_t>((ranges.size() - 1) * 3 / 4);
    std::nth_element(ranges.begin(), far_range, ranges.end());
    angle_step_ = std::min(step_ / std::max(*far_range, step_), 0.035);
    half_angles_ = static_cast<int>(std::ceil(window.rotation / angle_step_));
    while (top_level_ < kMaxTopLevel && (2 << top_level_) <= half_steps_) ++top_level_;
    const Eigen::Matrix2d A = prior.information.topLeftCorner<2, 2>();
    const Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen(A);
    min_shift_information_ = std::max(eigen.eigenvalues()[0], 0.0);
    shift_per_turn_ = A.ldlt().solve(prior.information.topRightCorner<2, 1>());
  }

  // Best lattice poses, best first, pairwise in different basins and none below 0.8 of the best
  // score; the prior's mean if the window is empty or no pose stands out.
  std::vector<Candidate> best(size_t max_candidates) {
    if (points_.empty() || (half_steps_ == 0 && half_angles_ == 0)) return {{prior_.pose, 0.0}};
    build_pyramid();
    std::vector<Candidate> candidates;
    size_t limit = kMaxReads / std::max(points_.size(), kMinPoints);
    while (!queue_.empty() && candidates.size() < max_candidates && poses_tried_ < limit) {
      const Node node = queue_.top();
      queue_.pop();
      if (!candidates.empty() && node.bound < 0.8 * candidates.front().score) break;
      if (node.level > 0) {
        branch(node);
        continue;
      }
      const Candidate candidate{pose_at(node), node.bound};
      if (std::any_of(candidates.begin(), candidates.end(),
                      [&](const auto& other) { return is_same_basin(candidate.pose, other.pose); }))
        continue;
      candidates.push_back(candidate);
      // the other candidates may take as many poses as the best one
      if (candidates.size() == 1) limit = std::min(limit, 2 * poses_tried_);
    }
    if (candidates.empty()) candidates.push_back({prior_.pose, 0.0});
    return candidates;
  }

  size_t poses_tried() const { return poses_tried_; }

 private:
  static constexpr double kWeight = 255.0;
  static constexpr int kMaxTopLevel = 6;
  // about a second of reading; in recorded logs few searches take a third of that. With few points
  // they bound the memory of the nodes
  static constexpr size_t kMaxReads = size_t{1} << 30, kMinPoints = 256;

  // All shifts within 2^level steps of `low` along each axis, at one angle.
  struct Node {
    double bound;  // upper bound of the score; at level 0, the score
    int level;
    int angle;
    Cell<2> low;
    size_t order;  // breaks ties by age, for determinism
    bool operator<(const Node& other) const {
      return bound != other.bound ? bound < other.bound : order > other.order;
    }
  };

  bool is_same_basin(const Pose<2>& a, const Pose<2>& b) const {
    const Lie<2>::Tangent d = a.boxminus(b);
    return d.head<2>().norm() < 3.0 * step_ && d.tail<1>().norm() < 3.0 * angle_step_;
  }

  Pose<2> rotated_prior(int a) const {
    Lie<2>::Tangent delta = Lie<2>::Tangent::Zero();
    delta[3 - 1] = a * angle_step_;
    return prior_.pose.boxplus(delta);
  }

  Pose<2> pose_at(const Node& node) const {
    Pose<2> pose = rotated_prior(node.angle);
    pose.t += node.low.cast<double>() * step_;
    return pose;
  }

  // Builds the pyramid over everything that a pose of the window can see, and pushes the root
  // nodes.
  void build_pyramid() {
    const auto turns = static_cast<size_t>(2 * half_angles_ + 1);
    std::vector<Cell<2>> pixels;
    pixels.reserve(turns * points_.size());
    Cell<2> low = Cell<2>::Constant(std::numeric_limits<int32_t>::max());
    Cell<2> high = Cell<2>::Constant(std::numeric_limits<int32_t>::min());
    for (int a = -half_angles_; a <= half_angles_; ++a) {
      const Pose<2> pose = rotated_prior(a);
      for (const auto& p : points_) {
        pixels.push_back(cell_of<2>((pose * p) / step_));
        low = low.cwiseMin(pixels.back());
        high = high.cwiseMax(pixels.back());
      }
    }
    // root nodes may reach beyond the window
    const Cell<2> before = Cell<2>::Constant(half_steps_),
                  after = Cell<2>::Constant(half_steps_ + 1);
    pyramid_.emplace(grid_, low - before, high - low + before + after, step_shift_, top_level_,
                     options_.field);
    for (const auto& pixel : pixels) pixel_indices_.push_back(pyramid_->index(pixel));
    const Cell<2> last_node = Cell<2>::Constant(2 * half_steps_ >> top_level_),
                  none = Cell<2>::Zero();
    for (int a = -half_angles_; a <= half_angles_; ++a)
      for_each_in_box<2>(none, last_node, [&](const Cell<2>& node) {
        push_node(top_level_, a, (node.array() * (1 << top_level_) - half_steps_).matrix());
      });
  }

  void branch(const Node& node) {
    const int32_t half = 1 << (node.level - 1);
    for (int child = 0; child < 4; ++child) {
      Cell<2> low = node.low;
      for (int d = 0; d < 2; ++d) low[d] += (child >> d & 1) * half;
      if ((low.array() <= half_steps_).all()) push_node(node.level - 1, node.angle, low);
    }
  }

  void push_node(int level, int angle, const Cell<2>& low) {
    ++poses_tried_;
    const int64_t shift = pyramid_->offset(low);
    const uint8_t* from = pyramid_->level(level) + shift;
    const size_t n_points = points_.size();
    const int64_t* indices =
        pixel_indices_.data() + static_cast<size_t>(angle + half_angles_) * n_points;
    int64_t sum = 0;
    for (size_t n = 0; n < n_points; ++n) sum += weights_[n] * from[indices[n]];
    const double data_score =
        options_.information_scale * pyramid_->score_unit() / kWeight * static_cast<double>(sum);
    queue_.push({data_score - prior_penalty(level, angle, low), level, angle, low, poses_tried_});
  }

  // 1/2 d^T Lambda d of a pose; for a node a lower bound: at a given angle the rest is a quadratic
  // form about some shift.
  double prior_penalty(int level, int angle, const Cell<2>& low) const {
    constexpr int turn = 3 - 1;
    const double theta = angle * angle_step_;
    Vec<2> shift = low.cast<double>() * step_;
    const auto A = prior_.information.topLeftCorner<2, 2>();
    const Vec<2> b = prior_.information.topRightCorner<2, 1>();
    if (level == 0)
      return 0.5 * (shift.dot(A * shift) + 2.0 * theta * shift.dot(b) +
                    theta * theta * prior_.information(turn, turn));
    const Vec<2> opposite = shift.array() + ((1 << level) - 1) * step_;
    const Vec<2> nearest = (-theta * shift_per_turn_).cwiseMax(shift).cwiseMin(opposite);
    return 0.5 * (min_shift_information_ * (nearest + theta * shift_per_turn_).squaredNorm() +
                  theta * theta * (prior_.information(turn, turn) - b.dot(shift_per_turn_)));
  }

  const OccupancyGrid<2>& grid_;
  const PosePrior& prior_;
  const ScanRegistrationOptions& options_;
  std::vector<Vec<2>> points_;
  std::vector<int32_t> weights_;
  int step_shift_ = 0;  // a step is 2^step_shift_ cells
  double step_ = 0.0;
  int32_t half_steps_ = 0;
  double angle_step_ = 0.0;
  int half_angles_ = 0;
  int top_level_ = 0;  // level of the root nodes
  std::optional<FieldPyramid> pyramid_;
  std::vector<int64_t> pixel_indices_;  // pixel of every beam, angle by angle
  std::priority_queue<Node> queue_;
  Vec<2> shift_per_turn_;               // optimal shift per radian of rotation, negated
  double min_shift_information_ = 0.0;  // smallest eigenvalue of the prior's
  size_t poses_tried_ = 0;
};

}  // namespace stillmap
