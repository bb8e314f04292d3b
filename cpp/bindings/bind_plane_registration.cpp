#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/grid/voxel_downsampling.hpp"
#include "stillmap/registration/ndt_map.hpp"
#include "stillmap/registration/plane_registration.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap::bindings {
namespace {

template <int D>
using Tangents =
    nb::ndarray<const double, nb::numpy, nb::shape<Lie<D>::kDof>, nb::c_contig, nb::device::cpu>;
template <int D>
using MovingSquare =
    nb::ndarray<const double, nb::numpy, nb::shape<2 * Lie<D>::kDof, 2 * Lie<D>::kDof>,
                nb::c_contig, nb::device::cpu>;

template <int D>
typename Lie<D>::Tangent finite_tangent(const Tangents<D>& twist, const char* name) {
  const typename Lie<D>::Tangent out = Eigen::Map<const typename Lie<D>::Tangent>(twist.data());
  require(out.allFinite(), std::string(name) + ": not finite");
  return out;
}

void require_weights(const float* weights, size_t n) {
  for (size_t i = 0; i < n; ++i)
    require(weights[i] >= 0.0f && weights[i] <= 1.0f, "weights: expected values in [0, 1]");
}

template <int D>
TimedPoints<D> timed_points(const Points<D>& points, const Flat<float>& weights,
                            const Flat<float>& times) {
  const size_t n = points.shape(0);
  const float* w = per_beam(weights, n, "weights");
  const float* tau = per_beam(times, n, "times");
  require_weights(w, n);
  TimedPoints<D> beams;
  for (size_t i = 0; i < n; ++i) {
    const float* p = points.data() + i * D;
    require(std::isfinite(tau[i]), "times: expected finite seconds");
    if (!usable<D>(p) || !(w[i] > 0.0f)) continue;
    beams.points.push_back(point_at<D>(p));
    beams.weights.push_back(static_cast<double>(w[i]));
    beams.times.push_back(static_cast<double>(tau[i]));
  }
  return beams;
}

PlaneOptions plane_options(double min_weight, double max_flatness, double min_extent) {
  require(min_weight > 0.0, "min_weight: expected a positive weight");
  require(max_flatness >= 0.0 && max_flatness <= 1.0, "max_flatness: expected a ratio in [0, 1]");
  require(min_extent >= 0.0, "min_extent: expected a variance that is not negative");
  return {min_weight, max_flatness, min_extent};
}

template <int D>
void add_points(NdtMap<D>& map, const Points<D>& points, const Flat<float>& weights,
                const OnePose<D>& T) {
  const float* w = per_beam(weights, points.shape(0), "weights");
  require_weights(w, points.shape(0));
  const Pose<D> pose = checked_pose<D>(T, "T_map_base");
  nb::gil_scoped_release released;
  for (size_t i = 0; i < points.shape(0); ++i) {
    const float* p = points.data() + i * D;
    if (usable<D>(p) && w[i] > 0.0f) map.add(pose * point_at<D>(p), static_cast<double>(w[i]));
  }
}

template <int D>
void crop(NdtMap<D>& map, const OnePose<D>& T, double radius) {
  require(radius > 0.0, "radius: expected a positive length in metres");
  const Pose<D> pose = checked_pose<D>(T, "T_map_base");
  nb::gil_scoped_release released;
  map.crop(pose.t, radius);
}

// Normals (N, D), offsets and variances (N,), and validity (N,).
template <int D>
auto fit_planes(const NdtMap<D>& map, const Positions<D>& positions, int level, double min_weight,
                double max_flatness, double min_extent) {
  const PlaneOptions options = plane_options(min_weight, max_flatness, min_extent);
  require(level >= 0 && level < map.levels(), "level: out of range");
  const size_t n = positions.shape(0);
  std::vector<double> normals(n * D, 0.0), offsets(n, 0.0), variances(n, 0.0);
  std::vector<int8_t> valid(n, 0);
  {
    nb::gil_scoped_release released;
    for (size_t i = 0; i < n; ++i) {
      const Vec<D> position = Eigen::Map<const Vec<D>>(positions.data() + i * D);
      Plane<D> plane;
      if (!map.fit_plane(position, level, options, plane)) continue;
      valid[i] = 1;
      for (size_t d = 0; d < D; ++d) normals[i * D + d] = plane.normal[static_cast<int>(d)];
      offsets[i] = plane.offset;
      variances[i] = plane.variance;
    }
  }
  return std::make_tuple(to_numpy(std::move(normals), {n, size_t{D}}),
                         to_numpy(std::move(offsets), {n}), to_numpy(std::move(variances), {n}),
                         to_numpy(std::move(valid), {n}));
}

template <class Matrix>
auto square_of(const Matrix& A) {
  const auto n = static_cast<size_t>(A.rows());
  std::vector<double> out(n * n);
  for (size_t r = 0; r < n; ++r)
    for (size_t c = 0; c < n; ++c) out[r * n + c] = A(static_cast<int>(r), static_cast<int>(c));
  return to_numpy(std::move(out), {n, n});
}

template <class Vector>
auto vector_of(const Vector& v) {
  const auto n = static_cast<size_t>(v.size());
  return to_numpy(std::vector<double>(v.data(), v.data() + n), {n});
}

template <int D>
auto register_to_map(const NdtMap<D>& map, const Points<D>& points, const Flat<float>& weights,
                     const Flat<float>& times, const OnePose<D>& T_prior,
                     const Tangents<D>& twist_prior, const MovingSquare<D>& information,
                     const std::optional<OnePose<D>>& T_start,
                     const std::optional<Tangents<D>>& twist_start, double min_weight,
                     double max_flatness, double min_extent, double range_std, double kernel_width,
                     double information_scale, int start_level, double start_slack,
                     int max_iterations, double tolerance, int threads) {
  require(range_std > 0.0 && kernel_width > 0.0 && information_scale > 0.0,
          "range_std, kernel_width, information_scale: expected positive numbers");
  require(start_level >= 0 && start_slack >= 0.0 && max_iterations >= 0 && tolerance > 0.0,
          "start_level, start_slack, max_iterations, tolerance: out of range");
  const PlaneRegistrationOptions options{plane_options(min_weight, max_flatness, min_extent),
                                         range_std,
                                         kernel_width,
                                         information_scale,
                                         start_level,
                                         start_slack,
                                         max_iterations,
                                         tolerance};
  const auto beams = timed_points<D>(points, weights, times);
  constexpr int n = 2 * Lie<D>::kDof;
  MotionPrior<D> prior;
  prior.mean = {checked_pose<D>(T_prior, "T_prior"), finite_tangent<D>(twist_prior, "twist_prior")};
  prior.information =
      Eigen::Map<const Eigen::Matrix<double, n, n, Eigen::RowMajor>>(information.data());
  require(prior.information.allFinite(), "information: not finite");
  MotionState<D> start = prior.mean;
  if (T_start) start.pose = checked_pose<D>(*T_start, "T_start");
  if (twist_start) start.twist = finite_tangent<D>(*twist_start, "twist_start");
  PlaneRegistrationResult<D> found;
  Eigen::Matrix<double, n, n> covariance;
  {
    nb::gil_scoped_release released;
    found = register_sweep<D>(map, beams, prior, start, options, threads);
    covariance = found.information.ldlt().solve(Eigen::Matrix<double, n, n>::Identity());
  }
  return std::make_tuple(matrix_of<D>(found.state.pose), vector_of(found.state.twist),
                         square_of(covariance), found.model.inlier_weight,
                         found.model.matched_weight, found.model.total_weight, found.iterations);
}

template <int D>
auto transform_points(const Points<D>& points, const Flat<float>& times, const Tangents<D>& twist) {
  const size_t n = points.shape(0);
  const float* tau = per_beam(times, n, "times");
  const auto xi = finite_tangent<D>(twist, "twist");
  std::vector<float> out(n * D);
  {
    nb::gil_scoped_release released;
    for (size_t i = 0; i < n; ++i) {
      const float* p = points.data() + i * D;
      const Vec<D> transformed =
          transform_by_twist<D>(xi, static_cast<double>(tau[i]), point_at<D>(p));
      for (size_t d = 0; d < D; ++d)
        out[i * D + d] = static_cast<float>(transformed[static_cast<int>(d)]);
    }
  }
  return to_numpy(std::move(out), {n, size_t{D}});
}

template <int D>
auto downsample(const Points<D>& points, const Flat<float>& weights, double voxel_size) {
  require(voxel_size > 0.0 && std::isfinite(voxel_size),
          "voxel_size: expected a positive length in metres");
  const float* w = per_beam(weights, points.shape(0), "weights");
  std::vector<int64_t> kept;
  {
    nb::gil_scoped_release released;
    kept = voxel_downsample<D>(points.data(), w, points.shape(0), voxel_size);
  }
  const size_t n = kept.size();
  return to_numpy(std::move(kept), {n});
}

// 3D only: in 2D scans are registered against a likelihood field.
void bind_3d(nb::module_& m) {
  constexpr int D = 3;
  nb::class_<NdtMap<D>>(
      m, "NdtMap3D",
      "NDT map: weighted moments of end points in voxels of `edge` metres, doubled from level to "
      "level; a voxel takes no more points once its weight reaches `max_weight`.")
      .def(nb::init<double, int, double>(), nb::arg("edge"), nb::arg("levels"),
           nb::arg("max_weight"))
      .def("__len__", &NdtMap<D>::size)
      .def_prop_ro("levels", &NdtMap<D>::levels)
      .def("add", &add_points<D>, nb::arg("points").noconvert(), nb::arg("weights").noconvert(),
           nb::arg("T_map_base").noconvert(),
           "Adds points (N, D) float32 in the frame of T_map_base, weights (N,) float32 = e.")
      .def("crop", &crop<D>, nb::arg("T_map_base").noconvert(), nb::arg("radius"),
           "Removes the voxels farther than `radius` metres from a pose.")
      .def("fit_planes", &fit_planes<D>, nb::arg("positions").noconvert(), nb::arg("level"),
           nb::kw_only(), nb::arg("min_weight"), nb::arg("max_flatness"), nb::arg("min_extent"),
           "Planes around positions (N, D) float64: normals (N, D), offsets (N,) along them, "
           "variances (N,) across, and (N,) int8: 1 where there is a plane. A plane needs weight "
           "min_weight, a variance ratio across to along of at most max_flatness, and an extent "
           "(variance in voxels squared) of at least min_extent.");
  m.def("register_sweep", &register_to_map<D>, nb::arg("map"), nb::arg("points").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("times").noconvert(),
        nb::arg("T_prior").noconvert(), nb::arg("twist_prior").noconvert(),
        nb::arg("information").noconvert(), nb::arg("T_start").noconvert() = nb::none(),
        nb::arg("twist_start").noconvert() = nb::none(), nb::kw_only(), nb::arg("min_weight"),
        nb::arg("max_flatness"), nb::arg("min_extent"), nb::arg("range_std"),
        nb::arg("kernel_width"), nb::arg("information_scale"), nb::arg("start_level"),
        nb::arg("start_slack"), nb::arg("max_iterations"), nb::arg("tolerance"), nb::arg("threads"),
        "Point-to-plane registration of one sweep, pose and twist. points (N, D) float32 in the "
        "moving frame, each at its own time; times (N,) float32, seconds from the pose; weights "
        "(N,) float32 = e; T_prior (D+1, D+1), twist_prior (dof,): velocity and angular rate in "
        "the moving frame; information (2 dof, 2 dof) of both. Returns pose, twist, covariance (2 "
        "dof, 2 dof) in the moving frame, the weights of inliers, of points with a plane and of "
        "all points, and the number of Gauss-Newton steps.");
  m.def("transform_by_twist", &transform_points<D>, nb::arg("points").noconvert(),
        nb::arg("times").noconvert(), nb::arg("twist").noconvert(),
        "(N, D) float32: points transformed to the time of the pose, Exp(time twist) p.");
  m.def("voxel_downsample", &downsample<D>, nb::arg("points").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("voxel_size"),
        "(K,) int64: ascending indices of the first usable point of positive weight in each voxel "
        "of `voxel_size` metres.");
}

}  // namespace

void bind_plane_registration(nb::module_& m) { bind_3d(m); }

}  // namespace stillmap::bindings
