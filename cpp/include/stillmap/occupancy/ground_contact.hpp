// Relabels beams that end just above the ground next to a moving object: a voxel on the ground also
// holds the lower edges of wheels and shoes and would label them static. See
// docs/estimator.md.
#pragma once

#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/ground_columns.hpp"
#include "stillmap/occupancy/surfel.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Per-surfel labels (E,) and thresholds.
struct GroundContactInput {
  const bool* is_obstacle;     // part of an obstacle, not of the ground
  const float* p_static;       // P(static)
  const float* ground_height;  // metres, height of the ground below
  const bool* at_any_height;   // beams that end on it are relabelled however low they end
  int32_t column_cells;        // edge of a ground column, in cells
  double max_ground_height;    // metres above the ground up to which a mean counts as ground
  double min_end_height;  // metres above the ground from which on an end point is off the ground
};

class GroundContact {
 public:
  static constexpr double kFloorNormalZ = 0.85;  // cosine of the largest slope of a floor

  GroundContact(const SurfelMap<3>& surfel_map, const GroundContactInput& input)
      : surfel_map_(surfel_map), input_(input) {}

  // p_static (M,) of each beam that ends above a static ground surfel: mean P(static) of the
  // obstacles in its column; NaN where that is at least 0.5, and for all other beams. surfel (M,):
  // associated surfel of each beam.
  void relabel(const Scans<3>& scans, const int32_t* surfel, int threads, float* out) const {
    const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
    parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
      GroundColumns columns(surfel_map_, input_.column_cells);
      std::vector<double> p_static;
      for (size_t t = first; t < last; ++t) {
        pool_moving_columns(scans, t, surfel, columns, p_static);
        relabel(scans, t, surfel, columns, p_static, out);
      }
    });
  }

 private:
  // Mean P(static) per column; only columns with moving surfels are kept.
  void pool_moving_columns(const Scans<3>& scans, size_t t, const int32_t* surfel,
                           GroundColumns& columns, std::vector<double>& p_static) const {
    const auto for_each = [&](bool moving, auto&& visit) {
      for (int64_t n = scans.offset[t]; n < scans.offset[t + 1]; ++n) {
        const int32_t k = surfel[n];
        if (k == kNoSurfel || !input_.is_obstacle[k] || (input_.p_static[k] < 0.5f) != moving)
          continue;
        visit(k);
      }
    };
    columns.begin_sweep();
    for_each(true, [&](int32_t k) { columns.add(k); });
    columns.sort();
    p_static.assign(columns.size(), 0.0);
    if (p_static.empty()) return;
    std::vector<int64_t> counts(p_static.size(), 0);
    const auto add = [&](size_t c, size_t k) {
      p_static[c] += static_cast<double>(input_.p_static[k]);
      ++counts[c];
    };
    for (size_t c = 0; c < p_static.size(); ++c)
      columns.for_each_in(c, [&](size_t k) { add(c, k); });
    for_each(false, [&](int32_t k) {
      const size_t c = columns.find_column(ground_column(surfel_map_.cell(k), input_.column_cells));
      if (c < p_static.size() && columns.first_seen(k)) add(c, static_cast<size_t>(k));
    });
    for (size_t c = 0; c < p_static.size(); ++c) p_static[c] /= static_cast<double>(counts[c]);
  }

  void relabel(const Scans<3>& scans, size_t t, const int32_t* surfel, const GroundColumns& columns,
               const std::vector<double>& p_static, float* out) const {
    const Pose<3> pose = pose_from<3>(scans.poses + t * 16);
    for (int64_t n = scans.offset[t]; n < scans.offset[t + 1]; ++n) {
      out[n] = std::numeric_limits<float>::quiet_NaN();
      const int32_t k = surfel[n];
      if (p_static.empty() || !scans.hit[n] || k == kNoSurfel) continue;
      if (input_.is_obstacle[k] || input_.p_static[k] < 0.5f) continue;
      const BeamSegment<3> beam(pose, scans.points + n * 3, surfel_map_.resolution());
      const size_t c =
          columns.find_column(ground_column(cell_of<3>(beam.end), input_.column_cells));
      if (c == p_static.size() || p_static[c] >= 0.5) continue;
      if (on_ground(k) && (input_.at_any_height[k] || height(k, beam.end) > input_.min_end_height))
        out[n] = static_cast<float>(p_static[c]);
    }
  }

  // Excludes tree crowns and bridges.
  bool on_ground(int32_t k) const {
    const double z = surfel_map_.surfel(k).mean[2] * surfel_map_.resolution();
    return !input_.is_obstacle[k] &&
           z - static_cast<double>(input_.ground_height[k]) <= input_.max_ground_height;
  }

  // Metres above the plane of a floor surfel, otherwise above the ground height.
  double height(int32_t k, const Vec<3>& end) const {
    const Surfel<3>& e = surfel_map_.surfel(k);
    const double normal_z = e.normal[2];
    if (std::abs(normal_z) > kFloorNormalZ)
      return std::copysign(1.0, normal_z) * e.normal.dot(end - e.centre) * surfel_map_.resolution();
    return end[2] * surfel_map_.resolution() - static_cast<double>(input_.ground_height[k]);
  }

  const SurfelMap<3>& surfel_map_;
  GroundContactInput input_;
};

}  // namespace stillmap
