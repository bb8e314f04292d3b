// Point-to-plane registration of a lidar sweep against an NDT map: pose T and twist xi together.
// Minimises
//   1/2 d^T Lambda d + s sum_n e_n v_n rho(r_n^2 / v_n),  y_n = T Exp(tau_n xi) p_n,
// with s the information scale, r_n the distance of y_n from the plane around it, v_n its variance,
// d = (T, xi) boxminus the prior in the moving frame, and rho(u) = 1/2 u / (1 + u / k^2) the
// Geman-McClure kernel.
#pragma once

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/registration/ndt_map.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

template <int D>
struct TimedPoints {
  std::vector<Vec<D>> points;  // metres, moving frame at the time of each
  std::vector<double> weights;
  std::vector<double> times;  // seconds since the pose
};

// T_map_base and the twist (velocity, angular velocity) in the moving frame.
template <int D>
struct MotionState {
  Pose<D> pose;
  typename Lie<D>::Tangent twist = Lie<D>::Tangent::Zero();
};

template <int D>
struct MotionPrior {
  static constexpr int kSize = 2 * Lie<D>::kDof;
  MotionState<D> mean;
  Eigen::Matrix<double, kSize, kSize> information;
};

struct PlaneRegistrationOptions {
  PlaneOptions plane;
  double sigma;              // metres, range noise in addition to the plane's
  double kernel_width;       // k, in standard deviations: a beam there has a quarter of its weight
  double information_scale;  // of one beam: beams on one surface have correlated errors
  int start_level;
  double start_slack;  // metres, additional standard deviation in the first iteration
  int max_iterations;
  double tolerance;  // of the last step: metres, and 10 times radians
};

template <int D>
struct MotionQuadratic {
  static constexpr int kSize = 2 * Lie<D>::kDof;
  Eigen::Matrix<double, kSize, kSize> hessian = Eigen::Matrix<double, kSize, kSize>::Zero();
  Eigen::Matrix<double, kSize, 1> gradient = Eigen::Matrix<double, kSize, 1>::Zero();
  double cost = 0.0;
  double inlier_weight = 0.0;   // weight of beams within the kernel width of a plane
  double matched_weight = 0.0;  // weight of beams with a plane
  double total_weight = 0.0;

  void add(const MotionQuadratic& other) {
    hessian += other.hessian;
    gradient += other.gradient;
    cost += other.cost;
    inlier_weight += other.inlier_weight;
    matched_weight += other.matched_weight;
    total_weight += other.total_weight;
  }
};

template <int D>
struct PlaneRegistrationResult {
  MotionState<D> state;
  Eigen::Matrix<double, 2 * Lie<D>::kDof, 2 * Lie<D>::kDof> information;
  MotionQuadratic<D> model;  // data term at the result
  int iterations = 0;
};

// V(w) v, the translation of Exp(v, w).
template <int D>
inline Vec<D> integrate_velocity(const Vec<D>& v,
                                 const Eigen::Matrix<double, Lie<D>::kRotation, 1>& w) {
  if constexpr (D == 2) {
    // the chord of an arc is turned by half the angle and shorter than the arc
    const double half = 0.5 * w[0];
    const double chord_ratio = std::abs(half) > 1e-9 ? std::sin(half) / half : 1.0;
    return chord_ratio * (Lie<2>::exp_rotation(0.5 * w) * v);
  } else {
    const double angle2 = w.squaredNorm(), angle = std::sqrt(angle2);
    const bool is_small = angle < 1e-4;  // series are exact below
    const double b = is_small ? 0.5 : (1.0 - std::cos(angle)) / angle2;
    const double c = is_small ? 1.0 / 6.0 : (angle - std::sin(angle)) / (angle2 * angle);
    const Vec<3> wv = w.cross(v);
    return v + b * wv + c * w.cross(wv);
  }
}

// Exp(tau xi) p: a point carried along by a twist for tau seconds.
template <int D>
inline Vec<D> transform_by_twist(const typename Lie<D>::Tangent& twist, double tau,
                                 const Vec<D>& p) {
  if (tau == 0.0) return p;
  const Eigen::Matrix<double, Lie<D>::kRotation, 1> w =
      tau * twist.template tail<Lie<D>::kRotation>();
  return Lie<D>::exp_rotation(w) * p + integrate_velocity<D>(tau * twist.template head<D>(), w);
}

// Retraction in the moving frame: t + R dt, R Exp(dr); the twist is added.
template <int D>
inline MotionState<D> boxplus(const MotionState<D>& state,
                              const Eigen::Matrix<double, 2 * Lie<D>::kDof, 1>& step) {
  constexpr int n = Lie<D>::kDof, K = Lie<D>::kRotation;
  MotionState<D> out;
  out.pose.t = state.pose.t + state.pose.R * step.template head<D>();
  out.pose.R = state.pose.R * Lie<D>::exp_rotation(step.template segment<K>(D));
  out.twist = state.twist + step.template tail<n>();
  return out;
}

// d with boxplus(from, d) = to.
template <int D>
inline Eigen::Matrix<double, 2 * Lie<D>::kDof, 1> boxminus(const MotionState<D>& to,
                                                           const MotionState<D>& from) {
  constexpr int n = Lie<D>::kDof, K = Lie<D>::kRotation;
  Eigen::Matrix<double, 2 * n, 1> d;
  d.template head<D>() = from.pose.R.transpose() * (to.pose.t - from.pose.t);
  d.template segment<K>(D) = Lie<D>::log_rotation(from.pose.R.transpose() * to.pose.R);
  d.template tail<n>() = to.twist - from.twist;
  return d;
}

// Plane on the finest level that has one, starting at `level`.
template <int D>
inline bool find_finest_plane(const NdtMap<D>& map, const Vec<D>& position, int level,
                              const PlaneOptions& options, Plane<D>& plane) {
  for (; level < map.levels(); ++level)
    if (map.fit_plane(position, level, options, plane)) return true;
  return false;
}

template <int D>
inline void add_beam(const NdtMap<D>& map, const Vec<D>& point, double weight, double tau,
                     const MotionState<D>& state, int level, double slack,
                     const PlaneRegistrationOptions& options, MotionQuadratic<D>& model) {
  constexpr int n = Lie<D>::kDof;
  model.total_weight += weight;
  const Vec<D> p = transform_by_twist<D>(state.twist, tau, point);
  Plane<D> plane;
  if (!find_finest_plane<D>(map, state.pose * p, level, options.plane, plane)) return;
  const double r = -plane.offset;
  const double v = plane.variance + options.sigma * options.sigma + slack * slack;
  const double k2 = options.kernel_width * options.kernel_width;
  const double s = r * r / v, kernel_weight = 1.0 / (1.0 + s / k2);
  const double w = weight * kernel_weight * kernel_weight / v;  // 2 d rho / d s
  // d y = R [1, -[p]x] delta in the moving frame, so the row is n^T of it
  const Vec<D> normal = state.pose.R.transpose() * plane.normal;
  const typename Lie<D>::Tangent jacobian = Lie<D>::jacobian(p).transpose() * normal;
  // d y / d twist = tau d y / d pose, to first order in tau xi
  const Eigen::Matrix<double, n, n> H = w * jacobian * jacobian.transpose();
  model.hessian.template topLeftCorner<n, n>() += H;
  model.gradient.template head<n>() += (w * r) * jacobian;
  if (tau != 0.0) {
    model.hessian.template topRightCorner<n, n>() += tau * H;
    model.hessian.template bottomRightCorner<n, n>() += (tau * tau) * H;
    model.gradient.template tail<n>() += (tau * w * r) * jacobian;
  }
  model.cost += 0.5 * weight * s * kernel_weight;
  model.matched_weight += weight;
  if (s < k2) model.inlier_weight += weight;
}

// Normal equations of the data term. Chunks of fixed size are summed in order, so the result does
// not depend on the number of threads.
template <int D>
inline MotionQuadratic<D> linearise(const NdtMap<D>& map, const TimedPoints<D>& beams,
                                    const MotionState<D>& state, int level, double slack,
                                    const PlaneRegistrationOptions& options, int threads) {
  constexpr size_t kChunk = 256;
  const size_t n = beams.points.size(), n_chunks = (n + kChunk - 1) / kChunk;
  std::vector<MotionQuadratic<D>> partial_models(n_chunks);
  std::vector<size_t> bounds{0};
  const size_t workers = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1,
                                            std::max<size_t>(n_chunks / 2, 1));
  for (size_t i = 1; i <= workers; ++i) bounds.push_back(n_chunks * i / workers);
  parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
    for (size_t k = first; k < last; ++k)
      for (size_t i = k * kChunk; i < std::min(n, (k + 1) * kChunk); ++i)
        add_beam<D>(map, beams.points[i], beams.weights[i], beams.times[i], state, level, slack,
                    options, partial_models[k]);
  });
  MotionQuadratic<D> sum;
  for (const auto& partial : partial_models) sum.add(partial);
  constexpr int m = Lie<D>::kDof;
  sum.hessian.template bottomLeftCorner<m, m>() =
      sum.hessian.template topRightCorner<m, m>().transpose();
  return sum;
}

// Gauss-Newton from `start`, coarse to fine: each iteration goes one level finer and halves the
// slack.
template <int D>
inline PlaneRegistrationResult<D> register_sweep(const NdtMap<D>& map, const TimedPoints<D>& beams,
                                                 const MotionPrior<D>& prior,
                                                 const MotionState<D>& start,
                                                 const PlaneRegistrationOptions& options,
                                                 int threads) {
  constexpr int n = Lie<D>::kDof;
  PlaneRegistrationResult<D> result;
  result.state = start;
  int level = std::min(options.start_level, map.levels() - 1);
  double slack = options.start_slack;
  for (;;) {
    result.model = linearise<D>(map, beams, result.state, level, slack, options, threads);
    result.information = options.information_scale * result.model.hessian + prior.information;
    if (result.iterations == options.max_iterations) break;
    const auto d = boxminus<D>(result.state, prior.mean);
    const Eigen::Matrix<double, 2 * n, 1> gradient =
        options.information_scale * result.model.gradient + prior.information * d;
    const Eigen::Matrix<double, 2 * n, 1> step = -result.information.ldlt().solve(gradient);
    if (!step.allFinite()) break;
    result.state = boxplus<D>(result.state, step);
    ++result.iterations;
    const bool converged =
        step.template head<D>().norm() < options.tolerance &&
        step.template segment<Lie<D>::kRotation>(D).norm() < 0.1 * options.tolerance;
    if (level == 0 && slack == 0.0 && converged) break;
    level = std::max(level - 1, 0);
    slack = slack > options.sigma ? 0.5 * slack : 0.0;
  }
  // re-orthogonalise after a chain of products
  result.state.pose.R = Lie<D>::exp_rotation(Lie<D>::log_rotation(result.state.pose.R));
  return result;
}

}  // namespace stillmap
