// (9): one scan against the map so far, beams weighted by e, with a Gaussian motion prior.
// Minimises  J(x) = - gain sum_n e_n ln((base + F(y_n(x))) / (floor + 1)) + 1/2 |x - x_prior|^2
// in the metric of the prior's information, by Newton steps on the smoothed field; base = floor in
// seen space, floor + unknown elsewhere.
#pragma once

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <vector>

#include "stillmap/registration/likelihood_field.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

template <int D>
struct WeightedBeams {
  std::vector<Vec<D>> points;  // in the moving frame, metres
  std::vector<double> weights;
  std::vector<Neighbourhood<D>> near;  // what each saw of the field last
};

struct RegisterOptions {
  FieldOptions field;
  double gain;  // how much one beam counts: neighbouring beams are not independent
  int max_iterations;
};

template <int D>
struct Prior {
  Pose<D> pose;
  Eigen::Matrix<double, Lie<D>::kDof, Lie<D>::kDof> information;
};

template <int D>
struct Registration {
  Pose<D> pose;
  Eigen::Matrix<double, Lie<D>::kDof, Lie<D>::kDof> information;  // of the posterior
  double cost = 0.0;
  double inliers = 0.0;  // weighted share of beams that the map explains
  int iterations = 0;
};

template <int D>
struct Quadratic {
  typename Lie<D>::Tangent gradient = Lie<D>::Tangent::Zero();
  Eigen::Matrix<double, Lie<D>::kDof, Lie<D>::kDof> hessian =
      Eigen::Matrix<double, Lie<D>::kDof, Lie<D>::kDof>::Zero();
  double cost = 0.0;
  double inliers = 0.0;
};

// A symmetric matrix without its negative part.
template <int D>
inline Eigen::Matrix<double, D, D> without_negative(const Eigen::Matrix<double, D, D>& A) {
  if constexpr (D == 2) {
    const double middle = 0.5 * (A(0, 0) + A(1, 1));
    const double half = 0.5 * (A(0, 0) - A(1, 1));
    const double apart = std::sqrt(half * half + A(0, 1) * A(0, 1));
    const double low = middle - apart, high = middle + apart;
    if (low >= 0.0) return A;
    if (high <= 0.0) return Eigen::Matrix2d::Zero();
    return (A - low * Eigen::Matrix2d::Identity()) * (high / (high - low));
  } else {
    Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, D, D>> eigen;
    eigen.computeDirect(A);
    const Vec<D> kept = eigen.eigenvalues().cwiseMax(0.0);
    return eigen.eigenvectors() * kept.asDiagonal() * eigen.eigenvectors().transpose();
  }
}

// The curvature of ln F across a wall and none along it: sigma^-2 minus the spread of the means,
// without its negative part.
template <int D>
inline Eigen::Matrix<double, D, D> curvature(const FieldValue<D>& f, double sigma) {
  Eigen::Matrix<double, D, D> A = -f.spread;
  A.diagonal().array() += 1.0 / (sigma * sigma);
  return without_negative<D>(A);
}

template <int D>
inline Quadratic<D> linearise(Field<D>& field, WeightedBeams<D>& beams, const Pose<D>& pose,
                              const RegisterOptions& options) {
  Quadratic<D> q;
  beams.near.resize(beams.points.size());
  double total = 0.0;
  for (size_t n = 0; n < beams.points.size(); ++n) {
    const double w = options.gain * beams.weights[n];
    const Vec<D> arm = pose.R * beams.points[n];
    const FieldValue<D> f = field.evaluate(pose.t + arm, beams.near[n]);
    total += beams.weights[n];
    q.cost -= w * std::log((f.base + f.value) / (options.field.floor + 1.0));
    if (f.value <= 0.0) continue;
    const double explained = f.value / (f.base + f.value);
    const auto J = Lie<D>::jacobian(arm);
    q.inliers += beams.weights[n] * explained;
    q.gradient.noalias() -= w * explained * (J.transpose() * f.pull);
    q.hessian.noalias() +=
        w * explained * (J.transpose() * curvature<D>(f, options.field.sigma) * J);
  }
  if (total > 0.0) q.inliers /= total;
  return q;
}

// Damped Newton steps from `start`; never ends at a higher cost than it began.
template <int D>
inline Registration<D> climb(Field<D>& field, WeightedBeams<D>& beams, const Prior<D>& prior,
                             const Pose<D>& start, const RegisterOptions& options) {
  auto with_prior = [&](const Pose<D>& pose, double cost) {
    const typename Lie<D>::Tangent d = pose.minus(prior.pose);
    return cost + 0.5 * d.dot(prior.information * d);
  };
  Registration<D> out;
  out.pose = start;
  Quadratic<D> q = linearise<D>(field, beams, start, options);
  out.cost = with_prior(start, q.cost);
  double damping = 1e-3;
  for (; out.iterations < options.max_iterations; ++out.iterations) {
    auto H = (q.hessian + prior.information).eval();
    H.diagonal() *= 1.0 + damping;
    const typename Lie<D>::Tangent gradient =
        q.gradient + prior.information * out.pose.minus(prior.pose);
    const typename Lie<D>::Tangent delta = -H.ldlt().solve(gradient);
    if (!delta.allFinite()) break;
    const Pose<D> trial = out.pose.moved(delta);
    Quadratic<D> at_trial = linearise<D>(field, beams, trial, options);
    const double cost = with_prior(trial, at_trial.cost);
    const bool small = delta.template head<D>().norm() < 2e-4 &&
                       delta.template tail<Lie<D>::kRotation>().norm() < 5e-5;
    if (cost <= out.cost) {
      out.pose = trial;
      out.cost = cost;
      q = at_trial;
      damping = std::max(damping * 0.1, 1e-6);
    } else {
      damping = std::max(damping, 1e-3) * 10.0;
    }
    if (small || damping > 1e6) break;
  }
  out.information = q.hessian + prior.information;
  out.inliers = q.inliers;
  return out;
}

}  // namespace stillmap
