// A look: what the beams of a short time say about the elements of a surface.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <vector>

namespace stillmap {

struct LookOptions {
  double seconds;  // between successive looks
  double lateral;  // cells: how far a beam may pass beside where it seems to
  double margin;   // cells: how far behind an element a beam must end to have passed it
  double reach;    // cells: hits so near to an element are hits of it
  double beyond;   // cells before its end up to which a maximum-range beam is trusted
  double open;     // how far to trust a beam without a return beyond the first solid element
  bool normals;    // whether surfaces face somewhere; else every element is round
};

// Beams without a return that are not alone, and those of them that cross something solid.
struct Lost {
  int64_t beams = 0, through_solid = 0;
};

// What one look says about one element.
struct Look {
  static constexpr float kHit = 2.0f;
  int32_t element;
  float seen_through;  // probability in (0, 1] that some beam met the element's place, or kHit
};

// What one look says, sorted by spans of elements: what is known of the elements of a span fits a
// cache, and many looks are applied to one span before the next.
struct Seen {
  static constexpr int32_t kSpan = 2048;  // elements
  std::vector<Look> looks;
  std::vector<size_t> begin;  // of each span, and the end

  static size_t span_of(int32_t element) { return static_cast<size_t>(element / kSpan); }
  static size_t spans(size_t elements) { return (elements + kSpan - 1) / kSpan; }
};

// Probability that a beam meets what extends `half` to both sides and which it seems to pass at a
// distance, known up to `lateral`; from tables, for every beam asks for it in every cell.
class MeetingTables {
 public:
  explicit MeetingTables(double lateral) : per_lateral_(static_cast<float>(1.0 / lateral)) {
    for (int i = 0; i < 2 * kLimit * kPerUnit + 2; ++i)
      cdf_.push_back(phi(static_cast<double>(i) / kPerUnit - kLimit));
    for (int i = 0; i < kSquares * kPerSquare; ++i) {
      const double aside = std::sqrt((i + 0.5) / kPerSquare);
      round_.push_back(phi((kRound - aside) / lateral) - phi((-kRound - aside) / lateral));
    }
  }

  static constexpr double kRound = 0.5;  // half extent of what is no surface, in cells

  float operator()(float half, float aside) const {
    return cdf((half - aside) * per_lateral_) - cdf((-half - aside) * per_lateral_);
  }
  float round(float aside_squared) const {
    const float at = aside_squared * kPerSquare;
    return at < kSquares * kPerSquare ? round_[static_cast<size_t>(at)] : 0.0f;
  }

 private:
  static constexpr int kLimit = 5, kPerUnit = 128, kSquares = 3, kPerSquare = 1024;

  static float phi(double x) { return static_cast<float>(0.5 * std::erfc(-x / std::sqrt(2.0))); }
  float cdf(float x) const {
    constexpr float limit = kLimit;
    return cdf_[static_cast<size_t>((std::clamp(x, -limit, limit) + limit) * kPerUnit + 0.5f)];
  }

  float per_lateral_;
  std::vector<float> cdf_, round_;
};

}  // namespace stillmap
