// Change detection per cell: a three-state HMM (object, empty, passer-by) that finds objects that
// were placed or removed, and when. See docs/estimator.md.
//
// Objects stay for a time tau, passers-by for seconds; when an object leaves, the cell is as if it
// had never been there. The forward algorithm gives the likelihood of all observations, the Viterbi
// algorithm the most probable state path. Summaries of the path are updated along with it, so no
// observations are stored.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace stillmap {

struct ChangeOptions {
  double tau;            // seconds, correlation time of objects: exp(-dt / tau)
  double passer_by_rho;  // share of time with a passer-by where there is no object
  double passer_by_tau;  // seconds, correlation time of passers-by
  double p_detection;    // P(return | occupied)
};

// Two successive observations between which the state changed.
struct ChangeInterval {
  static constexpr int32_t kNever = -1;
  int32_t before = kNever;  // time bin of the last observation before the change
  int32_t after = kNever;   // time bin of the first observation after it
};

// Number of changes, the first and the last.
struct ChangeSummary {
  int32_t count = 0;
  ChangeInterval first, last;

  void record(int32_t previous, int32_t now) {
    if (count++ == 0) first = {previous, now};
    last = {previous, now};
  }
};

// Summary of the most probable state path of a cell.
struct StatePath {
  float log_probability = 0.0f;     // relative to the other paths of the cell
  float occupied_bins = 0.0f;       // duration not empty; changes are half way between bins
  ChangeSummary object_changes;     // object placed or removed
  ChangeSummary occupancy_changes;  // from empty to occupied, and back
};

class ChangeHmm {
 public:
  enum State : size_t { kObject, kEmpty, kPasserBy, kStates };

  // bin_seconds: length of a time bin; with_paths: also track the most probable state paths.
  ChangeHmm(size_t members, const ChangeOptions& options, double bin_seconds,
            bool with_paths = true)
      : options_(options),
        bin_seconds_(bin_seconds),
        has_paths_(with_paths),
        states_(members),
        paths_(with_paths ? members : 0) {
    const auto rho = static_cast<float>(options.passer_by_rho);
    const std::array<float, kStates> prior{0.5f, 0.5f * (1.0f - rho), 0.5f * rho};
    for (ForwardState& state : states_) state.weight = prior;
    for (Paths& to : paths_)
      for (size_t s = 0; s < kStates; ++s) to[s].log_probability = logarithm(prior[s]);
    for (int gap = 0; gap < kTabulatedGaps; ++gap) transition_table_.push_back(transitions(gap));
  }

  size_t members() const { return states_.size(); }
  bool has_paths() const { return has_paths_; }

  // Whether a time bin can be stored.
  static bool is_valid_time_bin(int64_t time_bin) {
    return time_bin >= 0 && time_bin <= std::numeric_limits<int32_t>::max();
  }

  void hit(size_t k, int64_t time_bin) {
    const auto a = static_cast<float>(options_.p_detection);
    observe(k, time_bin, {a, 0.0f, a});
  }
  void miss(size_t k, int64_t time_bin, float reliability) {
    const float missed = 1.0f - static_cast<float>(options_.p_detection) * reliability;
    observe(k, time_bin, {missed, 1.0f, missed});
  }

  // Log likelihood of all observations of a member, given that one of them is a hit.
  double log_likelihood(size_t k) const {
    const ForwardState& state = states_[k];
    const double hit = (0.5 + 0.5 * options_.passer_by_rho) * options_.p_detection;
    return state.log_scale + std::log(sum(state.weight)) - std::log(hit);
  }
  // P(state at the last observation | all observations).
  float p_final(size_t k, State state) const {
    const auto& weight = states_[k].weight;
    return weight[state] / static_cast<float>(sum(weight));
  }
  // Most probable state path, and the share of the time from first to last observation in which it
  // is not empty.
  const StatePath& most_probable_path(size_t k) const { return *best(paths_[k]); }
  float occupied_fraction(size_t k) const {
    const ForwardState& state = states_[k];
    const Paths& paths = paths_[k];
    if (state.last == state.first) return best(paths) == paths.data() + kEmpty ? 0.0f : 1.0f;
    return best(paths)->occupied_bins / static_cast<float>(state.last - state.first);
  }

 private:
  using Weights = std::array<float, kStates>;
  using Paths = std::array<StatePath, kStates>;  // best path that ends in each state
  using Matrix = std::array<Weights, kStates>;   // [from][to]
  struct Transition {
    Matrix p, log;
  };
  static constexpr int kTabulatedGaps = 64;         // gaps with tabulated transitions
  static constexpr float kMinProbability = 1e-30f;  // floor: no state becomes impossible
  static constexpr float kRescaleBelow = 1e-12f;

  struct ForwardState {
    int32_t first = ChangeInterval::kNever, last = ChangeInterval::kNever;  // time bins
    Weights weight;  // P(observations so far, state) / exp(log_scale)
    double log_scale = 0.0;
  };

  static double sum(const Weights& w) {
    return static_cast<double>(w[kObject]) + static_cast<double>(w[kEmpty]) +
           static_cast<double>(w[kPasserBy]);
  }
  static const StatePath* best(const Paths& paths) {
    return std::max_element(paths.begin(), paths.end(), [](const StatePath& a, const StatePath& b) {
      return a.log_probability < b.log_probability;
    });
  }

  Transition transitions(int64_t gap) const {
    const double dt = static_cast<double>(gap) * bin_seconds_;
    const double correlation = std::exp(-dt / options_.tau), rho = options_.passer_by_rho;
    const double passer_by_correlation = std::exp(-dt / options_.passer_by_tau);
    const double persistence = 0.5 + 0.5 * correlation;
    const double in = rho * (1.0 - passer_by_correlation),
                 stay = rho + (1.0 - rho) * passer_by_correlation;
    const auto row = [](double object, double empty, double passer_by) {
      return Weights{static_cast<float>(object), static_cast<float>(empty),
                     static_cast<float>(passer_by)};
    };
    Transition t{{row(persistence, (1.0 - persistence) * (1.0 - rho), (1.0 - persistence) * rho),
                  row(1.0 - persistence, persistence * (1.0 - in), persistence * in),
                  row(1.0 - persistence, persistence * (1.0 - stay), persistence * stay)},
                 {}};
    for (size_t from = 0; from < kStates; ++from)
      for (size_t to = 0; to < kStates; ++to) t.log[from][to] = logarithm(t.p[from][to]);
    return t;
  }
  static float logarithm(float p) { return std::log(std::max(p, kMinProbability)); }

  void observe(size_t k, int64_t time_bin, const Weights& likelihood) {
    ForwardState& state = states_[k];
    const auto now = static_cast<int32_t>(time_bin);
    const bool is_first = state.last == ChangeInterval::kNever;
    if (is_first) state.first = state.last = now;
    const int32_t gap = now - state.last;
    if (gap < kTabulatedGaps) {
      advance(k, transition_table_[static_cast<size_t>(gap)], likelihood, now);
    } else {
      advance(k, transitions(gap), likelihood, now);
    }
    state.last = now;
  }

  void advance(size_t k, const Transition& transition, const Weights& likelihood, int32_t now) {
    forward_step(states_[k], transition.p, likelihood);
    if (has_paths_) viterbi_step(paths_[k], transition.log, likelihood, states_[k].last, now);
  }

  static void forward_step(ForwardState& state, const Matrix& p, const Weights& likelihood) {
    Weights next;
    for (size_t to = 0; to < kStates; ++to) {
      float in = 0.0f;
      for (size_t from = 0; from < kStates; ++from) in += state.weight[from] * p[from][to];
      next[to] = std::max(in * likelihood[to], kMinProbability);
    }
    const float largest = *std::max_element(next.begin(), next.end());
    if (largest < kRescaleBelow) {
      for (float& w : next) w = std::max(w / largest, kMinProbability);
      state.log_scale += std::log(static_cast<double>(largest));
    }
    state.weight = next;
  }

  static void viterbi_step(Paths& paths, const Matrix& log, const Weights& likelihood, int32_t last,
                           int32_t now) {
    Paths next;
    float largest = -std::numeric_limits<float>::infinity();
    for (size_t to = 0; to < kStates; ++to) {
      size_t best = 0;
      float best_log = -std::numeric_limits<float>::infinity();
      for (size_t from = 0; from < kStates; ++from) {
        const float p = paths[from].log_probability + log[from][to];
        if (p > best_log) {
          best_log = p;
          best = from;
        }
      }
      next[to] = paths[best];
      next[to].log_probability = best_log + logarithm(likelihood[to]);
      extend_path(next[to], best, to, last, now);
      largest = std::max(largest, next[to].log_probability);
    }
    for (StatePath& path : next) path.log_probability -= largest;
    paths = next;
  }

  static void extend_path(StatePath& path, size_t from, size_t to, int32_t previous, int32_t now) {
    if (previous == now) return;  // first observation
    const bool was_empty = from == kEmpty, is_empty = to == kEmpty;
    path.occupied_bins += 0.5f * static_cast<float>(now - previous) *
                          static_cast<float>(static_cast<int>(!was_empty) + !is_empty);
    if ((from == kObject) != (to == kObject)) path.object_changes.record(previous, now);
    if (was_empty != is_empty) path.occupancy_changes.record(previous, now);
  }

  ChangeOptions options_;
  double bin_seconds_;
  bool has_paths_;
  std::vector<ForwardState> states_;
  std::vector<Paths> paths_;  // empty without paths
  std::vector<Transition> transition_table_;
};

}  // namespace stillmap
