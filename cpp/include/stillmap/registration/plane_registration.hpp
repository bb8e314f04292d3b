// One sweep of a spinning lidar against the map so far: pose and motion during the sweep together,
// beams weighted by e, with a Gaussian prior on both. Minimises over T and the twist xi
//   1/2 d^T Lambda d + gain sum_n e_n v_n rho(r_n^2 / v_n),  y_n = T Exp(tau_n xi) p_n,
// r_n being the distance of y_n from the surface around it, v_n its variance, d = (T, xi) minus
// the prior, all of it in the moving frame; rho(s) = 1/2 s / (1 + s / k^2), Geman and McClure's.
#pragma once

#include <Eigen/Cholesky>
#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "stillmap/registration/ndt_map.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

template <int D>
struct TimedPoints {
  std::vector<Vec<D>> points;  // in the moving frame at the time of each, metres
  std::vector<double> weights;
  std::vector<double> times;  // seconds from the pose
};

// T_map_base and its motion: (velocity, rate of turn) in the moving frame.
template <int D>
struct Moving {
  Pose<D> pose;
  typename Lie<D>::Tangent twist = Lie<D>::Tangent::Zero();
};

template <int D>
struct MovingPrior {
  static constexpr int kSize = 2 * Lie<D>::kDof;
  Moving<D> mean;
  Eigen::Matrix<double, kSize, kSize> information;
};

struct SweepOptions {
  PlaneOptions plane;
  double sigma;   // metres, of a range besides the scatter of the surface
  double kernel;  // standard deviations at which a beam has a quarter of its weight
  double gain;    // how much one beam counts: neighbours share the errors of one surface
  int start_level;
  double start_slack;  // metres, how far off the surfaces may be at first
  int max_iterations;
  double tolerance;  // metres, and radians for a tenth of it, of the last step
};

template <int D>
struct MovingQuadratic {
  static constexpr int kSize = 2 * Lie<D>::kDof;
  Eigen::Matrix<double, kSize, kSize> hessian = Eigen::Matrix<double, kSize, kSize>::Zero();
  Eigen::Matrix<double, kSize, 1> gradient = Eigen::Matrix<double, kSize, 1>::Zero();
  double cost = 0.0;
  double met = 0.0;       // weight of beams that lie on a surface
  double compared = 0.0;  // weight of those that are near one
  double all = 0.0;

  void add(const MovingQuadratic& other) {
    hessian += other.hessian;
    gradient += other.gradient;
    cost += other.cost;
    met += other.met;
    compared += other.compared;
    all += other.all;
  }
};

template <int D>
struct SweepFound {
  Moving<D> moving;
  Eigen::Matrix<double, 2 * Lie<D>::kDof, 2 * Lie<D>::kDof> information;
  MovingQuadratic<D> data;  // where it ended
  int iterations = 0;
};

// How far a steady motion leads: V(w) v with Exp(v, w) = [Exp(w), V(w) v].
template <int D>
inline Vec<D> along(const Vec<D>& v, const Eigen::Matrix<double, Lie<D>::kRotation, 1>& w) {
  if constexpr (D == 2) {
    // the chord of an arc points half the turn to the side and is shorter than the arc
    const double half = 0.5 * w[0];
    const double shorter = std::abs(half) > 1e-9 ? std::sin(half) / half : 1.0;
    return shorter * (Lie<2>::exp_rotation(0.5 * w) * v);
  } else {
    const double angle2 = w.squaredNorm(), angle = std::sqrt(angle2);
    const bool near = angle < 1e-4;  // series are exact below
    const double b = near ? 0.5 : (1.0 - std::cos(angle)) / angle2;
    const double c = near ? 1.0 / 6.0 : (angle - std::sin(angle)) / (angle2 * angle);
    const Vec<3> wv = w.cross(v);
    return v + b * wv + c * w.cross(wv);
  }
}

// Where a point of the moving frame is carried by a twist within tau seconds: Exp(tau xi) p.
template <int D>
inline Vec<D> carried(const typename Lie<D>::Tangent& twist, double tau, const Vec<D>& p) {
  if (tau == 0.0) return p;
  const Eigen::Matrix<double, Lie<D>::kRotation, 1> w =
      tau * twist.template tail<Lie<D>::kRotation>();
  return Lie<D>::exp_rotation(w) * p + along<D>(tau * twist.template head<D>(), w);
}

// T moved in its own frame: t + R dt, R Exp(dr); the twist adds up.
template <int D>
inline Moving<D> moved(const Moving<D>& at,
                       const Eigen::Matrix<double, 2 * Lie<D>::kDof, 1>& step) {
  constexpr int n = Lie<D>::kDof, K = Lie<D>::kRotation;
  Moving<D> out;
  out.pose.t = at.pose.t + at.pose.R * step.template head<D>();
  out.pose.R = at.pose.R * Lie<D>::exp_rotation(step.template segment<K>(D));
  out.twist = at.twist + step.template tail<n>();
  return out;
}

// d such that moved(from, d) = to
template <int D>
inline Eigen::Matrix<double, 2 * Lie<D>::kDof, 1> difference(const Moving<D>& to,
                                                             const Moving<D>& from) {
  constexpr int n = Lie<D>::kDof, K = Lie<D>::kRotation;
  Eigen::Matrix<double, 2 * n, 1> d;
  d.template head<D>() = from.pose.R.transpose() * (to.pose.t - from.pose.t);
  d.template segment<K>(D) = Lie<D>::log_rotation(from.pose.R.transpose() * to.pose.R);
  d.template tail<n>() = to.twist - from.twist;
  return d;
}

// The surface around a place on the finest level, from `level` on, that has one.
template <int D>
inline bool finest_plane(const SweepMap<D>& map, const Vec<D>& place, int level,
                         const PlaneOptions& options, Plane<D>& plane) {
  for (; level < map.levels(); ++level)
    if (map.plane(place, level, options, plane)) return true;
  return false;
}

template <int D>
inline void add_beam(const SweepMap<D>& map, const Vec<D>& point, double weight, double tau,
                     const Moving<D>& at, int level, double slack, const SweepOptions& options,
                     MovingQuadratic<D>& q) {
  constexpr int n = Lie<D>::kDof;
  q.all += weight;
  const Vec<D> p = carried<D>(at.twist, tau, point);
  Plane<D> plane;
  if (!finest_plane<D>(map, at.pose * p, level, options.plane, plane)) return;
  const double r = -plane.offset;
  const double v = plane.variance + options.sigma * options.sigma + slack * slack;
  const double k2 = options.kernel * options.kernel;
  const double s = r * r / v, tamed = 1.0 / (1.0 + s / k2);
  const double w = weight * tamed * tamed / v;  // d rho / d s, twice
  // y = T p moves by R [1, -[p]x] delta with the moving frame: n^T of it is a row in that frame
  const Vec<D> normal = at.pose.R.transpose() * plane.normal;
  const typename Lie<D>::Tangent row = Lie<D>::jacobian(p).transpose() * normal;
  // the twist moves a beam tau times as far as the pose does, to first order in tau xi
  const Eigen::Matrix<double, n, n> H = w * row * row.transpose();
  q.hessian.template topLeftCorner<n, n>() += H;
  q.gradient.template head<n>() += (w * r) * row;
  if (tau != 0.0) {
    q.hessian.template topRightCorner<n, n>() += tau * H;
    q.hessian.template bottomRightCorner<n, n>() += (tau * tau) * H;
    q.gradient.template tail<n>() += (tau * w * r) * row;
  }
  q.cost += 0.5 * weight * s * tamed;
  q.compared += weight;
  if (s < k2) q.met += weight;
}

// The data term alone. Shares of fixed size are added up in order: the same bits from any number
// of threads.
template <int D>
inline MovingQuadratic<D> linearise(const SweepMap<D>& map, const TimedPoints<D>& beams,
                                    const Moving<D>& at, int level, double slack,
                                    const SweepOptions& options, int threads) {
  constexpr size_t share = 256;
  const size_t n = beams.points.size(), shares = (n + share - 1) / share;
  std::vector<MovingQuadratic<D>> parts(shares);
  std::vector<size_t> bounds{0};
  const size_t workers = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1,
                                            std::max<size_t>(shares / 2, 1));
  for (size_t i = 1; i <= workers; ++i) bounds.push_back(shares * i / workers);
  parallel_shares(bounds, [&](size_t, size_t first, size_t last) {
    for (size_t k = first; k < last; ++k)
      for (size_t i = k * share; i < std::min(n, (k + 1) * share); ++i)
        add_beam<D>(map, beams.points[i], beams.weights[i], beams.times[i], at, level, slack,
                    options, parts[k]);
  });
  MovingQuadratic<D> sum;
  for (const auto& part : parts) sum.add(part);
  constexpr int m = Lie<D>::kDof;
  sum.hessian.template bottomLeftCorner<m, m>() =
      sum.hessian.template topRightCorner<m, m>().transpose();
  return sum;
}

// Gauss-Newton steps from `start`: on coarse levels and with slack first, as far as the prior may
// be off; from step to step one level finer, with half the slack.
template <int D>
inline SweepFound<D> register_sweep(const SweepMap<D>& map, const TimedPoints<D>& beams,
                                    const MovingPrior<D>& prior, const Moving<D>& start,
                                    const SweepOptions& options, int threads) {
  constexpr int n = Lie<D>::kDof;
  SweepFound<D> found;
  found.moving = start;
  int level = std::min(options.start_level, map.levels() - 1);
  double slack = options.start_slack;
  for (;;) {
    found.data = linearise<D>(map, beams, found.moving, level, slack, options, threads);
    found.information = options.gain * found.data.hessian + prior.information;
    if (found.iterations == options.max_iterations) break;
    const auto d = difference<D>(found.moving, prior.mean);
    const Eigen::Matrix<double, 2 * n, 1> gradient =
        options.gain * found.data.gradient + prior.information * d;
    const Eigen::Matrix<double, 2 * n, 1> step = -found.information.ldlt().solve(gradient);
    if (!step.allFinite()) break;
    found.moving = moved<D>(found.moving, step);
    ++found.iterations;
    const bool small = step.template head<D>().norm() < options.tolerance &&
                       step.template segment<Lie<D>::kRotation>(D).norm() < 0.1 * options.tolerance;
    if (level == 0 && slack == 0.0 && small) break;
    level = std::max(level - 1, 0);
    slack = slack > options.sigma ? 0.5 * slack : 0.0;
  }
  // a chain of products drifts away from rotations
  found.moving.pose.R = Lie<D>::exp_rotation(Lie<D>::log_rotation(found.moving.pose.R));
  return found;
}

}  // namespace stillmap
