// How well a map foresees the ranges of beams that it was not made from: a proper density over
// range, relative to that of a world without a map.
//
// On its way a beam meets things that stand still, at a rate per metre that follows from the labels
// of the beams that ended in each cell, and things that do not, at the same rate everywhere.
#pragma once

#include <algorithm>
#include <cmath>
#include <stdexcept>
#include <vector>

#include "stillmap/grid/cell_index.hpp"
#include "stillmap/occupancy/beam_counting.hpp"

namespace stillmap {

// Mean e of the beams that ended in each cell, and how often beams end at all.
template <int D>
class StaticShares : public CellIndex<D> {
 public:
  explicit StaticShares(double resolution) : resolution_(resolution) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
  }
  StaticShares(const StaticShares&) = delete;
  StaticShares& operator=(const StaticShares&) = delete;

  double resolution() const { return resolution_; }

  // Beams of the scans that are not held out; e as of (8).
  void add(const Scans<D>& scans, const float* e, const bool* held) {
    for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (held[t]) return;
      const Segment<D> beam(pose, scans.points + n * D, resolution_);
      length_ += to_fixed((beam.end - beam.start).norm() * resolution_);
      if (!scans.hit[n]) return;
      const Fixed is_static = to_fixed(probability(e[n]));
      Sums& sums = at(cell_of<D>(beam.end));
      sums.is_static += is_static;
      ++sums.hits;
      dynamic_ += to_fixed(1.0) - is_static;
      ++hits_;
    });
  }

  double share(int32_t k) const {
    const Sums& s = sums_[static_cast<size_t>(k)];
    return from_fixed(s.is_static) / static_cast<double>(s.hits);
  }
  // Per metre: of all ends, and of those at something that moves. One end at one metre more than
  // was seen, so that nothing is ever impossible.
  double end_rate() const { return per_metre(static_cast<double>(hits_)); }
  double dynamic_rate() const { return per_metre(from_fixed(dynamic_)); }

 private:
  struct Sums {
    Fixed is_static = 0;
    int64_t hits = 0;
  };

  double per_metre(double ends) const { return (ends + 1.0) / (from_fixed(length_) + 1.0); }

  Sums& at(const Cell<D>& cell) {
    int32_t& place = this->place_of(cell);
    if (place == this->kNone) {
      place = static_cast<int32_t>(sums_.size());
      sums_.emplace_back();
    }
    return sums_[static_cast<size_t>(place)];
  }

  double resolution_;
  Fixed length_ = 0, dynamic_ = 0;  // metres, expected number of hits
  int64_t hits_ = 0;
  std::vector<Sums> sums_;
};

struct BeamModel {
  double stopping;  // per metre: rate at which what is surely static stops a beam
  double noise;     // metres, standard deviation of ranges, poses included
  double late;      // share of the beams that end behind where they met something static
  double delay;     // metres, their mean distance from there
  double outliers;  // share of the beams of which the map says nothing
};

// Density of one beam's range; everything in metres.
template <int D>
class BeamDensity {
 public:
  BeamDensity(const StaticShares<D>& shares, const BeamModel& model)
      : shares_(shares), model_(model), dynamic_(shares.dynamic_rate()), cursor_(shares) {}

  // ln of the density of a hit, or of the probability that nothing stops the beam up to its end
  double log_of(const Segment<D>& beam, double range, bool hit) {
    before_ = 0.0;
    density_ = 0.0;
    at_ = -range;
    const double beyond = hit ? kDeviations * model_.noise / range : 0.0;
    const Vec<D> end = beam.end + (beam.end - beam.start) * beyond;
    if (!all_below<D>(end, Grid<D>::kMaxCell))
      throw std::invalid_argument("beam: a pose or end point is not finite or too far away");
    Walker walker(cursor_, [&](const int32_t* k, double length) { pass(k, length, hit); });
    const double last = traverse<D>(beam.start, end, walker);
    pass(walker.counts(), last, hit);
    return hit ? std::log(density_) : -before_;
  }

 private:
  static constexpr double kDeviations = 5.0;  // of the noise behind a hit that still may matter
  static constexpr double kDelays = 30.0;     // before it

  void pass(const int32_t* k, double cells, bool hit) {
    const double length = cells * shares_.resolution();
    if (!(length > 0.0)) return;
    const double share = k && *k != StaticShares<D>::kNone ? shares_.share(*k) : 0.0;
    const double still = model_.stopping * share, rate = still + dynamic_;
    const double from = at_, to = at_ + length;  // relative to where the beam ended
    if (hit && from <= 0.0 && to > 0.0) density_ += dynamic_ * std::exp(-before_ + rate * from);
    if (hit && share > 0.0 && to > -kDelays * model_.delay) {
      const double stopped = std::exp(-before_) * -std::expm1(-rate * length) * still / rate;
      density_ += stopped / length * ending(from, to);
    }
    before_ += rate * length;
    at_ = to;
  }

  // Probability, per metre of range, that a beam which met something static between two places ends
  // at 0; times the distance of the places.
  double ending(double from, double to) const {
    auto normal = [&](double x) { return 0.5 * std::erfc(-x / (model_.noise * std::sqrt(2.0))); };
    auto later = [&](double x) { return x < 0.0 ? -std::expm1(x / model_.delay) : 0.0; };
    return (1.0 - model_.late) * (normal(to) - normal(from)) +
           model_.late * (later(from) - later(to));
  }

  const StaticShares<D>& shares_;
  BeamModel model_;
  double dynamic_;
  Cursor<const StaticShares<D>> cursor_;
  double before_ = 0.0;   // - ln of the probability of getting so far
  double density_ = 0.0;  // at the end of the beam
  double at_ = 0.0;       // place relative to it
};

struct HeldOut {
  double gain = 0.0;  // nats above a world without a map
  double beams = 0.0;
};

// ln of the beams' density less ln of that of a world in which beams end at the same rate
// everywhere, summed per held-out scan.
template <int D>
inline void held_out(const StaticShares<D>& shares, const Scans<D>& scans, const bool* held,
                     const BeamModel& model, int threads, HeldOut* sums) {
  const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
  const double everywhere = shares.end_rate();
  const double known = std::log1p(-model.outliers), unknown = std::log(model.outliers);
  parallel_shares(bounds, [&](size_t, size_t first, size_t last) {
    BeamDensity<D> density(shares, model);
    for (size_t t = first; t < last; ++t) {
      if (!held[t]) continue;
      for_each_beam<D>(scans, t, t + 1, [&](size_t, int64_t n, const Pose<D>& pose) {
        const Segment<D> beam(pose, scans.points + n * D, shares.resolution());
        const double range = (beam.end - beam.start).norm() * shares.resolution();
        if (!(range > 0.0)) return;
        const double nothing = (scans.hit[n] ? std::log(everywhere) : 0.0) - everywhere * range;
        const double seen = known + density.log_of(beam, range, scans.hit[n]) - nothing;
        const double more = std::max(seen, unknown), less = std::min(seen, unknown);
        sums[t].gain += more + std::log1p(std::exp(less - more));
        sums[t].beams += 1.0;
      });
    }
  });
}

}  // namespace stillmap
