// Beams that end just above the ground where, in the same sweep, something stands that moves.
//
// Voxels on the ground hold the lower edges of wheels and soles, too, and are the ground's. See
// docs/space.md.
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

// What is known of each element.
struct GroundContactInput {
  const bool* is_obstacle;     // whether it is of what stands on the ground, and not of the ground
  const float* p_static;       // probability
  const float* ground_height;  // m, height of the ground below it
  int32_t column_cells;        // cells, edge of the columns over the ground
  double max_ground_height;    // m above the ground up to where a mean is the ground's
  double min_end_height;       // m above the ground from where on a beam did not end on it
};

class GroundContact {
 public:
  static constexpr double kFloorNormalZ =
      0.85;  // cosine of the slope from which on a surface is no floor

  GroundContact(const SurfelMap<3>& surfel_map, const GroundContactInput& input)
      : surfel_map_(surfel_map), input_(input) {}

  // out (M,): mean probability of being static of what stands in the column of each beam that ends
  // above a static element of the ground; NaN where more of it is static, and for all others.
  // element (M,): in which each ended.
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
  // Mean probability in each column where something moves; `columns` has what moves alone.
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
      if (on_ground(k) && height(k, beam.end) > input_.min_end_height)
        out[n] = static_cast<float>(p_static[c]);
    }
  }

  // Crowns and bridges are not.
  bool on_ground(int32_t k) const {
    const double z = surfel_map_.surfel(k).mean[2] * surfel_map_.resolution();
    return !input_.is_obstacle[k] &&
           z - static_cast<double>(input_.ground_height[k]) <= input_.max_ground_height;
  }

  // Metres over the floor that an element is of, or else over the ground.
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
