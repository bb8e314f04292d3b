// Log likelihood of the ranges of held-out scans under a map, relative to a world without a map.
//
// Along a beam static objects stop it at a rate per metre that depends on the labels of the beams
// that ended in each cell, dynamic objects at the same rate everywhere. The range density is
// normalised.
#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/cell_index.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Mean e of the beams that ended in each cell, and mean rates of end points.
template <int D>
class StaticFractionGrid : public CellIndex<D> {
 public:
  explicit StaticFractionGrid(double resolution) : resolution_(resolution) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
  }
  StaticFractionGrid(const StaticFractionGrid&) = delete;
  StaticFractionGrid& operator=(const StaticFractionGrid&) = delete;

  double resolution() const { return resolution_; }

  // Adds the beams of scans that are not held out; e as in (8).
  void add(const Scans<D>& scans, const float* e, const bool* is_held_out) {
    for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (is_held_out[t]) return;
      const BeamSegment<D> beam(pose, scans.points + n * D, resolution_);
      length_ += to_fixed((beam.end - beam.start).norm() * resolution_);
      if (!scans.hit[n]) return;
      const Fixed is_static = to_fixed(checked_probability(e[n]));
      CellSums& sums = sums_at(cell_of<D>(beam.end));
      sums.is_static += is_static;
      ++sums.hits;
      dynamic_ += to_fixed(1.0) - is_static;
      ++hits_;
    });
  }

  double static_fraction(int32_t k) const {
    const CellSums& s = sums_[static_cast<size_t>(k)];
    return from_fixed(s.is_static) / static_cast<double>(s.hits);
  }
  // End points per metre of beam, all and dynamic ones. One end point and one metre are added, so
  // that no rate is zero.
  double end_rate() const { return per_metre(static_cast<double>(hits_)); }
  double dynamic_rate() const { return per_metre(from_fixed(dynamic_)); }

 private:
  struct CellSums {
    Fixed is_static = 0;
    int64_t hits = 0;
  };

  double per_metre(double ends) const { return (ends + 1.0) / (from_fixed(length_) + 1.0); }

  CellSums& sums_at(const Cell<D>& cell) {
    int32_t& index = this->index_of(cell);
    if (index == this->kNone) {
      index = static_cast<int32_t>(sums_.size());
      sums_.emplace_back();
    }
    return sums_[static_cast<size_t>(index)];
  }

  double resolution_;
  Fixed length_ = 0, dynamic_ = 0;  // metres; expected number of dynamic hits
  int64_t hits_ = 0;
  std::vector<CellSums> sums_;
};

struct BeamModel {
  double stopping;  // 1/m, rate at which a certainly static cell stops a beam
  double noise;     // metres, standard deviation of ranges, including pose error
  double late;      // share of beams that end behind the static object they met
  double delay;     // metres, mean distance behind it
  double outliers;  // share of beams that the map does not explain
};

// Density of the range of one beam, per metre.
template <int D>
class RangeDensity {
 public:
  RangeDensity(const StaticFractionGrid<D>& fractions, const BeamModel& model)
      : fractions_(fractions),
        model_(model),
        dynamic_(fractions.dynamic_rate()),
        cursor_(fractions) {}

  // ln of the density of a return, or of the probability of no return up to the end.
  double log_density(const BeamSegment<D>& beam, double range, bool hit) {
    optical_depth_ = 0.0;
    density_ = 0.0;
    position_ = -range;
    const double beyond = hit ? kDeviations * model_.noise / range : 0.0;
    const Vec<D> end = beam.end + (beam.end - beam.start) * beyond;
    if (!all_below<D>(end, BlockLayout<D>::kMaxCell))
      throw std::invalid_argument("beam: a pose or end point is not finite or too far away");
    RayWalker walker(cursor_,
                     [&](const int32_t* k, double length) { integrate_cell(k, length, hit); });
    const double last = traverse<D>(beam.start, end, walker);
    integrate_cell(walker.value(), last, hit);
    return hit ? std::log(density_) : -optical_depth_;
  }

 private:
  static constexpr double kDeviations = 5.0;  // of the noise, considered behind a return
  static constexpr double kDelays = 30.0;     // mean delays, considered before a return

  void integrate_cell(const int32_t* k, double cells, bool hit) {
    const double length = cells * fractions_.resolution();
    if (!(length > 0.0)) return;
    const double static_fraction =
        k && *k != StaticFractionGrid<D>::kNone ? fractions_.static_fraction(*k) : 0.0;
    const double static_rate = model_.stopping * static_fraction, rate = static_rate + dynamic_;
    const double from = position_, to = position_ + length;  // relative to the end of the beam
    if (hit && from <= 0.0 && to > 0.0)
      density_ += dynamic_ * std::exp(-optical_depth_ + rate * from);
    if (hit && static_fraction > 0.0 && to > -kDelays * model_.delay) {
      const double p_stopped =
          std::exp(-optical_depth_) * -std::expm1(-rate * length) * static_rate / rate;
      density_ += p_stopped / length * end_probability(from, to);
    }
    optical_depth_ += rate * length;
    position_ = to;
  }

  // Probability density of a return at 0 for a beam that met a static object between two positions,
  // times their distance.
  double end_probability(double from, double to) const {
    auto normal = [&](double x) { return 0.5 * std::erfc(-x / (model_.noise * std::sqrt(2.0))); };
    auto delayed = [&](double x) { return x < 0.0 ? -std::expm1(x / model_.delay) : 0.0; };
    return (1.0 - model_.late) * (normal(to) - normal(from)) +
           model_.late * (delayed(from) - delayed(to));
  }

  const StaticFractionGrid<D>& fractions_;
  BeamModel model_;
  double dynamic_;
  BlockCursor<const StaticFractionGrid<D>> cursor_;
  double optical_depth_ = 0.0;  // -ln P(the beam gets this far)
  double density_ = 0.0;        // at the end of the beam
  double position_ = 0.0;       // current position relative to it
};

struct HeldOutScore {
  double log_likelihood_gain = 0.0;  // nats, relative to a world without a map
  double beam_count = 0.0;
};

// Sums ln of the range density minus that of a world with a constant rate of end points, per
// held-out scan.
template <int D>
inline void score_held_out(const StaticFractionGrid<D>& fractions, const Scans<D>& scans,
                           const bool* is_held_out, const BeamModel& model, int threads,
                           HeldOutScore* sums) {
  const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
  const double reference_rate = fractions.end_rate();
  const double log_inlier = std::log1p(-model.outliers), log_outlier = std::log(model.outliers);
  parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
    RangeDensity<D> density(fractions, model);
    for (size_t t = first; t < last; ++t) {
      if (!is_held_out[t]) continue;
      for_each_beam<D>(scans, t, t + 1, [&](size_t, int64_t n, const Pose<D>& pose) {
        const BeamSegment<D> beam(pose, scans.points + n * D, fractions.resolution());
        const double range = (beam.end - beam.start).norm() * fractions.resolution();
        if (!(range > 0.0)) return;
        const double log_reference =
            (scans.hit[n] ? std::log(reference_rate) : 0.0) - reference_rate * range;
        const double log_model =
            log_inlier + density.log_density(beam, range, scans.hit[n]) - log_reference;
        const double larger = std::max(log_model, log_outlier),
                     smaller = std::min(log_model, log_outlier);
        sums[t].log_likelihood_gain += larger + std::log1p(std::exp(smaller - larger));
        sums[t].beam_count += 1.0;
      });
    }
  });
}

}  // namespace stillmap
