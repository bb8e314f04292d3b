// Likelihood field (Thrun et al. 2005, ch. 6.4) as a mixture of Gaussians: one per cell at the mean
// of its end points, weighted by its occupancy (15), so cells that beams also passed through weigh
// less.
#pragma once

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_walker.hpp"

namespace stillmap {

constexpr double kPi = 3.14159265358979323846;

struct LikelihoodFieldOptions {
  double sigma;    // metres, standard deviation of the Gaussians
  int radius;      // cells, radius of the window of Gaussians
  double floor;    // value in free space; a wall has 1
  double unknown;  // added to the floor in unobserved space
};

struct FieldSample {
  double value = 0.0;     // F(y), about 1 on a wall
  double baseline = 0.0;  // of an unexplained end point: floor (+ unknown if unobserved)
  Vec<2> log_gradient = Vec<2>::Zero();  // gradient of ln F: mean of (mu_k - y) / sigma^2, 1/m
  // Covariance of (mu_k - y) / sigma^2: cancels sigma^-2 along a wall, where F is constant.
  Eigen::Matrix2d pull_covariance = Eigen::Matrix2d::Zero();
};

// Gaussians around one cell, cached for a beam while its end point stays in the cell.
struct GaussianWindow {
  struct Gaussian {
    Vec<2> mean;    // cells
    double weight;  // m_k, OccupancyGrid::occupancy_ignoring_approach
  };
  Cell<2> centre = Cell<2>::Zero();
  bool valid = false;
  bool observed = false;
  bool is_planar = false;               // the means lie on a line or plane
  Vec<2> normal = Vec<2>::Zero();       // of that plane
  Vec<2> plane_point = Vec<2>::Zero();  // on that plane, in cells
  double mean_occupancy = 0.0;          // of the cells
  double baseline = 0.0;
  std::vector<Gaussian> gaussians;
};

class LikelihoodField {
 public:
  LikelihoodField(const OccupancyGrid<2>& grid, const LikelihoodFieldOptions& options)
      : cursor_(grid), options_(options), resolution_(grid.resolution()) {
    if (!(options.sigma > 0.0)) throw std::invalid_argument("sigma: expected a positive length");
    if (!(options.floor > 0.0)) throw std::invalid_argument("floor: expected a positive number");
    if (!(options.unknown >= 0.0))
      throw std::invalid_argument("unknown: expected a number that is not negative");
    if (options.radius < 0 || options.radius > 64)
      throw std::invalid_argument("radius: expected 0 to 64 cells");
    const double sigma_cells = options.sigma / resolution_;
    // The truncation at the radius reduces the variance below sigma^2; corrected so that the
    // curvature along a uniform wall cancels exactly.
    const double cut = (options.radius + 0.5) / sigma_cells;
    const double density = std::exp(-0.5 * cut * cut) / std::sqrt(2.0 * kPi);
    truncated_variance_ = 1.0 - 2.0 * cut * density / std::erf(cut / std::sqrt(2.0));
    exponent_ = -0.5 / (sigma_cells * sigma_cells);
    // F = 1 on a straight wall of fully occupied cells
    norm_ = 1.0 / (std::sqrt(2.0 * kPi) * sigma_cells);
  }

  FieldSample evaluate(const Vec<2>& point, GaussianWindow& window) {
    FieldSample sample;
    sample.baseline = options_.floor;
    const Vec<2> y = point / resolution_;
    if (!gather_around(y, window)) return sample;
    sample.baseline = window.baseline;
    if (!window.observed && window.is_planar) return extrapolate(y, window);
    double sum = 0.0;
    Vec<2> first = Vec<2>::Zero();
    Eigen::Matrix2d second = Eigen::Matrix2d::Zero();
    for (const auto& gaussian : window.gaussians) {
      const Vec<2> to_mean = gaussian.mean - y;
      const double weight = gaussian.weight * std::exp(exponent_ * to_mean.squaredNorm());
      sum += weight;
      first += weight * to_mean;
      second.noalias() += weight * to_mean * to_mean.transpose();
    }
    if (sum <= 0.0) return sample;
    const double per_metre2 = 1.0 / (options_.sigma * options_.sigma);
    first /= sum;
    sample.value = sum * norm_;
    sample.log_gradient = first * (per_metre2 * resolution_);
    const double covariance_scale =
        per_metre2 * per_metre2 * resolution_ * resolution_ / truncated_variance_;
    sample.pull_covariance = (second / sum - first * first.transpose()) * covariance_scale;
    return sample;
  }

 private:
  // Fills the window of a point in cells; false where the point is out of range.
  bool gather_around(const Vec<2>& y, GaussianWindow& window) {
    if (!all_below<2>(y, BlockLayout<2>::kMaxCell - 64)) return false;
    gather_gaussians(cell_of<2>(y), window);
    return true;
  }

  // Extends a surface into unobserved space: the end of the mapped part must not pull scans along
  // it.
  FieldSample extrapolate(const Vec<2>& y, const GaussianWindow& window) const {
    FieldSample sample;
    sample.baseline = window.baseline;
    const double distance = window.normal.dot(window.plane_point - y);
    const double per_metre2 = 1.0 / (options_.sigma * options_.sigma);
    sample.value = window.mean_occupancy * std::exp(exponent_ * distance * distance);
    sample.log_gradient = window.normal * (distance * resolution_ * per_metre2);
    sample.pull_covariance.setIdentity();
    sample.pull_covariance -= window.normal * window.normal.transpose();
    sample.pull_covariance *= per_metre2;
    return sample;
  }

  void fit_plane(GaussianWindow& window) const {
    window.is_planar = false;
    if (window.gaussians.size() < 2) return;
    double total = 0.0;
    Vec<2> mean = Vec<2>::Zero();
    for (const auto& g : window.gaussians) {
      total += g.weight;
      mean += g.weight * g.mean;
    }
    if (!(total > 0.0)) return;
    mean /= total;
    Eigen::Matrix2d covariance = Eigen::Matrix2d::Zero();
    for (const auto& g : window.gaussians)
      covariance += (g.weight / total) * (g.mean - mean) * (g.mean - mean).transpose();
    Eigen::SelfAdjointEigenSolver<Eigen::Matrix2d> eigen;
    eigen.computeDirect(covariance);
    const Vec<2> variance = eigen.eigenvalues();
    window.is_planar = variance[0] < 0.1 * variance[1];
    window.normal = eigen.eigenvectors().col(0);
    window.plane_point = mean;
    window.mean_occupancy = total / static_cast<double>(window.gaussians.size());
  }

  void gather_gaussians(const Cell<2>& centre, GaussianWindow& window) {
    if (window.valid && window.centre == centre) return;
    window.centre = centre;
    window.valid = true;
    window.observed = cursor_.find_observed(centre) != nullptr;
    window.baseline = options_.floor + (window.observed ? 0.0 : options_.unknown);
    window.gaussians.clear();
    const int radius = options_.radius;
    for (int32_t y = centre[1] - radius; y <= centre[1] + radius; ++y)
      gather_row({centre[0] - radius, y}, centre[0] + radius, window.gaussians);
    if (!window.observed) fit_plane(window);
  }

  // Adds the Gaussians of a row of cells along x up to `last`, block by block.
  void gather_row(Cell<2> cell, int32_t last, std::vector<GaussianWindow::Gaussian>& gaussians) {
    while (cell[0] <= last) {
      const auto* block = cursor_.block(cell);
      const int32_t row_end = std::min(last, cell[0] | (BlockLayout<2>::kEdge - 1));
      if (block && block->moments) {
        auto local = static_cast<size_t>(BlockLayout<2>::local_of(cell));
        for (Cell<2> current = cell; current[0] <= row_end; ++current[0], ++local)
          if (block->values[local].alpha > 0) gaussians.push_back(gaussian(*block, local, current));
      }
      cell[0] = row_end + 1;
    }
  }

  static GaussianWindow::Gaussian gaussian(const OccupancyGrid<2>::Block& block, size_t local,
                                           const Cell<2>& cell) {
    const double per_hit = 1.0 / static_cast<double>(block.values[local].alpha);
    Vec<2> mean;
    for (int d = 0; d < 2; ++d)
      mean[d] =
          cell[d] + per_hit * static_cast<double>((*block.moments)[local][static_cast<size_t>(d)]);
    return {mean, OccupancyGrid<2>::occupancy_ignoring_approach(block, local)};
  }

  BlockCursor<const OccupancyGrid<2>> cursor_;
  LikelihoodFieldOptions options_;
  double resolution_;
  double exponent_;
  double truncated_variance_;
  double norm_;
};

}  // namespace stillmap
