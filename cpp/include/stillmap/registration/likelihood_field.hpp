// The smoothed field that registration climbs: how probable it is that a static end point lies
// near y, given the map so far. Each cell stands for a Gaussian at the mean of its end points,
// weighted by its occupancy (15), so a cell that beams also passed through counts less.
#pragma once

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <cmath>
#include <vector>

#include "stillmap/grid/occupancy_grid.hpp"

namespace stillmap {

constexpr double kPi = 3.14159265358979323846;

struct FieldOptions {
  double sigma;    // metres, width of the Gaussians
  int radius;      // cells, how far neighbours are looked at
  double floor;    // value of an end point in free space, relative to a wall's 1
  double unknown;  // added where nobody looked: unknown is not free
};

template <int D>
struct FieldValue {
  double value = 0.0;            // F(y), about 1 on a wall
  double base = 0.0;             // floor, more where unknown: an end point that nothing explains
  Vec<D> pull = Vec<D>::Zero();  // mean of (mu_k - y) / sigma^2: the gradient of ln F, per metre
  // spread of the pulls: what sigma^-2 loses along a wall, where F does not change
  Eigen::Matrix<double, D, D> spread = Eigen::Matrix<double, D, D>::Zero();
};

// The Gaussians around one cell. A beam keeps its own while its end point stays in the cell.
template <int D>
struct Neighbourhood {
  struct Gaussian {
    Vec<D> mean;    // in cells
    double weight;  // occupancy m_k, as Grid::presence has it
  };
  Cell<D> centre = Cell<D>::Zero();
  bool valid = false;
  bool seen = false;
  bool is_flat = false;            // whether the Gaussians lie on a line or plane
  Vec<D> across = Vec<D>::Zero();  // its normal
  Vec<D> on = Vec<D>::Zero();      // a point on it, in cells
  double height = 0.0;             // mean occupancy of its cells
  double base = 0.0;
  std::vector<Gaussian> gaussians;
};

template <int D>
class Field {
 public:
  Field(const Grid<D>& grid, const FieldOptions& options)
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
    kept_variance_ = 1.0 - 2.0 * cut * density / std::erf(cut / std::sqrt(2.0));
    exponent_ = -0.5 / (sigma_cells * sigma_cells);
    // a straight wall whose cells are all occupied gives F = 1
    norm_ = 1.0 / std::pow(std::sqrt(2.0 * kPi) * sigma_cells, D - 1);
  }

  FieldValue<D> evaluate(const Vec<D>& y_metres, Neighbourhood<D>& near) {
    FieldValue<D> out;
    out.base = options_.floor;
    const Vec<D> y = y_metres / resolution_;
    if (!all_below<D>(y, Grid<D>::kMaxCell - 64)) return out;
    gather(cell_of<D>(y), near);
    out.base = near.base;
    if (!near.seen && near.is_flat) return beyond(y, near);
    double sum = 0.0;
    Vec<D> first = Vec<D>::Zero();
    Eigen::Matrix<double, D, D> second = Eigen::Matrix<double, D, D>::Zero();
    for (const auto& gaussian : near.gaussians) {
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
    out.pull = first * (per_metre2 * resolution_);
    const double spread_scale =
        per_metre2 * per_metre2 * resolution_ * resolution_ / kept_variance_;
    out.spread = (second / sum - first * first.transpose()) * spread_scale;
    return out;
  }

 private:
  // Where nobody looked a surface is taken to go on: its end, so far, says nothing of where a scan
  // is along it.
  FieldValue<D> beyond(const Vec<D>& y, const Neighbourhood<D>& near) const {
    FieldValue<D> out;
    out.base = near.base;
    const double off = near.across.dot(near.on - y);
    const double per_metre2 = 1.0 / (options_.sigma * options_.sigma);
    out.value = near.height * std::exp(exponent_ * off * off);
    out.pull = near.across * (off * resolution_ * per_metre2);
    out.spread.setIdentity();
    out.spread -= near.across * near.across.transpose();
    out.spread *= per_metre2;
    return out;
  }

  void fit_plane(Neighbourhood<D>& near) const {
    near.is_flat = false;
    if (near.gaussians.size() < D) return;
    double total = 0.0;
    Vec<D> mean = Vec<D>::Zero();
    for (const auto& g : near.gaussians) {
      total += g.weight;
      mean += g.weight * g.mean;
    }
    if (!(total > 0.0)) return;
    mean /= total;
    Eigen::Matrix<double, D, D> spread = Eigen::Matrix<double, D, D>::Zero();
    for (const auto& g : near.gaussians)
      spread += (g.weight / total) * (g.mean - mean) * (g.mean - mean).transpose();
    Eigen::SelfAdjointEigenSolver<Eigen::Matrix<double, D, D>> axes;
    axes.computeDirect(spread);
    const Vec<D> variance = axes.eigenvalues();
    // a line in space lies on many planes
    near.is_flat =
        variance[0] < 0.1 * variance[1] && (D == 2 || variance[1] > 0.1 * variance[D - 1]);
    near.across = axes.eigenvectors().col(0);
    near.on = mean;
    near.height = total / static_cast<double>(near.gaussians.size());
  }

  void gather(const Cell<D>& centre, Neighbourhood<D>& near) {
    if (near.valid && near.centre == centre) return;
    near.centre = centre;
    near.valid = true;
    near.seen = cursor_.seen(centre) != nullptr;
    near.base = options_.floor + (near.seen ? 0.0 : options_.unknown);
    near.gaussians.clear();
    const int radius = options_.radius;
    Cell<D> row = centre.array() - radius;
    while (true) {
      add_row(row, centre[0] + radius, near.gaussians);
      int d = 1;
      for (; d < D; ++d) {
        if (++row[d] <= centre[d] + radius) break;
        row[d] = centre[d] - radius;
      }
      if (d == D) break;
    }
    if (!near.seen) fit_plane(near);
  }

  // the cells of a row along x up to `last`, block by block
  void add_row(Cell<D> cell, int32_t last, std::vector<typename Neighbourhood<D>::Gaussian>& to) {
    while (cell[0] <= last) {
      const auto* block = cursor_.block(cell);
      const int32_t until = std::min(last, cell[0] | (Grid<D>::kEdge - 1));
      if (block && block->moments) {
        auto local = static_cast<size_t>(Grid<D>::local_of(cell));
        for (Cell<D> at = cell; at[0] <= until; ++at[0], ++local)
          if (block->counts[local].alpha > 0) to.push_back(gaussian(*block, local, at));
      }
      cell[0] = until + 1;
    }
  }

  static typename Neighbourhood<D>::Gaussian gaussian(const typename Grid<D>::Block& block,
                                                      size_t local, const Cell<D>& cell) {
    const double per_hit = 1.0 / static_cast<double>(block.counts[local].alpha);
    Vec<D> mean;
    for (int d = 0; d < D; ++d)
      mean[d] =
          cell[d] + per_hit * static_cast<double>((*block.moments)[local][static_cast<size_t>(d)]);
    return {mean, Grid<D>::presence(block, local)};
  }

  Cursor<const Grid<D>> cursor_;
  FieldOptions options_;
  double resolution_;
  double exponent_;
  double kept_variance_;
  double norm_;
};

}  // namespace stillmap
