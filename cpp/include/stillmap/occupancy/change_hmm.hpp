// Things that are put somewhere or taken away while others pass: when, and what is there at last.
//
// A cell holds a thing, or nothing, or somebody who passes; see docs/estimator.md. Things stay for
// very long, passers-by for seconds; a thing leaves the cell as it would be without it. All looks
// together decide how probable that story is (forward algorithm) and which course of it is the most
// probable (Viterbi). What is asked of that course is carried along with it, so nothing is kept of
// the looks themselves.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

namespace stillmap {

struct ChangeOptions {
  double tau;            // seconds: things come and go with correlation exp(-dt / tau)
  double passer_by_rho;  // share of the time in which somebody passes where no thing stands
  double passer_by_tau;  // seconds, of them
  double p_detection;    // probability that an occupied cell is seen to be so
};

// Between which two looks something changed.
struct ChangeInterval {
  static constexpr int32_t kNever = -1;
  int32_t before = kNever;  // the last look that saw the cell as it was
  int32_t after = kNever;   // the first that saw it otherwise
};

// How often something changed, and when first and last.
struct ChangeSummary {
  int32_t count = 0;
  ChangeInterval first, last;

  void record(int32_t before, int32_t now) {
    if (count++ == 0) first = {before, now};
    last = {before, now};
  }
};

// The most probable course of a cell, as far as it is asked for.
struct StatePath {
  float log_probability = 0.0f;     // relative to the others of the cell
  float occupied_bins = 0.0f;       // looks' time not empty; a change counts as half way between
  ChangeSummary object_changes;     // things that come or leave
  ChangeSummary occupancy_changes;  // from empty to not empty, and back
};

class ChangeHmm {
 public:
  enum State : size_t { kObject, kEmpty, kPasserBy, kStates };

  // seconds: between successive looks; courses: whether they are asked for, or only how probable
  // the story is
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

  // Whether it can remember the number of a look.
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

  // Logarithm of the likelihood of everything else that was seen of a member, given one hit.
  double log_likelihood(size_t k) const {
    const ForwardState& state = states_[k];
    const double hit = (0.5 + 0.5 * options_.passer_by_rho) * options_.p_detection;
    return state.log_scale + std::log(sum(state.weight)) - std::log(hit);
  }
  // Probability that a thing, or nothing, is there at the last look.
  float p_final(size_t k, State state) const {
    const auto& weight = states_[k].weight;
    return weight[state] / static_cast<float>(sum(weight));
  }
  // The most probable course, and the share of the time from first to last look that it is not
  // empty.
  const StatePath& most_probable_path(size_t k) const { return *best(paths_[k]); }
  float occupied_fraction(size_t k) const {
    const ForwardState& state = states_[k];
    const Paths& with_paths = paths_[k];
    if (state.last == state.first)
      return best(with_paths) == with_paths.data() + kEmpty ? 0.0f : 1.0f;
    return best(with_paths)->occupied_bins / static_cast<float>(state.last - state.first);
  }

 private:
  using Weights = std::array<float, kStates>;
  using Paths = std::array<StatePath, kStates>;  // the most probable one to each state
  using Matrix = std::array<Weights, kStates>;   // [from][to]
  struct Transition {
    Matrix p, log;
  };
  static constexpr int kTabulatedGaps = 64;         // gaps whose transitions are kept
  static constexpr float kMinProbability = 1e-30f;  // no state is ever impossible
  static constexpr float kRescaleBelow = 1e-12f;

  struct ForwardState {
    int32_t first = ChangeInterval::kNever, last = ChangeInterval::kNever;  // looks
    Weights weight;  // P(all looks so far, state), relative to exp(log_scale)
    double log_scale = 0.0;
  };

  static double sum(const Weights& w) {
    return static_cast<double>(w[kObject]) + static_cast<double>(w[kEmpty]) +
           static_cast<double>(w[kPasserBy]);
  }
  static const StatePath* best(const Paths& with_paths) {
    return std::max_element(with_paths.begin(), with_paths.end(),
                            [](const StatePath& a, const StatePath& b) {
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

  static void viterbi_step(Paths& with_paths, const Matrix& log, const Weights& likelihood,
                           int32_t last, int32_t now) {
    Paths next;
    float largest = -std::numeric_limits<float>::infinity();
    for (size_t to = 0; to < kStates; ++to) {
      size_t best = 0;
      float best_log = -std::numeric_limits<float>::infinity();
      for (size_t from = 0; from < kStates; ++from) {
        const float p = with_paths[from].log_probability + log[from][to];
        if (p > best_log) {
          best_log = p;
          best = from;
        }
      }
      next[to] = with_paths[best];
      next[to].log_probability = best_log + logarithm(likelihood[to]);
      extend_path(next[to], best, to, last, now);
      largest = std::max(largest, next[to].log_probability);
    }
    for (StatePath& path : next) path.log_probability -= largest;
    with_paths = next;
  }

  static void extend_path(StatePath& path, size_t from, size_t to, int32_t before, int32_t now) {
    if (before == now) return;  // at the first look nothing has changed
    const bool was_empty = from == kEmpty, is_empty = to == kEmpty;
    path.occupied_bins += 0.5f * static_cast<float>(now - before) *
                          static_cast<float>(static_cast<int>(!was_empty) + !is_empty);
    if ((from == kObject) != (to == kObject)) path.object_changes.record(before, now);
    if (was_empty != is_empty) path.occupancy_changes.record(before, now);
  }

  ChangeOptions options_;
  double bin_seconds_;
  bool has_paths_;
  std::vector<ForwardState> states_;
  std::vector<Paths> paths_;  // of all, or of none
  std::vector<Transition> transition_table_;
};

}  // namespace stillmap
