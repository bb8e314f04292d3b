// Registration of one scan against a likelihood field (9), beams weighted by e, with a Gaussian
// prior. Minimises
//   J(x) = - s sum_n e_n ln((base + F(y_n(x))) / (floor + 1)) + 1/2 |x - x_prior|^2
// in the metric of the prior's information, with s the information scale; base = floor in observed
// space, floor + unknown elsewhere.
#pragma once

#include <Eigen/Cholesky>
#include <Eigen/Eigenvalues>
#include <algorithm>
#include <optional>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/registration/likelihood_field.hpp"
#include "stillmap/registration/surface_information.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

struct WeightedBeams {
  std::vector<Vec<2>> points;  // metres, moving frame
  std::vector<double> weights;
  std::vector<SurfaceNormal> normals;   // moving frame; empty: unknown
  std::vector<GaussianWindow> windows;  // cache, one per beam
  // share of each beam that the map explains at a pose; of the last one that was evaluated
  std::vector<double> explained;
  std::optional<Pose<2>> explained_at;

  bool is_explained_at(const Pose<2>& pose) const {
    return explained_at && explained_at->R == pose.R && explained_at->t == pose.t;
  }
};

struct ScanRegistrationOptions {
  LikelihoodFieldOptions field;
  double information_scale;  // of one beam: neighbouring beams are not independent
  int max_iterations;
};

struct PosePrior {
  Pose<2> pose;
  Eigen::Matrix3d information;
};

struct ScanRegistrationResult {
  Pose<2> pose;
  // of the posterior, by the normals of the surfaces where they are known
  Eigen::Matrix3d information;
  double cost = 0.0;
  double inliers = 0.0;  // weighted share of beams that the map explains
  int iterations = 0;
};

struct QuadraticModel {
  Lie<2>::Tangent gradient = Lie<2>::Tangent::Zero();
  Eigen::Matrix3d hessian = Eigen::Matrix3d::Zero();
  double cost = 0.0;
  double inliers = 0.0;
};

// Projection of a symmetric matrix on to the positive semidefinite ones.
inline Eigen::Matrix2d positive_part(const Eigen::Matrix2d& A) {
  const double mean = 0.5 * (A(0, 0) + A(1, 1));
  const double half = 0.5 * (A(0, 0) - A(1, 1));
  const double half_gap = std::sqrt(half * half + A(0, 1) * A(0, 1));
  const double low = mean - half_gap, high = mean + half_gap;
  if (low >= 0.0) return A;
  if (high <= 0.0) return Eigen::Matrix2d::Zero();
  return (A - low * Eigen::Matrix2d::Identity()) * (high / (high - low));
}

// Negative Hessian of ln F, projected on to the positive semidefinite matrices: sigma^-2 minus the
// covariance of (mu_k - y) / sigma^2, so zero along a wall.
inline Eigen::Matrix2d curvature(const FieldSample& sample, double sigma) {
  Eigen::Matrix2d A = -sample.pull_covariance;
  A.diagonal().array() += 1.0 / (sigma * sigma);
  return positive_part(A);
}

inline QuadraticModel linearise(LikelihoodField& field, WeightedBeams& beams, const Pose<2>& pose,
                                const ScanRegistrationOptions& options) {
  QuadraticModel model;
  beams.windows.resize(beams.points.size());
  beams.explained.assign(beams.points.size(), 0.0);
  beams.explained_at.reset();
  double total = 0.0;
  for (size_t n = 0; n < beams.points.size(); ++n) {
    const double weight = options.information_scale * beams.weights[n];
    const Vec<2> lever = pose.R * beams.points[n];
    const Vec<2> point = pose.t + lever;
    const FieldSample sample = field.evaluate(point, beams.windows[n]);
    total += beams.weights[n];
    model.cost -= weight * std::log((sample.baseline + sample.value) / (options.field.floor + 1.0));
    if (sample.value <= 0.0) continue;
    const double p_explained = sample.value / (sample.baseline + sample.value);
    beams.explained[n] = p_explained;
    const auto J = Lie<2>::jacobian(lever);
    model.inliers += beams.weights[n] * p_explained;
    model.gradient.noalias() -= weight * p_explained * (J.transpose() * sample.log_gradient);
    model.hessian.noalias() +=
        weight * p_explained * (J.transpose() * curvature(sample, options.field.sigma) * J);
  }
  if (total > 0.0) model.inliers /= total;
  beams.explained_at = pose;
  return model;
}

// Information of the beams about the pose by the normals of the surfaces that they see.
inline Eigen::Matrix3d surface_information(LikelihoodField& field, WeightedBeams& beams,
                                           const Pose<2>& pose,
                                           const ScanRegistrationOptions& options) {
  Eigen::Matrix3d information = Eigen::Matrix3d::Zero();
  const double per_beam = options.information_scale / (options.field.sigma * options.field.sigma);
  if (!beams.is_explained_at(pose)) linearise(field, beams, pose, options);
  for (size_t n = 0; n < beams.points.size(); ++n) {
    const double p_explained = beams.explained[n];
    if (p_explained <= 0.0) continue;
    const Vec<2> lever = pose.R * beams.points[n];
    const auto& surface = beams.normals[n];
    information.noalias() += per_beam * beams.weights[n] * p_explained *
                             endpoint_information(lever, pose.R * surface.normal, surface.isotropy);
  }
  return information;
}

// Levenberg-Marquardt from `start`.
inline ScanRegistrationResult minimise_levenberg_marquardt(LikelihoodField& field,
                                                           WeightedBeams& beams,
                                                           const PosePrior& prior,
                                                           const Pose<2>& start,
                                                           const ScanRegistrationOptions& options) {
  auto with_prior = [&](const Pose<2>& pose, double cost) {
    const Lie<2>::Tangent difference = pose.boxminus(prior.pose);
    return cost + 0.5 * difference.dot(prior.information * difference);
  };
  ScanRegistrationResult result;
  result.pose = start;
  QuadraticModel model = linearise(field, beams, start, options);
  result.cost = with_prior(start, model.cost);
  double damping = 1e-3;
  for (; result.iterations < options.max_iterations; ++result.iterations) {
    auto H = (model.hessian + prior.information).eval();
    H.diagonal() *= 1.0 + damping;
    const Lie<2>::Tangent gradient =
        model.gradient + prior.information * result.pose.boxminus(prior.pose);
    const Lie<2>::Tangent delta = -H.ldlt().solve(gradient);
    if (!delta.allFinite()) break;
    const Pose<2> trial = result.pose.boxplus(delta);
    QuadraticModel trial_model = linearise(field, beams, trial, options);
    const double cost = with_prior(trial, trial_model.cost);
    const bool converged = delta.head<2>().norm() < 2e-4 && delta.tail<1>().norm() < 5e-5;
    if (cost <= result.cost) {
      result.pose = trial;
      result.cost = cost;
      model = trial_model;
      damping = std::max(damping * 0.1, 1e-6);
    } else {
      damping = std::max(damping, 1e-3) * 10.0;
    }
    if (converged || damping > 1e6) break;
  }
  result.information = model.hessian + prior.information;
  result.inliers = model.inliers;
  return result;
}

}  // namespace stillmap
