// Two-state Markov chains in time, many at once: how probable what was seen of each member is under
// each class of chains, look after look.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

namespace stillmap {

constexpr size_t kMaxClasses = 64;

struct DwellClasses {
  std::vector<double> rho;  // share of time occupied, in (0, 1)
  std::vector<double> tau;  // seconds
  double detection;         // probability that an occupied cell is seen to be so
};

class Chains {
 public:
  // seconds: between successive looks
  Chains(size_t members, DwellClasses classes, double seconds)
      : classes_(std::move(classes)),
        seconds_(seconds),
        packets_((classes_.rho.size() + kWidth - 1) / kWidth),
        rho_(packets_, Packet::Zero()),  // what fills the last packet stays at zero
        heads_(members) {
    for (size_t c = 0; c < size(); ++c)
      rho_[c / kWidth][static_cast<int>(c % kWidth)] = static_cast<float>(classes_.rho[c]);
    state_.reserve(members * 2 * packets_);
    for (size_t k = 0; k < members; ++k) {
      state_.insert(state_.end(), rho_.begin(), rho_.end());
      for (const Packet& rho : rho_) state_.push_back((rho > 0.0f).cast<float>());
    }
    for (int gap = 0; gap < kTable; ++gap) append_correlations(table_, gap);
  }

  size_t size() const { return classes_.rho.size(); }
  size_t members() const { return heads_.size(); }

  // One step of the filter of every class, forward in time, to a look that saw a hit, or saw
  // through the member with a reliability.
  void hit(size_t k, int64_t look) {
    step(k, look, [a = detection()](Packet& p, Packet& w) {
      w *= p * a;
      p.setOnes();
    });
  }
  void seen_through(size_t k, int64_t look, float reliability) {
    step(k, look, [missed = 1.0f - detection() * reliability](Packet& p, Packet& w) {
      const Packet through = 1.0f - p + p * missed;
      w *= through;
      p *= missed / through;
    });
  }

  int64_t looks(size_t k) const { return heads_[k].looks; }

  // Likelihood under each class of everything else that was seen of a member, given one hit,
  // relative to the best class; returns the logarithm of the best.
  double likelihood(size_t k, float* relative) const {
    const Packet* w = state_.data() + (2 * k + 1) * packets_;
    auto value = [&](size_t c) {
      return w[c / kWidth][static_cast<int>(c % kWidth)] / (classes_.rho[c] * classes_.detection);
    };
    double best = 0.0;
    for (size_t c = 0; c < size(); ++c) best = std::max(best, value(c));
    for (size_t c = 0; c < size(); ++c) relative[c] = static_cast<float>(value(c) / best);
    return heads_[k].log_scale + std::log(best);
  }

 private:
  static constexpr size_t kWidth = 8;
  using Packet = Eigen::Array<float, kWidth, 1>;
  static constexpr int64_t kNever = INT64_MIN;
  static constexpr int kTable = 64;  // gaps whose correlations are kept
  static constexpr float kSmall = 1e-12f, kLeast = 1e-36f;
  static constexpr float kSeldom = 1e-20f;  // no filter is surer that a cell is empty

  struct Head {
    int64_t last = kNever;  // number of the last look
    int64_t looks = 0;
    double log_scale = 0.0;  // logarithm of what the weights were divided by
  };

  float detection() const { return static_cast<float>(classes_.detection); }

  void append_correlations(std::vector<Packet>& to, int64_t gap) const {
    for (size_t i = 0; i < packets_; ++i) {
      to.push_back(Packet::Zero());
      for (size_t c = i * kWidth; c < std::min(size(), (i + 1) * kWidth); ++c)
        to.back()[static_cast<int>(c - i * kWidth)] =
            static_cast<float>(std::exp(-static_cast<double>(gap) * seconds_ / classes_.tau[c]));
    }
  }

  template <class See>
  void step(size_t k, int64_t look, See see) {
    Head& head = heads_[k];
    const bool first = head.last == kNever;
    const int64_t gap = first ? 0 : look - head.last;
    head.last = look;
    ++head.looks;
    std::vector<Packet> computed;
    const Packet* correlation = table_.data() + static_cast<size_t>(gap) * packets_;
    if (gap >= kTable) {
      append_correlations(computed, gap);
      correlation = computed.data();
    }
    Packet* p = state_.data() + k * 2 * packets_;
    Packet* w = p + packets_;
    float best = 0.0f;
    for (size_t i = 0; i < packets_; ++i) {
      p[i] = (rho_[i] + (p[i] - rho_[i]) * correlation[i]).max(kSeldom);
      see(p[i], w[i]);
      best = std::max(best, w[i].maxCoeff());
    }
    if (best >= kSmall) return;
    for (size_t i = 0; i < packets_; ++i) w[i] = (w[i] / best).max(kLeast);
    head.log_scale += std::log(best);
  }

  DwellClasses classes_;
  double seconds_;
  size_t packets_;
  std::vector<Packet> rho_;
  std::vector<Head> heads_;
  std::vector<Packet> state_;  // (members, 2, packets): occupied now, likelihood so far
  std::vector<Packet> table_;  // (gaps, packets)
};

}  // namespace stillmap
