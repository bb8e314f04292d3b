// The smoothed field that registration climbs: how probable it is that a static end point lies
// near y, given the map so far. Each cell stands for a Gaussian at the mean of its end points,
// weighted by its occupancy (15), so a cell that beams also passed through counts less.
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
  double sigma;    // metres, width of the Gaussians
  int radius;      // cells, how far neighbours are looked at
  double floor;    // value of an end point in free space, relative to a wall's 1
  double unknown;  // added where nobody looked: unknown is not free
};

template <int D>
struct FieldSample {
  double value = 0.0;     // F(y), about 1 on a wall
  double baseline = 0.0;  // floor, more where unknown: an end point that nothing explains
  Vec<D> log_gradient =
      Vec<D>::Zero();  // mean of (mu_k - y) / sigma^2: the gradient of ln F, per metre
  // spread of the pulls: what sigma^-2 loses along a wall, where F does not change
  Eigen::Matrix<double, D, D> pull_covariance = Eigen::Matrix<double, D, D>::Zero();
};

// The Gaussians around one cell. A beam keeps its own while its end point stays in the cell.
template <int D>
struct GaussianWindow {
  struct Gaussian {
    Vec<D> mean;    // in cells
    double weight;  // occupancy m_k, as Grid::presence has it
  };
  Cell<D> centre = Cell<D>::Zero();
  bool valid = false;
  bool observed = false;
  bool is_planar = false;               // whether the Gaussians lie on a line or plane
  Vec<D> normal = Vec<D>::Zero();       // its normal
  Vec<D> plane_point = Vec<D>::Zero();  // a point on it, in cells
  double mean_occupancy = 0.0;          // mean occupancy of its cells
  double baseline = 0.0;
  std::vector<Gaussian> gaussians;
};

template <int D>
class LikelihoodField {
 public:
  LikelihoodField(const OccupancyGrid<D>& grid, const LikelihoodFieldOptions& options)
      : cursor_(grid), options_(options), resolution_(grid.resolution()) {
    if (!(options.sigma > 0.0)) throw std::invalid_argument("sigma: expected a positive length");
    if (!(options.floor > 0.0)) throw std::invalid_argument("floor: expected a positive number");
    if (!(options.unknown >= 0.0))
      throw std::invalid_argument("unknown: expected a number that is not negative");
    if (options.radius < 0 || options.radius > 64)
      throw std::invalid_argument("radius: expected 0 to 64 cells");
    const double sigma_cells = options.sigma / resolution_;
    // a Gaussian cut off at the radius has less variance than sigma^2; along a uniform wall the
    // spread has to make up for sigma^-2 exactly
    const double cut = (options.radius + 0.5) / sigma_cells;
    const double density = std::exp(-0.5 * cut * cut) / std::sqrt(2.0 * kPi);
    truncated_variance_ = 1.0 - 2.0 * cut * density / std::erf(cut / std::sqrt(2.0));
    exponent_ = -0.5 / (sigma_cells * sigma_cells);
    // a straight wall whose cells are all occupied gives F = 1
    norm_ = 1.0 / std::pow(std::sqrt(2.0 * kPi) * sigma_cells, D - 1);
  }

  FieldSample<D> evaluate(const Vec<D>& y_metres, GaussianWindow<D>& window) {
    FieldSample<D> out;
    out.baseline = options_.floor;
    const Vec<D> y = y_metres / resolution_;
    if (!all_below<D>(y, BlockLayout<D>::kMaxCell - 64)) return out;
    gather_gaussians(cell_of<D>(y), window);
    out.baseline = window.baseline;
    if (!window.observed && window.is_planar) return extrapolate(y, window);
    double sum = 0.0;
    Vec<D> first = Vec<D>::Zero();
    Eigen::Matrix<double, D, D> second = Eigen::Matrix<double, D, D>::Zero();
    for (const auto& gaussian : window.gaussians) {
      const Vec<D> to_mean = gaussian.mean - y;
      const double weight = gaussian.weight * std::exp(exponent_ * to_mean.squaredNorm());
      sum += weight;
      first += weight * to_mean;
      second.noalias() += weight * to_mean * to_mean.transpose();
    }
    if (sum <= 0.0) return out;
    const double per_metre2 = 1.0 / (options_.sigma * options_.sigma);
    first /= sum;
    out.value = sum * norm_;
    out.log_gradient = first * (per_metre2 * resolution_);
    const double covariance_scale =
        per_metre2 * per_metre2 * resolution_ * resolution_ / truncated_variance_;
    out.pull_covariance = (second / sum - first * first.transpose()) * covariance_scale;
    return out;
  }

 private:
  // Where nobody looked a surface is taken to go on: its end, so far, says nothing of where a scan
  // is along it.
  FieldSample<D> extrapolate(const Vec<D>& y, const GaussianWindow<D>& window) const {
    FieldSample<D> out;
    out.baseline = window.baseline;
    const double distance = window.normal.dot(window.plane_point - y);
    const double per_metre2 = 1.0 / (options_.sigma * options_.sigma);
    out.value = window.mean_occupancy * std::exp(exponent_ * distance * distance);
    out.log_gradient = window.normal * (distance * resolution_ * per_metre2);
    out.pull_covariance.setIdentity();
    out.pull_covariance -= window.normal * window.normal.transpose();
    out.pull_covariance *= per_metre2;
    return out;
  }

  void fit_plane(GaussianWindow<D>& window) const {
    window.is_planar = false;
    if (window.gaussians.size() < D) return;
    double total = 0.0;
    Vec<D> mean = Vec<D>::Zero();
    for (const auto& g : window.gaussians) {
      total += g.weight;
      mean += g.weight * g.mean;
    }
    if (!(total > 0.0)) return;
    mean /= total;
    Eigen::Matrix<double, D, D> pull_covariance = Eigen::Matrix<double, D, D>::Zero();
    for (const auto& g : window.gaussians)
      pull_covariance += (g.weight / total) * (g.mean - mean) * (g.mean - mean).transpose();
    Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, D, D>> axes;
    axes.computeDirect(pull_covariance);
    const Vec<D> variance = axes.eigenvalues();
    // a line in space lies on many planes
    window.is_planar =
        variance[0] < 0.1 * variance[1] && (D == 2 || variance[1] > 0.1 * variance[D - 1]);
    window.normal = axes.eigenvectors().col(0);
    window.plane_point = mean;
    window.mean_occupancy = total / static_cast<double>(window.gaussians.size());
  }

  void gather_gaussians(const Cell<D>& centre, GaussianWindow<D>& window) {
    if (window.valid && window.centre == centre) return;
    window.centre = centre;
    window.valid = true;
    window.observed = cursor_.find_observed(centre) != nullptr;
    window.baseline = options_.floor + (window.observed ? 0.0 : options_.unknown);
    window.gaussians.clear();
    const int radius = options_.radius;
    Cell<D> row = centre.array() - radius;
    while (true) {
      gather_row(row, centre[0] + radius, window.gaussians);
      int d = 1;
      for (; d < D; ++d) {
        if (++row[d] <= centre[d] + radius) break;
        row[d] = centre[d] - radius;
      }
      if (d == D) break;
    }
    if (!window.observed) fit_plane(window);
  }

  // the cells of a row along x up to `last`, block by block
  void gather_row(Cell<D> cell, int32_t last,
                  std::vector<typename GaussianWindow<D>::Gaussian>& gaussians) {
    while (cell[0] <= last) {
      const auto* block = cursor_.block(cell);
      const int32_t row_end = std::min(last, cell[0] | (BlockLayout<D>::kEdge - 1));
      if (block && block->moments) {
        auto local = static_cast<size_t>(BlockLayout<D>::local_of(cell));
        for (Cell<D> at = cell; at[0] <= row_end; ++at[0], ++local)
          if (block->values[local].alpha > 0) gaussians.push_back(gaussian(*block, local, at));
      }
      cell[0] = row_end + 1;
    }
  }

  static typename GaussianWindow<D>::Gaussian gaussian(
      const typename OccupancyGrid<D>::Block& block, size_t local, const Cell<D>& cell) {
    const double per_hit = 1.0 / static_cast<double>(block.values[local].alpha);
    Vec<D> mean;
    for (int d = 0; d < D; ++d)
      mean[d] =
          cell[d] + per_hit * static_cast<double>((*block.moments)[local][static_cast<size_t>(d)]);
    return {mean, OccupancyGrid<D>::occupancy_ignoring_approach(block, local)};
  }

  BlockCursor<const OccupancyGrid<D>> cursor_;
  LikelihoodFieldOptions options_;
  double resolution_;
  double exponent_;
  double truncated_variance_;
  double norm_;
};

}  // namespace stillmap
