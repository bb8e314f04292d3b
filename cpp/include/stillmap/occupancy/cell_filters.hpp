// Forward filters of a bank of two-state hidden Markov models, one bank for each cell: the classes
// differ in their stationary probability of being occupied and in their correlation time.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

namespace stillmap {

struct FilterOptions {
  std::vector<double> rho;      // stationary probability of being occupied, in (0, 1)
  std::vector<double> tau;      // seconds, correlation time
  std::vector<double> weights;  // prior probability of each class
  size_t n_static;              // the first classes are static
  double p_detection;           // P(return | occupied)
  double bin_seconds;           // length of a time bin
  double lateral_std;           // cells, standard deviation of a beam's lateral position
  double hit_radius;            // cells, a hit counts for cells whose centre is within it as well
  double max_log_ratio;         // nats by which a class may fall behind the best one
};

class CellFilters {
 public:
  static constexpr size_t kMaxClasses = 32;
  static constexpr int kMaxPasses = 32;  // that a new filter takes account of

  struct Posterior {
    float p_static;    // of the static classes
    float p_standing;  // of the static classes, occupied now
  };

  explicit CellFilters(FilterOptions options)
      : options_(std::move(options)),
        detection_(static_cast<float>(options_.p_detection)),
        least_(static_cast<float>(std::exp(-options_.max_log_ratio))) {
    for (size_t c = 0; c < classes(); ++c) {
      rho_.push_back(static_cast<float>(options_.rho[c]));
      weight_.push_back(static_cast<float>(options_.weights[c]));
      for (int gap = 0; gap < kTabulatedGaps; ++gap) persistence_.push_back(persistence(c, gap));
    }
  }

  const FilterOptions& options() const { return options_; }
  size_t classes() const { return options_.rho.size(); }
  size_t size() const { return filters_.size(); }
  int32_t tag(int32_t k) const { return filters_[static_cast<size_t>(k)].tag; }

  // A new filter, after the passes of a cell in which no beam ended so far, see `initialize`.
  // Returns its index.
  int32_t add(const float* reliability, int passes, int32_t last_bin, int32_t tag) {
    const int32_t k = make_index();
    initialize(k, reliability, passes, last_bin, tag);
    return k;
  }

  // A filter that is to be initialized.
  int32_t make_index() {
    filters_.emplace_back();
    state_.resize(state_.size() + 2 * classes());
    return static_cast<int32_t>(filters_.size() - 1);
  }

  // reliability: of the passes, one for each time bin, at most kMaxPasses. last_bin: of the last
  // one; -1: none. Likelihoods are relative to that of a first hit, as only cells with hits are
  // considered.
  void initialize(int32_t k, const float* reliability, int passes, int32_t last_bin, int32_t tag) {
    filters_[static_cast<size_t>(k)] = {tag, kNoBin, last_bin, 1.0f, kNotComputed};
    float* p = states(k);
    float* likelihood = p + classes();
    for (size_t c = 0; c < classes(); ++c) {
      p[c] = rho_[c];
      likelihood[c] = 1.0f / (rho_[c] * detection_);
    }
    for (int pass = 0; pass < passes; ++pass)
      for (size_t c = 0; c < classes(); ++c)
        step(c, pass ? 1 : 0, false, reliability[pass], p[c], likelihood[c]);
    normalize(likelihood);
  }

  // Observations of bins before the open one are ignored: after a correction of the map, scans are
  // added again, also to cells that were copied with their evidence.
  void hit(int32_t k, int32_t bin, int32_t tag) {
    if (!open(k, bin)) return;
    Filter& filter = filters_[static_cast<size_t>(k)];
    filter.tag = tag;
    if (filter.p_missed == kHitMark) return;
    filter.p_missed = kHitMark;
    filter.p_static = kNotComputed;
  }

  void miss(int32_t k, int32_t bin, float reliability) {
    if (!open(k, bin)) return;
    Filter& filter = filters_[static_cast<size_t>(k)];
    if (filter.p_missed == kHitMark) return;
    filter.p_missed *= 1.0f - reliability;
    filter.p_static = kNotComputed;
  }

  // Whether a miss in a bin changes nothing.
  bool is_settled(int32_t k, int32_t bin) const {
    const Filter& filter = filters_[static_cast<size_t>(k)];
    return filter.open_bin > bin || (filter.open_bin == bin && filter.p_missed == kHitMark);
  }

  // Lets the dynamic classes fall behind by so many nats.
  void favour_static(int32_t k, double log_ratio) {
    float* likelihood = likelihoods(k);
    for (size_t c = options_.n_static; c < classes(); ++c)
      likelihood[c] *= static_cast<float>(std::exp(-log_ratio));
    normalize(likelihood);
    filters_[static_cast<size_t>(k)].p_static = kNotComputed;
  }

  // P(static), which is computed where it has changed: most cells are hit again and again in a bin.
  float p_static(int32_t k) {
    float& p = filters_[static_cast<size_t>(k)].p_static;
    if (p == kNotComputed) p = posterior(k).p_static;
    return p;
  }

  // The same without keeping it: other threads may ask for it, too.
  float p_static(int32_t k) const {
    const float p = filters_[static_cast<size_t>(k)].p_static;
    return p == kNotComputed ? posterior(k).p_static : p;
  }

  // With the observation of the open time bin.
  Posterior posterior(int32_t k) const {
    const Filter& filter = filters_[static_cast<size_t>(k)];
    const float* state = state_.data() + static_cast<size_t>(k) * 2 * classes();
    float total = 0.0f, fixed = 0.0f, standing = 0.0f;
    for (size_t c = 0; c < classes(); ++c) {
      float p = state[c], likelihood = state[classes() + c];
      if (filter.open_bin != kNoBin) step(c, filter, p, likelihood);
      const float joint = likelihood * weight_[c];
      total += joint;
      if (c >= options_.n_static) continue;
      fixed += joint;
      standing += joint * p;
    }
    return {fixed / total, standing / total};
  }

  // A copy of the filter of another bank of the same kind; returns its index.
  int32_t copy(const CellFilters& from, int32_t k) {
    const float* theirs = from.state_.data() + static_cast<size_t>(k) * 2 * classes();
    const int32_t here = make_index();
    filters_[static_cast<size_t>(here)] = from.filters_[static_cast<size_t>(k)];
    std::copy(theirs, theirs + 2 * classes(), states(here));
    return here;
  }

  // Adds the evidence of a filter of another bank; the state of the one with the later tag stays.
  void merge(int32_t k, const CellFilters& from, int32_t other) {
    const Filter& source = from.filters_[static_cast<size_t>(other)];
    const float* theirs = from.state_.data() + static_cast<size_t>(other) * 2 * classes();
    Filter& filter = filters_[static_cast<size_t>(k)];
    float* ours = state_.data() + static_cast<size_t>(k) * 2 * classes();
    const bool is_newer = source.tag >= filter.tag;
    for (size_t c = 0; c < classes(); ++c) {
      if (is_newer) ours[c] = theirs[c];
      ours[classes() + c] *= theirs[classes() + c];
    }
    normalize(ours + classes());
    if (is_newer) filter = source;
    filter.p_static = kNotComputed;
  }

 private:
  static constexpr int kTabulatedGaps = 64;
  static constexpr int32_t kNoBin = -1;
  static constexpr float kHitMark = -1.0f, kNotComputed = -1.0f;
  static constexpr float kMinProbability = 1e-6f;  // floor: no state becomes impossible

  struct Filter {
    int32_t tag;                 // of the scan that hit it last
    int32_t open_bin, last_bin;  // being observed; of the last observation before
    // P(all beams of the open bin missed the surface); kHitMark: a hit
    float p_missed;
    float p_static;  // kNotComputed where it has changed
  };

  float* states(int32_t k) { return state_.data() + static_cast<size_t>(k) * 2 * classes(); }
  float* likelihoods(int32_t k) { return states(k) + classes(); }

  float persistence(size_t c, int64_t gap) const {
    return static_cast<float>(
        std::exp(-static_cast<double>(gap) * options_.bin_seconds / options_.tau[c]));
  }

  // Forward step of one class: the observation of the open bin.
  void step(size_t c, const Filter& filter, float& p, float& likelihood) const {
    const int64_t gap = filter.last_bin == kNoBin ? 0 : int64_t{filter.open_bin} - filter.last_bin;
    const bool is_hit = filter.p_missed == kHitMark;
    step(c, gap, is_hit, is_hit ? 1.0f : 1.0f - filter.p_missed, p, likelihood);
  }

  void step(size_t c, int64_t gap, bool is_hit, float reliability, float& p,
            float& likelihood) const {
    const float kept = gap < kTabulatedGaps
                           ? persistence_[c * kTabulatedGaps + static_cast<size_t>(gap)]
                           : persistence(c, gap);
    p = rho_[c] + kept * (p - rho_[c]);
    if (is_hit) {
      likelihood *= std::max(p * detection_, kMinProbability);
      p = 1.0f;
      return;
    }
    const float missed = p * (1.0f - detection_ * reliability);
    const float total = missed + 1.0f - p;
    likelihood *= total;
    p = std::max(missed / total, kMinProbability);
  }

  // Applies the observation of the open bin, if there is one, and opens another; false if that is
  // an earlier one.
  bool open(int32_t k, int32_t bin) {
    Filter& filter = filters_[static_cast<size_t>(k)];
    if (filter.open_bin >= bin) return filter.open_bin == bin;
    if (filter.open_bin != kNoBin) {
      float* p = states(k);
      for (size_t c = 0; c < classes(); ++c) step(c, filter, p[c], p[classes() + c]);
      normalize(p + classes());
      filter.last_bin = filter.open_bin;
    }
    // beams may have passed later, before the first hit: then there is no gap
    filter.open_bin = std::max(bin, filter.last_bin);
    filter.p_missed = 1.0f;
    filter.p_static = kNotComputed;
    return true;
  }

  // Relative to the best class, which others fall behind by a bounded ratio: so what stood for
  // hours is soon known to be gone.
  void normalize(float* likelihood) const {
    const float scale = 1.0f / *std::max_element(likelihood, likelihood + classes());
    for (size_t c = 0; c < classes(); ++c) likelihood[c] = std::max(likelihood[c] * scale, least_);
  }

  FilterOptions options_;
  float detection_, least_;
  std::vector<float> rho_, weight_, persistence_;
  std::vector<Filter> filters_;
  std::vector<float> state_;  // (filters, 2, classes): P(occupied), likelihood
};

}  // namespace stillmap
