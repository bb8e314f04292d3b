// Two-state Markov chains, many at once: how probable what was seen of each member is under each
// class of chains, look after look. States are kept with correlation exp(-dt / tau - dv / turn)
// from one look to the next: dt is the time between them, dv how far the robot moved against its
// distance from the member: the angle by which the view turned, but for moves to and fro.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

namespace stillmap {

constexpr size_t kMaxClasses = 64;

struct DwellClasses {
  std::vector<double> rho;   // share of time occupied, in (0, 1)
  std::vector<double> tau;   // seconds
  std::vector<double> turn;  // of the view, radians
  double detection;          // probability that an occupied cell is seen to be so
};

// Width: classes that are worked on together.
template <size_t Width>
class Chains {
 public:
  // places: of the members, in cells; seconds: between successive looks
  Chains(std::vector<Eigen::Vector3f> places, DwellClasses classes, double seconds)
      : classes_(std::move(classes)),
        seconds_(seconds),
        packets_((classes_.rho.size() + kWidth - 1) / kWidth),
        rho_(packets_, Packet::Zero()),
        per_turn_(packets_, Packet::Zero()),
        turns_(packets_, false),
        places_(std::move(places)),
        last_(places_.size(), kNever),
        exponent_(places_.size() * packets_, Packet::Zero()) {
    for (size_t lane = 0; lane < packets_ * kWidth; ++lane) {
      const size_t c = of_lane(lane);
      at(rho_, lane) = static_cast<float>(classes_.rho[c]);
      at(per_turn_, lane) = static_cast<float>(1.0 / classes_.turn[c]);
      if (std::isfinite(classes_.turn[c])) turns_[lane / kWidth] = true;
    }
    state_.reserve(members() * 2 * packets_);
    for (size_t k = 0; k < members(); ++k) {
      state_.insert(state_.end(), rho_.begin(), rho_.end());
      for (const Packet& rho : rho_) state_.push_back(1.0f - rho);
    }
    for (int gap = 0; gap < kTable; ++gap) append_transitions(table_, gap);
  }

  size_t size() const { return classes_.rho.size(); }
  size_t members() const { return last_.size(); }

  // Notes the next look: its number, and the place in cells from which it was taken. Returns which
  // of the looks it is: what `hit` and `seen_through` want. Who stands is never quite at the same
  // place: it counts as another one half a cell away.
  int32_t begin(int64_t number, const Eigen::Vector3d& from) {
    const bool stands = !looks_.empty() && (from - looks_.back().from).norm() < kStep;
    looks_.push_back({number, stands ? looks_.back().from : from});
    return static_cast<int32_t>(looks_.size() - 1);
  }

  // One step of the forward algorithm in every class, to a look that saw a hit, or saw through the
  // member with a reliability.
  void hit(size_t k, int32_t look) { step(k, look, detection(), 0.0f); }
  void seen_through(size_t k, int32_t look, float reliability) {
    step(k, look, 1.0f - detection() * reliability, 1.0f);
  }

  // Likelihood under some of the classes of everything else that was seen of a member, given one
  // hit, relative to the best of them; returns the logarithm of the best.
  double likelihood(size_t k, const std::vector<size_t>& among, float* relative) const {
    std::vector<double> logs;
    for (const size_t c : among) logs.push_back(log_likelihood(k, c));
    const double best = *std::max_element(logs.begin(), logs.end());
    for (size_t i = 0; i < logs.size(); ++i)
      relative[i] = static_cast<float>(std::exp(logs[i] - best));
    return best;
  }

 private:
  static constexpr size_t kWidth = Width;
  using Packet = Eigen::Array<float, kWidth, 1>;
  static constexpr int32_t kNever = -1;
  static constexpr int kTable = 64;  // gaps whose correlations are kept
  static constexpr float kSmall = 1e-12f;
  static constexpr float kLeast = 1e-30f;  // no state is ever impossible
  static constexpr double kStep = 0.5;     // cells

  struct Taken {
    int64_t number;
    Eigen::Vector3d from;
  };

  // what fills the last packet is like the first class
  size_t of_lane(size_t lane) const { return lane < size() ? lane : 0; }

  double log_likelihood(size_t k, size_t c) const {
    const size_t i = c / kWidth;
    const int lane = static_cast<int>(c % kWidth);
    const Packet* occupied = state_.data() + 2 * k * packets_ + i;
    const float both = occupied[0][lane] + occupied[packets_][lane];
    const auto exponent = static_cast<double>(exponent_[k * packets_ + i][lane]);
    return std::log(static_cast<double>(both) / (classes_.rho[c] * classes_.detection)) +
           exponent * std::log(2.0);
  }

  float detection() const { return static_cast<float>(classes_.detection); }

  static float& at(std::vector<Packet>& packets, size_t c) {
    return packets[c / kWidth][static_cast<int>(c % kWidth)];
  }

  // For each packet: what flows in from both states together, then what stays.
  void append_transitions(std::vector<Packet>& to, int64_t gap) const {
    for (size_t i = 0; i < packets_; ++i) {
      Packet in, stays;
      for (size_t lane = 0; lane < kWidth; ++lane) {
        const size_t c = of_lane(i * kWidth + lane);
        const double kept = std::exp(-static_cast<double>(gap) * seconds_ / classes_.tau[c]);
        in[static_cast<int>(lane)] = static_cast<float>(classes_.rho[c] * (1.0 - kept));
        stays[static_cast<int>(lane)] = static_cast<float>(kept);
      }
      to.push_back(in);
      to.push_back(stays);
    }
  }

  // Whoever stands in the place itself sees nothing of it.
  static float view_turned(const Taken& before, const Taken& now, const Eigen::Vector3f& place) {
    const double moved = (now.from - before.from).norm();
    return static_cast<float>(moved / std::max(1.0, (now.from - place.cast<double>()).norm()));
  }

  // if_occupied, if_empty: probability of what was seen
  void step(size_t k, int32_t look, float if_occupied, float if_empty) {
    const Taken& now = looks_[static_cast<size_t>(look)];
    const Taken& before = looks_[static_cast<size_t>(last_[k] == kNever ? look : last_[k])];
    const int64_t gap = now.number - before.number;
    const float turned = view_turned(before, now, places_[k]);
    last_[k] = look;
    std::vector<Packet> computed;
    const Packet* transition = table_.data() + static_cast<size_t>(gap) * 2 * packets_;
    if (gap >= kTable) {
      append_transitions(computed, gap);
      transition = computed.data();
    }
    Packet* occupied = state_.data() + k * 2 * packets_;
    Packet* empty = occupied + packets_;
    Packet least = Packet::Ones();
    for (size_t i = 0; i < packets_; ++i) {
      const Packet both = occupied[i] + empty[i];
      Packet in = transition[2 * i], stays = transition[2 * i + 1];
      if (turns_[i] && turned > 0.0f) {
        stays *= (-turned * per_turn_[i]).exp();
        in = rho_[i] * (1.0f - stays);
      }
      const Packet before = (in * both + stays * occupied[i]).max(kLeast);
      occupied[i] = before * if_occupied;
      empty[i] = (both - before).max(0.0f) * if_empty;
      least = least.min(occupied[i] + empty[i]);
    }
    if (least.minCoeff() >= kSmall) return;
    for (size_t i = 0; i < packets_; ++i) scale(occupied[i], empty[i], exponent_[k * packets_ + i]);
  }

  // Each class by a power of two of its own: it may become the best one of those that are asked
  // for.
  static void scale(Packet& occupied, Packet& empty, Packet& exponent) {
    Packet both = occupied + empty;
    uint32_t bits[kWidth];
    static_assert(sizeof(bits) == sizeof(both));
    std::memcpy(bits, both.data(), sizeof(bits));
    Packet by;
    for (size_t lane = 0; lane < kWidth; ++lane) {
      const uint32_t power = bits[lane] >> 23;  // biased; the sign of what is positive is zero
      exponent[static_cast<int>(lane)] += static_cast<float>(power) - 127.0f;
      bits[lane] = (254u - power) << 23;
    }
    std::memcpy(by.data(), bits, sizeof(bits));
    occupied = (occupied * by).max(kLeast);
    empty = (empty * by).max(kLeast);
  }

  DwellClasses classes_;
  double seconds_;
  size_t packets_;
  std::vector<Packet> rho_;
  std::vector<Packet> per_turn_;
  std::vector<bool> turns_;  // packets in which some class knows from where it is seen
  std::vector<Eigen::Vector3f> places_;
  std::vector<int32_t> last_;     // look at each member
  std::vector<Packet> state_;     // (members, 2, packets): P(all looks so far, occupied or empty)
  std::vector<Packet> exponent_;  // (members, packets): but for such a power of two
  std::vector<Packet> table_;     // (gaps, packets, 2)
  std::vector<Taken> looks_;
};

}  // namespace stillmap
