// Observations of surfels: data structures, and the probability that a beam intersects a surfel.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace stillmap {

struct ObservationOptions {
  double bin_seconds;  // length of a time bin
  double lateral_std;  // cells, standard deviation of a beam's lateral position
  double margin;       // cells, distance by which a beam must end behind a surfel to be a miss
  double hit_radius;   // cells, hits spread to neighbours within this radius
  double end_margin;   // cells, last part of a beam without a return that is not used
  double trust_beyond_solid;  // reliability of no-return beams behind the first solid surfel
  bool use_normals;           // false: all surfels are isotropic
};

// Number of beams without a return (in runs of at least three), and of those among them that cross
// a solid surfel.
struct NoReturnStats {
  int64_t beam_count = 0, through_solid = 0;
};

// Observation of one surfel in one time bin: a hit, or a miss with a reliability.
struct Observation {
  static constexpr float kHit = 2.0f;
  int32_t surfel;
  float value;  // kHit, or the reliability of a miss; negative if its surroundings were hit

  bool is_hit() const { return value == kHit; }
  // P(some beam intersected the surfel's extent), of a miss, in (0, 1].
  float reliability() const { return std::abs(value); }
  bool is_surrounded() const { return value < 0.0f; }
};

// Observations of one time bin, grouped by spans of surfels. The state of one span fits in
// the cache, so many bins are applied to a span before the next.
struct ObservationBatch {
  static constexpr int32_t kSpan = 2048;  // surfels
  std::vector<Observation> observations;
  std::vector<size_t> begin;  // first observation of each span, and the end

  static size_t span_of(int32_t surfel) { return static_cast<size_t>(surfel / kSpan); }
  static size_t n_spans(size_t surfels) { return (surfels + kSpan - 1) / kSpan; }
};

// Tabulated probability that a beam intersects an extent of +- half_extent when it passes at
// `offset`, with Gaussian lateral noise. Lengths in cells.
class IntersectionTables {
 public:
  explicit IntersectionTables(double lateral_std)
      : inverse_lateral_std_(static_cast<float>(1.0 / lateral_std)) {
    for (int i = 0; i < 2 * kLimit * kPerUnit + 2; ++i)
      cdf_.push_back(phi(static_cast<double>(i) / kPerUnit - kLimit));
    for (int i = 0; i < kMaxSquared * kPerSquaredUnit; ++i) {
      const double offset = std::sqrt((i + 0.5) / kPerSquaredUnit);
      isotropic_.push_back(phi((kIsotropicHalfExtent - offset) / lateral_std) -
                           phi((-kIsotropicHalfExtent - offset) / lateral_std));
    }
  }

  static constexpr double kIsotropicHalfExtent = 0.5;  // of a surfel without a plane, in cells

  float operator()(float half_extent, float offset) const {
    return cdf((half_extent - offset) * inverse_lateral_std_) -
           cdf((-half_extent - offset) * inverse_lateral_std_);
  }
  float isotropic(float offset_squared) const {
    const float index = offset_squared * kPerSquaredUnit;
    return index < kMaxSquared * kPerSquaredUnit ? isotropic_[static_cast<size_t>(index)] : 0.0f;
  }

 private:
  static constexpr int kLimit = 5, kPerUnit = 128, kMaxSquared = 3, kPerSquaredUnit = 1024;

  static float phi(double x) { return static_cast<float>(0.5 * std::erfc(-x / std::sqrt(2.0))); }
  float cdf(float x) const {
    constexpr float limit = kLimit;
    return cdf_[static_cast<size_t>((std::clamp(x, -limit, limit) + limit) * kPerUnit + 0.5f)];
  }

  float inverse_lateral_std_;
  std::vector<float> cdf_, isotropic_;
};

}  // namespace stillmap
