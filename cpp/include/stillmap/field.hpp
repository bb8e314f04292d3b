// The smoothed field that registration climbs: how probable it is that a static end point lies
// near y, given the map so far. Each cell stands for a Gaussian at the mean of its end points,
// weighted by its occupancy (15), so a cell that beams also passed through counts less.
#pragma once

#include <cmath>

#include "stillmap/grid.hpp"

namespace stillmap {

struct FieldOptions {
  double sigma;    // metres, width of the Gaussians
  int radius;      // cells, how far neighbours are looked at
  double floor;    // value of an end point in free space, relative to a wall's 1
  double unknown;  // added where nobody looked: unknown is not free
};

template <int D>
struct FieldValue {
  double value = 0.0;  // F(y), about 1 on a wall
  double base = 0.0;   // what is expected without any end point near: floor, more where unknown
  Vec<D> pull = Vec<D>::Zero();  // mean of (mu_k - y) / sigma^2: the gradient of ln F, per metre
  // spread of the pulls: what sigma^-2 loses along a wall, where F does not change
  Eigen::Matrix<double, D, D> spread = Eigen::Matrix<double, D, D>::Zero();
};

template <int D>
class Field {
 public:
  Field(const Grid<D>& grid, const FieldOptions& options)
      : cursor_(grid),
        floor_(options.floor),
        unknown_(options.unknown),
        radius_(options.radius),
        scale_(1.0 / grid.resolution()),
        sigma_cells_(options.sigma / grid.resolution()) {
    if (!(options.sigma > 0.0)) throw std::invalid_argument("sigma: expected a positive length");
    if (!(options.floor > 0.0)) throw std::invalid_argument("floor: expected a positive number");
    if (!(options.unknown >= 0.0))
      throw std::invalid_argument("unknown: expected a number that is not negative");
    if (options.radius < 0 || options.radius > 64)
      throw std::invalid_argument("radius: expected 0 to 64 cells");
    // a straight wall whose cells are all occupied gives F = 1
    norm_ = 1.0 / std::pow(std::sqrt(2.0 * 3.14159265358979323846) * sigma_cells_, D - 1);
  }

  // floor + F(y), and more where nobody looked
  double likelihood(const Vec<D>& y_metres) {
    double sum = 0.0;
    for_each_near(y_metres, [&](double weight, const Vec<D>&) { sum += weight; });
    return base(y_metres) + sum * norm_;
  }

  FieldValue<D> evaluate(const Vec<D>& y_metres) {
    FieldValue<D> out;
    out.base = base(y_metres);
    double sum = 0.0;
    Vec<D> first = Vec<D>::Zero();
    Eigen::Matrix<double, D, D> second = Eigen::Matrix<double, D, D>::Zero();
    for_each_near(y_metres, [&](double weight, const Vec<D>& to_mean) {
      sum += weight;
      first += weight * to_mean;
      second.noalias() += weight * to_mean * to_mean.transpose();
    });
    if (sum <= 0.0) return out;
    const double per_metre2 = scale_ * scale_ / (sigma_cells_ * sigma_cells_);
    first /= sum;
    out.value = sum * norm_;
    out.pull = first * (per_metre2 / scale_);
    out.spread =
        (second / sum - first * first.transpose()) * (per_metre2 / (sigma_cells_ * sigma_cells_));
    return out;
  }

 private:
  double base(const Vec<D>& y_metres) {
    const Vec<D> y = y_metres * scale_;
    if (!(y.cwiseAbs().maxCoeff() < Grid<D>::kMaxCell)) return floor_;
    return cursor_.seen(cell_of<D>(y)) ? floor_ : floor_ + unknown_;
  }

  // visit(m_k exp(-|y - mu_k|^2 / (2 sigma^2)), mu_k - y in cells) for every hit cell near y
  template <class Visit>
  void for_each_near(const Vec<D>& y_metres, Visit&& visit) {
    const Vec<D> y = y_metres * scale_;
    if (!(y.cwiseAbs().maxCoeff() < Grid<D>::kMaxCell - 64)) return;
    const Cell<D> centre = cell_of<D>(y);
    const double exponent = -0.5 / (sigma_cells_ * sigma_cells_);
    Cell<D> cell = centre.array() - radius_;
    while (true) {
      visit_cell(cell, y, exponent, visit);
      int d = 0;
      for (; d < D; ++d) {
        if (++cell[d] <= centre[d] + radius_) break;
        cell[d] = centre[d] - radius_;
      }
      if (d == D) return;
    }
  }

  template <class Visit>
  void visit_cell(const Cell<D>& cell, const Vec<D>& y, double exponent, Visit&& visit) {
    const auto* block = cursor_.block(cell);
    if (!block || !block->moments) return;
    const auto local = static_cast<size_t>(Grid<D>::local_of(cell));
    const Counts& counts = block->counts[local];
    if (counts.alpha <= 0) return;
    Vec<D> to_mean;
    for (int d = 0; d < D; ++d)
      to_mean[d] = cell[d] +
                   static_cast<double>((*block->moments)[local][static_cast<size_t>(d)]) /
                       static_cast<double>(counts.alpha) -
                   y[d];
    visit(occupancy(counts) * std::exp(exponent * to_mean.squaredNorm()), to_mean);
  }

  Cursor<const Grid<D>> cursor_;
  double floor_;
  double unknown_;
  int radius_;
  double scale_;
  double sigma_cells_;
  double norm_;
};

}  // namespace stillmap
