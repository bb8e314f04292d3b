#include <nanobind/stl/optional.h>
#include <nanobind/stl/tuple.h>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/registration/correlative_search.hpp"
#include "stillmap/registration/likelihood_field.hpp"
#include "stillmap/registration/occlusion_check.hpp"
#include "stillmap/registration/scan_registration.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap::bindings {
namespace {

using Information =
    nb::ndarray<const double, nb::numpy, nb::shape<3, 3>, nb::c_contig, nb::device::cpu>;

// End points that can be used, and the weights of their beams.
template <int D>
std::pair<std::vector<Vec<D>>, std::vector<double>> weighted_points(const Points<D>& points,
                                                                    const Flat<float>& weights) {
  const float* w = per_beam(weights, points.shape(0), "weights");
  std::pair<std::vector<Vec<D>>, std::vector<double>> usable_points;
  for (size_t n = 0; n < points.shape(0); ++n) {
    const float* p = points.data() + n * D;
    if (!usable<D>(p) || !(w[n] > 0.0f)) continue;
    require(w[n] <= 1.0f, "weights: expected values in [0, 1]");
    usable_points.first.push_back(point_at<D>(p));
    usable_points.second.push_back(static_cast<double>(w[n]));
  }
  return usable_points;
}

WeightedBeams beams_from(const Points<2>& points, const Flat<float>& weights) {
  WeightedBeams beams;
  std::tie(beams.points, beams.weights) = weighted_points<2>(points, weights);
  return beams;
}

// Normals of the beams that `beams_from` kept.
void add_normals(WeightedBeams& beams, const Points<2>& points, const Flat<float>& weights,
                 const Points<2>& normals, const std::optional<Flat<float>>& isotropy) {
  const size_t n_beams = points.shape(0);
  require(normals.shape(0) == n_beams, "normals: expected as many rows as points has");
  require(isotropy.has_value(), "isotropy: expected along with normals");
  const float* s = per_beam(*isotropy, n_beams, "isotropy");
  for (size_t n = 0; n < n_beams; ++n) {
    if (!usable<2>(points.data() + n * 2) || !(weights.data()[n] > 0.0f)) continue;
    const Vec<2> normal = point_at<2>(normals.data() + n * 2);
    require(normal.allFinite() && s[n] >= 0.0f && s[n] <= 1.0f,
            "normals: expected finite vectors and isotropy in [0, 1]");
    beams.normals.push_back({normal, static_cast<double>(s[n])});
  }
}

std::vector<Vec<2>> end_points(const Points<2>& points) {
  std::vector<Vec<2>> ends;
  for (size_t n = 0; n < points.shape(0); ++n) ends.push_back(point_at<2>(points.data() + n * 2));
  return ends;
}

auto shares_of(const Points<2>& points, double correlation_length) {
  require(correlation_length > 0.0, "correlation_length: expected a positive length");
  std::vector<float> shares;
  for (const double share : evidence_shares(end_points(points), correlation_length))
    shares.push_back(std::isfinite(share) ? static_cast<float>(share) : 1.0f);
  const size_t n = shares.size();
  return to_numpy(std::move(shares), {n});
}

auto normals_of(const Points<2>& points, double radius, double max_gap, double flat_below,
                double round_from) {
  require(radius > 0.0 && max_gap > 0.0, "radius, max_gap: expected positive lengths");
  require(flat_below >= 0.0 && round_from > flat_below,
          "round_from: expected more than flat_below, which must not be negative");
  const auto found =
      estimate_normals(end_points(points), {radius, max_gap, flat_below, round_from});
  std::vector<float> normals, isotropy;
  for (const auto& surface : found) {
    for (const double x : {surface.normal[0], surface.normal[1]})
      normals.push_back(std::isfinite(x) ? static_cast<float>(x) : 0.0f);
    isotropy.push_back(std::isfinite(surface.isotropy) ? static_cast<float>(surface.isotropy)
                                                       : 0.0f);
  }
  const size_t n = found.size();
  return std::make_tuple(to_numpy(std::move(normals), {n, size_t{2}}),
                         to_numpy(std::move(isotropy), {n}));
}

auto register_scan(const OccupancyGrid<2>& grid, const Points<2>& points,
                   const Flat<float>& weights, const OnePose<2>& T_prior,
                   const Information& information, double sigma, int radius, double floor,
                   double unknown, double information_scale, int max_iterations,
                   double window_translation, double window_rotation, double search_range,
                   int max_candidates, const std::optional<OnePose<2>>& T_start,
                   const std::optional<Points<2>>& normals,
                   const std::optional<Flat<float>>& isotropy) {
  require(max_candidates >= 1, "max_candidates: expected at least one");
  const ScanRegistrationOptions options{
      {sigma, radius, floor, unknown}, information_scale, max_iterations};
  require(information_scale > 0.0, "information_scale: expected a positive number");
  require(window_translation >= 0.0 && window_rotation >= 0.0 && window_rotation <= 3.2,
          "window: expected half widths, rotation at most pi");
  auto beams = beams_from(points, weights);
  if (normals) add_normals(beams, points, weights, *normals, isotropy);
  PosePrior prior{checked_pose<2>(T_prior, "T_prior"), {}};
  for (int r = 0; r < 3; ++r)
    for (int c = 0; c < 3; ++c) prior.information(r, c) = information(r, c);
  require(prior.information.allFinite(), "information: not finite");
  std::optional<Pose<2>> given;
  if (T_start) given = checked_pose<2>(*T_start, "T_start");
  ScanRegistrationResult best;
  best.cost = std::numeric_limits<double>::infinity();
  size_t candidates = 0;
  std::vector<ScanRegistrationResult> found;
  {
    nb::gil_scoped_release released;
    LikelihoodField field(grid, options.field);
    const SearchWindow window{window_translation, window_rotation, search_range};
    CorrelativeSearch search(grid, beams, prior, window, options);
    const auto starting_poses = given ? std::vector<Candidate>{{*given, 0.0}}
                                      : search.best(static_cast<size_t>(max_candidates));
    for (const auto& start : starting_poses) {
      found.push_back(minimise_levenberg_marquardt(field, beams, prior, start.pose, options));
      if (found.back().cost < best.cost) best = found.back();
    }
    candidates = search.poses_tried();
    if (normals)
      best.information = prior.information + surface_information(field, beams, best.pose, options);
  }
  constexpr size_t n = 3;
  std::vector<double> alternatives;
  for (const auto& other : found) {
    const Lie<2>::Tangent apart = other.pose.boxminus(best.pose);
    alternatives.insert(alternatives.end(), apart.data(), apart.data() + n);
    alternatives.push_back(other.cost - best.cost);
  }
  Eigen::Matrix<double, 3, 3, Eigen::RowMajor> covariance =
      best.information.ldlt().solve(decltype(best.information)::Identity());
  return std::make_tuple(
      matrix_of<2>(best.pose),
      to_numpy(std::vector<double>(covariance.data(), covariance.data() + n * n), {n, n}),
      best.cost, best.inliers, best.iterations, candidates,
      to_numpy(std::move(alternatives), {found.size(), n + 1}));
}

template <int D>
double occluded_share_at(const OccupancyGrid<D>& grid, const Points<D>& points,
                         const Flat<float>& weights, const OnePose<D>& T,
                         const OnePose<D>& T_sensor, double margin, double min_occupancy) {
  require(margin >= 0.0, "margin: expected a length in metres that is not negative");
  require_probability(min_occupancy, "min_occupancy");
  const auto [ends, e] = weighted_points<D>(points, weights);
  return occluded_share<D>(grid, ends, e, checked_pose<D>(T, "T"),
                           checked_pose<D>(T_sensor, "T_sensor").t, margin, min_occupancy);
}

template <int D>
void bind_occluded_share(nb::module_& m) {
  m.def("occluded_share", &occluded_share_at<D>, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("T").noconvert(), nb::arg("T_sensor").noconvert(),
        nb::kw_only(), nb::arg("margin"), nb::arg("min_occupancy"),
        "Weighted share of beams, from a sensor at T T_sensor to the points at T, that cross a "
        "cell of occupancy >= min_occupancy more than `margin` metres before their end.");
}

// Data term without the constant ln(floor + 1) per beam, as in the reference implementation.
QuadraticModel data_term(const OccupancyGrid<2>& grid, const Points<2>& points,
                         const Flat<float>& weights, const OnePose<2>& T,
                         const LikelihoodFieldOptions& field_options) {
  auto beams = beams_from(points, weights);
  LikelihoodField field(grid, field_options);
  auto q = linearise(field, beams, checked_pose<2>(T, "T"), {field_options, 1.0, 0});
  for (const double w : beams.weights) q.cost -= w * std::log(field_options.floor + 1.0);
  return q;
}

double cost_at(const OccupancyGrid<2>& grid, const Points<2>& points, const Flat<float>& weights,
               const OnePose<2>& T, double sigma, int radius, double floor, double unknown) {
  const LikelihoodFieldOptions options{sigma, radius, floor, unknown};
  return data_term(grid, points, weights, T, options).cost;
}

auto gradient_at(const OccupancyGrid<2>& grid, const Points<2>& points, const Flat<float>& weights,
                 const OnePose<2>& T, double sigma, int radius, double floor, double unknown) {
  const LikelihoodFieldOptions options{sigma, radius, floor, unknown};
  const auto q = data_term(grid, points, weights, T, options);
  const size_t n = 3;
  return to_numpy(std::vector<double>(q.gradient.data(), q.gradient.data() + n), {n});
}

void bind_registration(nb::module_& m) {
  m.def(
      "register_scan", &register_scan, nb::arg("grid"), nb::arg("points").noconvert(),
      nb::arg("weights").noconvert(), nb::arg("T_prior").noconvert(),
      nb::arg("information").noconvert(), nb::kw_only(), nb::arg("sigma"), nb::arg("radius"),
      nb::arg("floor"), nb::arg("unknown"), nb::arg("information_scale"), nb::arg("max_iterations"),
      nb::arg("window_translation"), nb::arg("window_rotation"), nb::arg("search_range"),
      nb::arg("max_candidates"), nb::arg("T_start") = nb::none(),
      nb::arg("normals").noconvert() = nb::none(), nb::arg("isotropy").noconvert() = nb::none(),
      "Equation (9): scan-to-map registration. points (N, 2) float32: end points of returns in "
      "the moving frame; weights (N,) float32 = e; T_prior (3, 3) and information (3, 3) "
      "of (translation, rotation about the origin of the moving frame). A correlative search "
      "yields up to max_candidates poses, each refined by Newton steps; T_prior if no pose stands "
      "out. With T_start the search is skipped. Returns pose, covariance, cost, inlier share, "
      "number of Newton steps, number of scored lattice poses, and (R, dof + 1) offset and "
      "additional cost of each refined candidate against the best. With normals (N, 2) and "
      "isotropy (N,) of `estimate_normals`, "
      "the covariance is that of the surfaces' directions, and wide along a bare wall.");
  m.def("registration_cost", &cost_at, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("T").noconvert(), nb::arg("sigma"),
        nb::arg("radius"), nb::arg("floor"), nb::arg("unknown"),
        "Cost -sum w ln(floor + unknown U + F) at one pose, with the likelihood field F and U = 1 "
        "in unobserved cells.");
  m.def("registration_gradient", &gradient_at, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("weights").noconvert(), nb::arg("T").noconvert(), nb::arg("sigma"),
        nb::arg("radius"), nb::arg("floor"), nb::arg("unknown"),
        "Gradient (dof,) of `registration_cost` with respect to translation and rotation about the "
        "sensor.");
}

}  // namespace

void bind_scan_registration(nb::module_& m) {
  m.def("estimate_normals", &normals_of, nb::arg("points").noconvert(), nb::kw_only(),
        nb::arg("radius"), nb::arg("max_gap"), nb::arg("flat_below"), nb::arg("round_from"),
        "Normals (N, 2) float32 and isotropy (N,) float32 of the surfaces at the end points (N, 2) "
        "of a planar scan in the order of its beams. Neighbours are the successive end points "
        "within `radius` metres, each at most `max_gap` from the one before. Isotropy rises from 0 "
        "to 1 as the ratio of the variances across and along rises from flat_below to round_from. "
        "With fewer than two neighbours the normal is zero.");
  m.def(
      "evidence_shares", &shares_of, nb::arg("points").noconvert(), nb::kw_only(),
      nb::arg("correlation_length"),
      "Shares of evidence (N,) float32, in [0, 1], that the end points (N, 2) of a planar scan in "
      "the order of its beams do not have in common with their neighbours: half for each side on "
      "which the neighbour is `correlation_length` metres away, and less for a nearer one.");
  bind_registration(m);
  bind_occluded_share<2>(m);
  bind_occluded_share<3>(m);
}

}  // namespace stillmap::bindings
