// A pass of pose refinement in 2D, (9): one scan after another is registered to the map of all
// others, with a prior from the motion since the scan before and until the scan after.
#pragma once

#include <algorithm>
#include <array>
#include <memory>
#include <vector>

#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/beam_counting.hpp"
#include "stillmap/registration/endpoint_interpolation.hpp"
#include "stillmap/registration/scan_registration.hpp"
#include "stillmap/registration/surface_information.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

// Motion between two successive scans, with isotropic noise.
struct MotionStep {
  Pose<2> increment;
  double translation_std;  // metres
  double rotation_std;     // radians
  bool known;

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
  MotionStep at_rest;  // the noise of a scan without a known step to either side
};

// View of one scan.
struct ScanView {
  const float* points;  // (n, 2) metres, sensor frame; NaN: unusable
  const bool* hit;      // (n,)
  const float* e;       // (n,)
  int64_t n_beams;
  Pose<2> T_base_sensor;
};

inline Pose<2> compose(const Pose<2>& a, const Pose<2>& b) {
  Pose<2> out;
  out.R = a.R * b.R;
  out.t = a * b.t;
  return out;
}

inline Pose<2> inverse(const Pose<2>& pose) {
  Pose<2> out;
  out.R = pose.R.transpose();
  out.t = -(out.R * pose.t);
  return out;
}

inline std::array<double, 9> row_major(const Pose<2>& T) {
  return {T.R(0, 0), T.R(0, 1), T.t[0], T.R(1, 0), T.R(1, 1), T.t[1], 0.0, 0.0, 1.0};
}

// Adds the hits of a scan at a pose, or removes them. Beams without a return may have met glass:
// they are no evidence against a surface.
inline void add_hits(OccupancyGrid<2>& grid, const ScanView& scan, const Pose<2>& T_map_base,
                     Fixed sign, const InterpolationOptions& options) {
  const auto T = row_major(compose(T_map_base, scan.T_base_sensor));
  std::vector<float> points, e;
  for (int64_t n = 0; n < scan.n_beams; ++n) {
    if (!scan.hit[n]) continue;
    points.insert(points.end(), {scan.points[2 * n], scan.points[2 * n + 1]});
    e.push_back(scan.e[n]);
  }
  const std::unique_ptr<bool[]> all_hit(new bool[e.size() + 1]);
  std::fill(all_hit.get(), all_hit.get() + e.size(), true);
  const std::array<int64_t, 2> of_hits = {0, static_cast<int64_t>(e.size())};
  const std::array<int64_t, 2> of_all = {0, scan.n_beams};
  const Scans<2> hits{points.data(), all_hit.get(), of_hits.data(), T.data(), 1};
  add_scans<2>(grid, hits, e.data(), sign, 0, 1);
  const Scans<2> all{scan.points, scan.hit, of_all.data(), T.data(), 1};
  EndPointInterpolator<2>(grid, all, scan.e, sign, options).add();
}

// The hits of a scan with their normals, in the base frame.
inline WeightedBeams<2> collect_hits(const ScanView& scan, const NormalOptions& options) {
  WeightedBeams<2> beams;
  for (int64_t n = 0; n < scan.n_beams; ++n) {
    if (!scan.hit[n] || !usable<2>(scan.points + 2 * n) || !(scan.e[n] > 0.0f)) continue;
    const Vec<2> point = scan.T_base_sensor * point_at<2>(scan.points + 2 * n);
    beams.points.emplace_back(point.cast<float>().cast<double>());  // as recordings store them
    beams.weights.push_back(checked_probability(scan.e[n]));
  }
  beams.normals = estimate_normals(beams.points, options);
  return beams;
}

// Product of the Gaussians that the steps to either side predict; `here` without any.
inline PosePrior<2> neighbour_prior(const Pose<2>& before, const Pose<2>& here,
                                    const Pose<2>& after, const MotionStep& to_here,
                                    const MotionStep& to_after, const MotionStep& at_rest) {
  if (!to_here.known && !to_after.known) return {here, at_rest.information()};
  const Pose<2> from_before = compose(before, to_here.increment);
  if (!to_after.known) return {from_before, to_here.information()};
  const Pose<2> from_after = compose(after, inverse(to_after.increment));
  if (!to_here.known) return {from_after, to_after.information()};
  const Eigen::Matrix3d information = to_here.information() + to_after.information();
  const Eigen::Vector3d apart = from_after.boxminus(from_before);
  const Eigen::Vector3d shift = information.ldlt().solve(to_after.information() * apart);
  return {from_before.boxplus(shift), information};
}

// Registers scans one after another. `poses` has one more at either end; those between are replaced
// by refined ones. `steps` lead to each of them and beyond the last.
template <class Scan, class Done>
inline void refine_scans(OccupancyGrid<2>& grid, size_t n_scans, Scan&& scan, const bool* is_in_map,
                         std::vector<Pose<2>>& poses, const std::vector<MotionStep>& steps,
                         const RefinementOptions& options, Done&& done) {
  for (size_t t = 0; t < n_scans; ++t) {
    const ScanView view = scan(t);
    Pose<2>& here = poses[t + 1];
    if (is_in_map[t]) add_hits(grid, view, here, -1, options.interpolation);
    WeightedBeams<2> beams = collect_hits(view, options.normals);
    const PosePrior<2> prior =
        neighbour_prior(poses[t], here, poses[t + 2], steps[t], steps[t + 1], options.at_rest);
    LikelihoodField<2> field(grid, options.registration.field);
    auto found = minimise_levenberg_marquardt<2>(field, beams, prior, here, options.registration);
    found.information =
        prior.information + surface_information<2>(field, beams, found.pose, options.registration);
    const double angle = std::atan2(found.pose.R(1, 0), found.pose.R(0, 0));
    here.R = Eigen::Rotation2Dd(angle).toRotationMatrix();  // rounding errors would accumulate
    here.t = found.pose.t;
    if (is_in_map[t]) add_hits(grid, view, here, 1, options.interpolation);
    done(t, here, found);
  }
}

}  // namespace stillmap
