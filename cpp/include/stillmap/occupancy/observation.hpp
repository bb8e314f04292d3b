// A look: what the beams of a short time say about the elements of a surface.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace stillmap {

struct ObservationOptions {
  double bin_seconds;         // between successive looks
  double lateral_std;         // cells: how far a beam may pass beside where it seems to
  double margin;              // cells: how far behind an element a beam must end to have passed it
  double hit_radius;          // cells: hits so near to an element are hits of it
  double end_margin;          // cells before its end up to which a maximum-range beam is trusted
  double trust_beyond_solid;  // how far to trust a beam without a return beyond the first solid
                              // element
  bool use_normals;           // whether surfaces face somewhere; else every element is round
};

// Beams without a return that are not alone, and those of them that cross something solid.
struct NoReturnStats {
  int64_t beam_count = 0, through_solid = 0;
};

// What one look says about one element.
struct Observation {
  static constexpr float kHit = 2.0f;
  int32_t surfel;
  float reliability;  // probability in (0, 1] that some beam met the element's place, or kHit
};

// What one look says, sorted by spans of elements: what is known of the elements of a span fits a
// cache, and many looks are applied to one span before the next.
struct ObservationBatch {
  static constexpr int32_t kSpan = 2048;  // elements
  std::vector<Observation> observations;
  std::vector<size_t> begin;  // of each span, and the end

  static size_t span_of(int32_t surfel) { return static_cast<size_t>(surfel / kSpan); }
  static size_t n_spans(size_t surfels) { return (surfels + kSpan - 1) / kSpan; }
};

// Probability that a beam meets what extends `half` to both sides and which it seems to pass at a
// distance, known up to `lateral`; from tables, for every beam asks for it in every cell.
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

  static constexpr double kIsotropicHalfExtent =
      0.5;  // half extent of what is no surface, in cells

  float operator()(float half_extent, float offset) const {
    return cdf((half_extent - offset) * inverse_lateral_std_) -
           cdf((-half_extent - offset) * inverse_lateral_std_);
  }
  float isotropic(float offset_squared) const {
    const float at = offset_squared * kPerSquaredUnit;
    return at < kMaxSquared * kPerSquaredUnit ? isotropic_[static_cast<size_t>(at)] : 0.0f;
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
