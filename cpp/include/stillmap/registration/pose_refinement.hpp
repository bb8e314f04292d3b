// A pass of pose refinement in 2D, (9): one scan after another is registered to the map of all
// others, with a prior from the motion since the scan before and until the scan after.
#pragma once

#include <algorithm>
#include <array>
#include <vector>

#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/beam_counting.hpp"
#include "stillmap/registration/endpoint_interpolation.hpp"
#include "stillmap/registration/scan_registration.hpp"
#include "stillmap/registration/surface_information.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

// Gaussian on the motion between two successive scans.
struct MotionStep {
  Pose<2> increment;
  double translation_std;  // metres
  double rotation_std;     // radians
  bool known;              // false: no prior

  Eigen::Matrix3d information() const {
    const double per_metre2 = 1.0 / (translation_std * translation_std);
    return Eigen::Vector3d(per_metre2, per_metre2, 1.0 / (rotation_std * rotation_std))
        .asDiagonal();
  }
};

struct RefinementOptions {
  ScanRegistrationOptions registration;
  InterpolationOptions interpolation;
  NormalOptions normals;
  double correlation_length;  // metres, see evidence_shares
  MotionStep no_motion;  // prior about its own pose of a scan without a known step to either side
};

// One scan.
struct ScanBeams {
  const float* points;  // (n, 2) metres, sensor frame; NaN: unusable
  const bool* hit;      // (n,)
  const float* e;       // (n,)
  int64_t n_beams;
  Pose<2> T_base_sensor;
};

// Scan t; the poses of `scans` are T_base_sensor.
inline ScanBeams beams_of(const Scans<2>& scans, const float* e, size_t t) {
  const int64_t first = scans.offset[t];
  return {scans.points + 2 * first, scans.hit + first, e + first, scans.offset[t + 1] - first,
          pose_from<2>(scans.poses + 9 * t)};
}

// Adds the hits of a scan at a pose, or removes them. Beams without a return may have met glass:
// they are no evidence against a surface.
inline void add_hits(OccupancyGrid<2>& grid, const ScanBeams& scan, const Pose<2>& T_map_base,
                     Fixed sign, const InterpolationOptions& options) {
  const auto T = row_major(T_map_base * scan.T_base_sensor);
  const std::array<int64_t, 2> offset = {0, scan.n_beams};
  const Scans<2> beams{scan.points, scan.hit, offset.data(), T.data(), 1};
  add_scans<2>(grid, beams, scan.e, sign, 0, 1, true);
  EndPointInterpolator(grid, beams, scan.e, sign, options).add();
}

// The hits of a scan with their normals, in the base frame.
inline WeightedBeams collect_hits(const ScanBeams& scan, const RefinementOptions& options) {
  WeightedBeams beams;
  for (int64_t n = 0; n < scan.n_beams; ++n) {
    if (!scan.hit[n] || !usable<2>(scan.points + 2 * n) || !(scan.e[n] > 0.0f)) continue;
    const Vec<2> point = scan.T_base_sensor * point_at<2>(scan.points + 2 * n);
    beams.points.emplace_back(point.cast<float>().cast<double>());  // as `Scan` stores them
    beams.weights.push_back(checked_probability(scan.e[n]));
  }
  beams.normals = estimate_normals(beams.points, options.normals);
  const auto shares = evidence_shares(beams.points, options.correlation_length);
  for (size_t n = 0; n < shares.size(); ++n) beams.weights[n] *= shares[n];
  return beams;
}

// Product of the Gaussians that the steps to either side predict; about the pose itself without
// any.
inline PosePrior neighbour_prior(const Pose<2>& before, const Pose<2>& here, const Pose<2>& after,
                                 const MotionStep& to_here, const MotionStep& to_after,
                                 const MotionStep& no_motion) {
  if (!to_here.known && !to_after.known) return {here, no_motion.information()};
  const Pose<2> from_before = before * to_here.increment;
  if (!to_after.known) return {from_before, to_here.information()};
  const Pose<2> from_after = after * to_after.increment.inverse();
  if (!to_here.known) return {from_after, to_after.information()};
  const Eigen::Matrix3d information = to_here.information() + to_after.information();
  const Eigen::Vector3d apart = from_after.boxminus(from_before);
  const Eigen::Vector3d shift = information.ldlt().solve(to_after.information() * apart);
  return {from_before.boxplus(shift), information};
}

// Registers scans one after another, each to the map of all others. `poses` (n + 2) has one more at
// either end, `steps` (n + 1) lead to each scan and beyond the last; the poses of `scans` are
// T_base_sensor.
inline std::vector<ScanRegistrationResult> refine_scans(OccupancyGrid<2>& grid,
                                                        const Scans<2>& scans, const float* e,
                                                        const bool* is_in_map,
                                                        std::vector<Pose<2>> poses,
                                                        const std::vector<MotionStep>& steps,
                                                        const RefinementOptions& options) {
  std::vector<ScanRegistrationResult> out;
  for (size_t t = 0; t < scans.n_scans; ++t) {
    const ScanBeams scan = beams_of(scans, e, t);
    Pose<2>& here = poses[t + 1];
    if (is_in_map[t]) add_hits(grid, scan, here, -1, options.interpolation);
    WeightedBeams beams = collect_hits(scan, options);
    const PosePrior prior =
        neighbour_prior(poses[t], here, poses[t + 2], steps[t], steps[t + 1], options.no_motion);
    LikelihoodField field(grid, options.registration.field);
    auto found = minimise_levenberg_marquardt(field, beams, prior, here, options.registration);
    found.information =
        prior.information + surface_information(field, beams, found.pose, options.registration);
    const double angle = std::atan2(found.pose.R(1, 0), found.pose.R(0, 0));
    found.pose.R = Eigen::Rotation2Dd(angle).toRotationMatrix();  // rounding errors add up
    here = found.pose;
    if (is_in_map[t]) add_hits(grid, scan, here, 1, options.interpolation);
    out.push_back(found);
  }
  return out;
}

}  // namespace stillmap
