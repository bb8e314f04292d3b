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

struct ChangeModel {
  double tau;               // seconds: things come and go with correlation exp(-dt / tau)
  double passing_occupied;  // share of the time in which somebody passes where no thing stands
  double passing_tau;       // seconds, of them
  double detection;         // probability that an occupied cell is seen to be so
};

// Between which two looks something changed.
struct Between {
  static constexpr int32_t kNever = -1;
  int32_t before = kNever;  // the last look that saw the cell as it was
  int32_t after = kNever;   // the first that saw it otherwise
};

// How often something changed, and when first and last.
struct Turns {
  int32_t count = 0;
  Between first, last;

  void note(int32_t before, int32_t now) {
    if (count++ == 0) first = {before, now};
    last = {before, now};
  }
};

// The most probable course of a cell, as far as it is asked for.
struct Course {
  float log_probability = 0.0f;  // relative to the others of the cell
  float occupied = 0.0f;         // looks' time not empty; a change counts as half way between
  Turns things;                  // things that come or leave
  Turns any;                     // from empty to not empty, and back
};

class Changes {
 public:
  enum State : size_t { kThing, kNothing, kSomebody, kStates };

  // seconds: between successive looks; courses: whether they are asked for, or only how probable
  // the story is
  Changes(size_t members, const ChangeModel& model, double seconds, bool courses = true)
      : model_(model),
        seconds_(seconds),
        has_courses_(courses),
        heads_(members),
        courses_(courses ? members : 0) {
    const auto rho = static_cast<float>(model.passing_occupied);
    const std::array<float, kStates> prior{0.5f, 0.5f * (1.0f - rho), 0.5f * rho};
    for (Head& head : heads_) head.weight = prior;
    for (Courses& to : courses_)
      for (size_t s = 0; s < kStates; ++s) to[s].log_probability = logarithm(prior[s]);
    for (int gap = 0; gap < kTable; ++gap) table_.push_back(transitions(gap));
  }

  size_t members() const { return heads_.size(); }
  bool has_courses() const { return has_courses_; }

  // Whether it can remember the number of a look.
  static bool counts(int64_t look) {
    return look >= 0 && look <= std::numeric_limits<int32_t>::max();
  }

  void hit(size_t k, int64_t look) {
    const auto a = static_cast<float>(model_.detection);
    step(k, look, {a, 0.0f, a});
  }
  void seen_through(size_t k, int64_t look, float reliability) {
    const float missed = 1.0f - static_cast<float>(model_.detection) * reliability;
    step(k, look, {missed, 1.0f, missed});
  }

  // Logarithm of the likelihood of everything else that was seen of a member, given one hit.
  double log_likelihood(size_t k) const {
    const Head& head = heads_[k];
    const double hit = (0.5 + 0.5 * model_.passing_occupied) * model_.detection;
    return head.log_scale + std::log(sum(head.weight)) - std::log(hit);
  }
  // Probability that a thing, or nothing, is there at the last look.
  float p_at_last(size_t k, State state) const {
    const auto& weight = heads_[k].weight;
    return weight[state] / static_cast<float>(sum(weight));
  }
  // The most probable course, and the share of the time from first to last look that it is not
  // empty.
  const Course& course(size_t k) const { return *best(courses_[k]); }
  float occupied_share(size_t k) const {
    const Head& head = heads_[k];
    const Courses& courses = courses_[k];
    if (head.last == head.first) return best(courses) == courses.data() + kNothing ? 0.0f : 1.0f;
    return best(courses)->occupied / static_cast<float>(head.last - head.first);
  }

 private:
  using Weights = std::array<float, kStates>;
  using Courses = std::array<Course, kStates>;  // the most probable one to each state
  using Matrix = std::array<Weights, kStates>;  // [from][to]
  struct Transition {
    Matrix p, log;
  };
  static constexpr int kTable = 64;        // gaps whose transitions are kept
  static constexpr float kLeast = 1e-30f;  // no state is ever impossible
  static constexpr float kSmall = 1e-12f;

  struct Head {
    int32_t first = Between::kNever, last = Between::kNever;  // looks
    Weights weight;  // P(all looks so far, state), relative to exp(log_scale)
    double log_scale = 0.0;
  };

  static double sum(const Weights& w) {
    return static_cast<double>(w[kThing]) + static_cast<double>(w[kNothing]) +
           static_cast<double>(w[kSomebody]);
  }
  static const Course* best(const Courses& courses) {
    return std::max_element(courses.begin(), courses.end(), [](const Course& a, const Course& b) {
      return a.log_probability < b.log_probability;
    });
  }

  Transition transitions(int64_t gap) const {
    const double dt = static_cast<double>(gap) * seconds_;
    const double kept = std::exp(-dt / model_.tau), rho = model_.passing_occupied;
    const double passing_kept = std::exp(-dt / model_.passing_tau);
    const double stays = 0.5 + 0.5 * kept;
    const double in = rho * (1.0 - passing_kept), on = rho + (1.0 - rho) * passing_kept;
    const auto row = [](double thing, double nothing, double somebody) {
      return Weights{static_cast<float>(thing), static_cast<float>(nothing),
                     static_cast<float>(somebody)};
    };
    Transition t{{row(stays, (1.0 - stays) * (1.0 - rho), (1.0 - stays) * rho),
                  row(1.0 - stays, stays * (1.0 - in), stays * in),
                  row(1.0 - stays, stays * (1.0 - on), stays * on)},
                 {}};
    for (size_t from = 0; from < kStates; ++from)
      for (size_t to = 0; to < kStates; ++to) t.log[from][to] = logarithm(t.p[from][to]);
    return t;
  }
  static float logarithm(float p) { return std::log(std::max(p, kLeast)); }

  void step(size_t k, int64_t look, const Weights& seen) {
    Head& head = heads_[k];
    const auto now = static_cast<int32_t>(look);
    const bool is_first = head.last == Between::kNever;
    if (is_first) head.first = head.last = now;
    const int32_t gap = now - head.last;
    if (gap < kTable) {
      go(k, table_[static_cast<size_t>(gap)], seen, now);
    } else {
      go(k, transitions(gap), seen, now);
    }
    head.last = now;
  }

  void go(size_t k, const Transition& transition, const Weights& seen, int32_t now) {
    forward(heads_[k], transition.p, seen);
    if (has_courses_) follow(courses_[k], transition.log, seen, heads_[k].last, now);
  }

  static void forward(Head& head, const Matrix& p, const Weights& seen) {
    Weights next;
    for (size_t to = 0; to < kStates; ++to) {
      float in = 0.0f;
      for (size_t from = 0; from < kStates; ++from) in += head.weight[from] * p[from][to];
      next[to] = std::max(in * seen[to], kLeast);
    }
    const float most = *std::max_element(next.begin(), next.end());
    if (most < kSmall) {
      for (float& w : next) w = std::max(w / most, kLeast);
      head.log_scale += std::log(static_cast<double>(most));
    }
    head.weight = next;
  }

  static void follow(Courses& courses, const Matrix& log, const Weights& seen, int32_t last,
                     int32_t now) {
    Courses next;
    float most = -std::numeric_limits<float>::infinity();
    for (size_t to = 0; to < kStates; ++to) {
      size_t best = 0;
      float most_to = -std::numeric_limits<float>::infinity();
      for (size_t from = 0; from < kStates; ++from) {
        const float p = courses[from].log_probability + log[from][to];
        if (p > most_to) {
          most_to = p;
          best = from;
        }
      }
      next[to] = courses[best];
      next[to].log_probability = most_to + logarithm(seen[to]);
      go_on(next[to], best, to, last, now);
      most = std::max(most, next[to].log_probability);
    }
    for (Course& course : next) course.log_probability -= most;
    courses = next;
  }

  static void go_on(Course& course, size_t from, size_t to, int32_t before, int32_t now) {
    if (before == now) return;  // at the first look nothing has changed
    const bool was_empty = from == kNothing, is_empty = to == kNothing;
    course.occupied += 0.5f * static_cast<float>(now - before) *
                       static_cast<float>(static_cast<int>(!was_empty) + !is_empty);
    if ((from == kThing) != (to == kThing)) course.things.note(before, now);
    if (was_empty != is_empty) course.any.note(before, now);
  }

  ChangeModel model_;
  double seconds_;
  bool has_courses_;
  std::vector<Head> heads_;
  std::vector<Courses> courses_;  // of all, or of none
  std::vector<Transition> table_;
};

}  // namespace stillmap
