// Forward filter (E-step): bank of two-state hidden Markov models, one per surfel and class. The
// occupancy at two successive observations has the correlation exp(-dt / tau - dv / view_angle),
// with dt the time between them and dv the change of the viewing direction: displacement of the
// robot / its distance from the surfel.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <cstring>
#include <vector>

namespace stillmap {

constexpr size_t kMaxClasses = 64;

struct OccupancyClasses {
  std::vector<double> rho;         // stationary probability of being occupied, in (0, 1)
  std::vector<double> tau;         // seconds, correlation time
  std::vector<double> view_angle;  // radians, correlation angle of the viewing direction
  double p_detection;              // P(return | occupied)
};

// Width: classes per SIMD packet.
template <size_t Width>
class TwoStateChains {
 public:
  // positions of the members, in cells; bin_seconds: length of a time bin.
  TwoStateChains(std::vector<Eigen::Vector3f> positions, OccupancyClasses classes,
                 double bin_seconds)
      : classes_(std::move(classes)),
        bin_seconds_(bin_seconds),
        packets_((classes_.rho.size() + kWidth - 1) / kWidth),
        rho_(packets_, Packet::Zero()),
        inverse_view_angle_(packets_, Packet::Zero()),
        view_dependent_(packets_, false),
        positions_(std::move(positions)),
        last_observation_(positions_.size(), kNever),
        exponent_(positions_.size() * packets_, Packet::Zero()) {
    for (size_t lane = 0; lane < packets_ * kWidth; ++lane) {
      const size_t c = class_of_lane(lane);
      at(rho_, lane) = static_cast<float>(classes_.rho[c]);
      at(inverse_view_angle_, lane) = static_cast<float>(1.0 / classes_.view_angle[c]);
      if (std::isfinite(classes_.view_angle[c])) view_dependent_[lane / kWidth] = true;
    }
    state_.reserve(members() * 2 * packets_);
    for (size_t k = 0; k < members(); ++k) {
      state_.insert(state_.end(), rho_.begin(), rho_.end());
      for (const Packet& rho : rho_) state_.push_back(1.0f - rho);
    }
    for (int gap = 0; gap < kTabulatedGaps; ++gap) append_transitions(transition_table_, gap);
  }

  size_t size() const { return classes_.rho.size(); }
  size_t members() const { return last_observation_.size(); }

  // Registers the next viewpoint: its time bin and position in cells. Returns its index, the
  // argument of `hit` and `miss`. Moves of less than half a cell are ignored: pose noise of a
  // standing robot.
  int32_t begin_observation(int64_t time_bin, const Eigen::Vector3d& position) {
    const bool is_stationary =
        !viewpoints_.empty() && (position - viewpoints_.back().position).norm() < kMinMove;
    viewpoints_.push_back({time_bin, is_stationary ? viewpoints_.back().position : position});
    return static_cast<int32_t>(viewpoints_.size() - 1);
  }

  // Forward step in every class for a hit, or for a miss with a reliability.
  void hit(size_t k, int32_t viewpoint) { forward_step(k, viewpoint, p_detection(), 0.0f); }
  void miss(size_t k, int32_t viewpoint, float reliability) {
    forward_step(k, viewpoint, 1.0f - p_detection() * reliability, 1.0f);
  }

  // Likelihood under some of the classes of all observations of a member, given that one is a hit,
  // relative to the best class; returns the logarithm of the best.
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
  static constexpr int kTabulatedGaps = 64;  // gaps with tabulated transitions
  static constexpr float kRescaleBelow = 1e-12f;
  static constexpr float kMinProbability = 1e-30f;  // floor: no state becomes impossible
  static constexpr double kMinMove = 0.5;           // cells

  struct Viewpoint {
    int64_t time_bin;
    Eigen::Vector3d position;
  };

  // lanes beyond the last class repeat the first one
  size_t class_of_lane(size_t lane) const { return lane < size() ? lane : 0; }

  double log_likelihood(size_t k, size_t c) const {
    const size_t i = c / kWidth;
    const int lane = static_cast<int>(c % kWidth);
    const Packet* occupied = state_.data() + 2 * k * packets_ + i;
    const float total = occupied[0][lane] + occupied[packets_][lane];
    const auto exponent = static_cast<double>(exponent_[k * packets_ + i][lane]);
    return std::log(static_cast<double>(total) / (classes_.rho[c] * classes_.p_detection)) +
           exponent * std::log(2.0);
  }

  float p_detection() const { return static_cast<float>(classes_.p_detection); }

  static float& at(std::vector<Packet>& packets, size_t c) {
    return packets[c / kWidth][static_cast<int>(c % kWidth)];
  }

  // For each packet: inflow from both states, then persistence.
  void append_transitions(std::vector<Packet>& to, int64_t gap) const {
    for (size_t i = 0; i < packets_; ++i) {
      Packet inflow, persistence;
      for (size_t lane = 0; lane < kWidth; ++lane) {
        const size_t c = class_of_lane(i * kWidth + lane);
        const double correlation =
            std::exp(-static_cast<double>(gap) * bin_seconds_ / classes_.tau[c]);
        inflow[static_cast<int>(lane)] = static_cast<float>(classes_.rho[c] * (1.0 - correlation));
        persistence[static_cast<int>(lane)] = static_cast<float>(correlation);
      }
      to.push_back(inflow);
      to.push_back(persistence);
    }
  }

  // Viewing angle between two positions, from a distance of at least one cell.
  static float view_rotation(const Viewpoint& previous, const Viewpoint& now,
                             const Eigen::Vector3f& position) {
    const double displacement = (now.position - previous.position).norm();
    return static_cast<float>(displacement /
                              std::max(1.0, (now.position - position.cast<double>()).norm()));
  }

  // if_occupied, if_empty: probability of the observation in each state.
  void forward_step(size_t k, int32_t viewpoint, float if_occupied, float if_empty) {
    const Viewpoint& now = viewpoints_[static_cast<size_t>(viewpoint)];
    const Viewpoint& previous = viewpoints_[static_cast<size_t>(
        last_observation_[k] == kNever ? viewpoint : last_observation_[k])];
    const int64_t gap = now.time_bin - previous.time_bin;
    const float rotation = view_rotation(previous, now, positions_[k]);
    last_observation_[k] = viewpoint;
    std::vector<Packet> computed;
    const Packet* transition = transition_table_.data() + static_cast<size_t>(gap) * 2 * packets_;
    if (gap >= kTabulatedGaps) {
      append_transitions(computed, gap);
      transition = computed.data();
    }
    Packet* occupied = state_.data() + k * 2 * packets_;
    Packet* empty = occupied + packets_;
    Packet smallest = Packet::Ones();
    for (size_t i = 0; i < packets_; ++i) {
      const Packet total = occupied[i] + empty[i];
      Packet inflow = transition[2 * i], persistence = transition[2 * i + 1];
      if (view_dependent_[i] && rotation > 0.0f) {
        persistence *= (-rotation * inverse_view_angle_[i]).exp();
        inflow = rho_[i] * (1.0f - persistence);
      }
      const Packet p_occupied = (inflow * total + persistence * occupied[i]).max(kMinProbability);
      occupied[i] = p_occupied * if_occupied;
      empty[i] = (total - p_occupied).max(0.0f) * if_empty;
      smallest = smallest.min(occupied[i] + empty[i]);
    }
    if (smallest.minCoeff() >= kRescaleBelow) return;
    for (size_t i = 0; i < packets_; ++i)
      rescale(occupied[i], empty[i], exponent_[k * packets_ + i]);
  }

  // Scales each class by its own power of two.
  static void rescale(Packet& occupied, Packet& empty, Packet& exponent) {
    Packet total = occupied + empty;
    uint32_t bits[kWidth];
    static_assert(sizeof(bits) == sizeof(total));
    std::memcpy(bits, total.data(), sizeof(bits));
    Packet factor;
    for (size_t lane = 0; lane < kWidth; ++lane) {
      const uint32_t power = bits[lane] >> 23;  // biased exponent; the values are positive
      exponent[static_cast<int>(lane)] += static_cast<float>(power) - 127.0f;
      bits[lane] = (254u - power) << 23;
    }
    std::memcpy(factor.data(), bits, sizeof(bits));
    occupied = (occupied * factor).max(kMinProbability);
    empty = (empty * factor).max(kMinProbability);
  }

  OccupancyClasses classes_;
  double bin_seconds_;
  size_t packets_;
  std::vector<Packet> rho_;
  std::vector<Packet> inverse_view_angle_;
  std::vector<bool> view_dependent_;  // packets with a finite view_angle
  std::vector<Eigen::Vector3f> positions_;
  std::vector<int32_t> last_observation_;  // viewpoint of each member's last observation
  std::vector<Packet> state_;  // (members, 2, packets): P(observations so far, state) / 2^exponent
  std::vector<Packet> exponent_;          // (members, packets)
  std::vector<Packet> transition_table_;  // (gaps, packets, 2)
  std::vector<Viewpoint> viewpoints_;
};

}  // namespace stillmap
