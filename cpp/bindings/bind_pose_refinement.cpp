#include <nanobind/stl/tuple.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/registration/pose_refinement.hpp"

namespace stillmap::bindings {
namespace {

using Stds = nb::ndarray<const double, nb::numpy, nb::shape<-1, 2>, nb::c_contig, nb::device::cpu>;

MotionStep step_with(const double* std) {
  require(std[0] > 0.0 && std[1] > 0.0, "step_std, own_pose_std: expected positive numbers");
  return {{}, std[0], std[1], true};
}

std::vector<MotionStep> steps_from(const Poses<2>& increments, const Stds& step_std,
                                   const Flat<bool>& has_step) {
  const size_t n = increments.shape(0);
  require(step_std.shape(0) == n && has_step.shape(0) == n,
          "step_std, has_step: expected as many rows as increments has");
  std::vector<MotionStep> steps;
  for (size_t k = 0; k < n; ++k) {
    steps.push_back(step_with(step_std.data() + 2 * k));
    steps.back().increment = pose_from<2>(increments.data() + 9 * k);
    steps.back().known = has_step.data()[k];
  }
  return steps;
}

auto refine(OccupancyGrid<2>& grid, const Points<2>& points, const Flat<bool>& hit,
            const Flat<float>& e, const Flat<int64_t>& offset, const Poses<2>& T_base_sensor,
            const Flat<bool>& is_in_map, const Poses<2>& poses, const Poses<2>& increments,
            const Stds& step_std, const Flat<bool>& has_step, const Flat<double>& own_pose_std,
            double sigma, int radius, double floor, double unknown, double information_scale,
            int max_iterations, double max_gap, double tolerance, double max_gap_ratio,
            double normal_radius, double normal_max_gap, double flat_below, double round_from,
            double correlation_length) {
  const auto scans = scans_from<2>(points, hit, offset, T_base_sensor);
  const size_t n = scans.n_scans;
  const float* weights = per_beam(e, points.shape(0), "e");
  require(is_in_map.shape(0) == n, "is_in_map: expected an entry per scan");
  require(poses.shape(0) == n + 2, "poses: expected those of the scans and one to either side");
  require(increments.shape(0) == n + 1, "increments: expected one to each scan and one beyond");
  require(own_pose_std.shape(0) == 2, "own_pose_std: expected metres and radians");
  require(information_scale > 0.0, "information_scale: expected a positive number");
  require(
      normal_radius > 0.0 && normal_max_gap > 0.0 && flat_below >= 0.0 && round_from > flat_below,
      "normal_radius, normal_max_gap, flat_below, round_from: as of estimate_normals");
  require(correlation_length > 0.0, "correlation_length: expected a positive length");
  const RefinementOptions options{
      {{sigma, radius, floor, unknown}, information_scale, max_iterations},
      {max_gap, tolerance, max_gap_ratio},
      {normal_radius, normal_max_gap, flat_below, round_from},
      correlation_length,
      step_with(own_pose_std.data())};
  const auto steps = steps_from(increments, step_std, has_step);
  std::vector<Pose<2>> all;
  for (size_t k = 0; k < n + 2; ++k) {
    all.push_back(pose_from<2>(poses.data() + 9 * k));
    require(all.back().R.allFinite() && all.back().t.allFinite(), "poses: not finite");
  }
  std::vector<ScanRegistrationResult> found;
  {
    nb::gil_scoped_release released;
    found = refine_scans(grid, scans, weights, is_in_map.data(), all, steps, options);
  }
  std::vector<double> refined, covariance, explained;
  for (const auto& one : found) {
    const auto T = row_major(one.pose);
    const Eigen::Matrix3d C = one.information.ldlt().solve(Eigen::Matrix3d::Identity());
    refined.insert(refined.end(), T.begin(), T.end());
    covariance.insert(covariance.end(), C.data(), C.data() + 9);  // symmetric
    explained.push_back(one.inliers);
  }
  return std::make_tuple(to_numpy(std::move(refined), {n, size_t{3}, size_t{3}}),
                         to_numpy(std::move(covariance), {n, size_t{3}, size_t{3}}),
                         to_numpy(std::move(explained), {n}));
}

}  // namespace

void bind_pose_refinement(nb::module_& m) {
  m.def(
      "refine_scans", &refine, nb::arg("grid"), nb::arg("points").noconvert(),
      nb::arg("hit").noconvert(), nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
      nb::arg("T_base_sensor").noconvert(), nb::arg("is_in_map").noconvert(),
      nb::arg("poses").noconvert(), nb::arg("increments").noconvert(),
      nb::arg("step_std").noconvert(), nb::arg("has_step").noconvert(),
      nb::arg("own_pose_std").noconvert(), nb::kw_only(), nb::arg("sigma"), nb::arg("radius"),
      nb::arg("floor"), nb::arg("unknown"), nb::arg("information_scale"), nb::arg("max_iterations"),
      nb::arg("max_gap"), nb::arg("tolerance"), nb::arg("max_gap_ratio"), nb::arg("normal_radius"),
      nb::arg("normal_max_gap"), nb::arg("flat_below"), nb::arg("round_from"),
      nb::arg("correlation_length"),
      "Equation (9) for n successive scans in 2D: each is taken out of the grid if it is in it, "
      "registered from its pose by Newton steps, and added again where it is found. poses "
      "(n + 2, 3, 3) T_map_base: the scan before, the scans, the scan after. The prior is the "
      "product of the Gaussians after the increments (n + 1, 3, 3) to and from the scan, with "
      "standard deviations step_std (n + 1, 2) in metres and radians; increments without "
      "has_step (n + 1,) are left out, and a scan with neither keeps to its pose with own_pose_std "
      "(2,). Returns poses (n, 3, 3), covariances (n, 3, 3) as of `register_scan` with normals, "
      "and inlier shares (n,).");
}

}  // namespace stillmap::bindings
