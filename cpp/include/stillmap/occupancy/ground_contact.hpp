// Beams that end just above the ground where, in the same sweep, something stands that moves.
//
// Voxels on the ground hold the lower edges of wheels and soles, too, and are the ground's. See
// docs/space.md.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "stillmap/occupancy/ground_columns.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// What is known of each element.
struct Standing {
  const bool* stands;     // whether it is of what stands on the ground, and not of the ground
  const float* p_static;  // probability
  const float* ground;    // m, height of the ground below it
  int32_t column;         // cells, edge of the columns over the ground
  double low;             // m above the ground up to where a mean is the ground's
  double least;           // m above the ground from where on a beam did not end on it
};

class Feet {
 public:
  static constexpr double kLevel = 0.85;  // cosine of the slope from which on a surface is no floor

  Feet(const Surface<3>& surface, const Standing& standing) : surface_(surface), of_(standing) {}

  // out (M,): mean probability of being static of what stands in the column of each beam that ends
  // above a static element of the ground; NaN where more of it is static, and for all others.
  // element (M,): in which each ended.
  void find(const Scans<3>& scans, const int32_t* element, int threads, float* out) const {
    const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
    parallel_shares(bounds, [&](size_t, size_t first, size_t last) {
      Columns columns(surface_, of_.column);
      std::vector<double> p;
      for (size_t t = first; t < last; ++t) {
        gather(scans, t, element, columns, p);
        find(scans, t, element, columns, p, out);
      }
    });
  }

 private:
  // Mean probability in each column where something moves; `columns` has what moves alone.
  void gather(const Scans<3>& scans, size_t t, const int32_t* element, Columns& columns,
              std::vector<double>& p) const {
    const auto for_each = [&](bool moving, auto&& visit) {
      for (int64_t n = scans.offset[t]; n < scans.offset[t + 1]; ++n) {
        const int32_t k = element[n];
        if (k == kNoElement || !of_.stands[k] || (of_.p_static[k] < 0.5f) != moving) continue;
        visit(k);
      }
    };
    columns.clear();
    for_each(true, [&](int32_t k) { columns.add(k); });
    columns.sort();
    p.assign(columns.size(), 0.0);
    if (p.empty()) return;
    std::vector<int64_t> all(p.size(), 0);
    const auto add = [&](size_t c, size_t k) {
      p[c] += static_cast<double>(of_.p_static[k]);
      ++all[c];
    };
    for (size_t c = 0; c < p.size(); ++c) columns.for_each_in(c, [&](size_t k) { add(c, k); });
    for_each(false, [&](int32_t k) {
      const size_t c = columns.find(column_of(surface_.cell(k), of_.column));
      if (c < p.size() && columns.first_seen(k)) add(c, static_cast<size_t>(k));
    });
    for (size_t c = 0; c < p.size(); ++c) p[c] /= static_cast<double>(all[c]);
  }

  void find(const Scans<3>& scans, size_t t, const int32_t* element, const Columns& columns,
            const std::vector<double>& p, float* out) const {
    const Pose<3> pose = pose_from<3>(scans.poses + t * 16);
    for (int64_t n = scans.offset[t]; n < scans.offset[t + 1]; ++n) {
      out[n] = std::numeric_limits<float>::quiet_NaN();
      const int32_t k = element[n];
      if (p.empty() || !scans.hit[n] || k == kNoElement) continue;
      if (of_.stands[k] || of_.p_static[k] < 0.5f) continue;
      const Segment<3> beam(pose, scans.points + n * 3, surface_.resolution());
      const size_t c = columns.find(column_of(cell_of<3>(beam.end), of_.column));
      if (c == p.size() || p[c] >= 0.5) continue;
      if (on_ground(k) && height(k, beam.end) > of_.least) out[n] = static_cast<float>(p[c]);
    }
  }

  // Crowns and bridges are not.
  bool on_ground(int32_t k) const {
    const double z = surface_.element(k).mean[2] * surface_.resolution();
    return !of_.stands[k] && z - static_cast<double>(of_.ground[k]) <= of_.low;
  }

  // Metres over the floor that an element is of, or else over the ground.
  double height(int32_t k, const Vec<3>& end) const {
    const Element<3>& e = surface_.element(k);
    const double up = e.normal[2];
    if (std::abs(up) > kLevel)
      return std::copysign(1.0, up) * e.normal.dot(end - e.centre) * surface_.resolution();
    return end[2] * surface_.resolution() - static_cast<double>(of_.ground[k]);
  }

  const Surface<3>& surface_;
  Standing of_;
};

}  // namespace stillmap
