#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/occupancy/beam_counting.hpp"
#include "stillmap/occupancy/no_return_beams.hpp"
#include "stillmap/registration/endpoint_interpolation.hpp"
#include "stillmap/registration/evidence_counting.hpp"

namespace stillmap::bindings {
namespace {

template <int D>
void add(OccupancyGrid<D>& grid, const Points<D>& points, const Flat<bool>& hit,
         const Flat<float>& e, const Flat<int64_t>& offset, const Poses<D>& poses, int threads,
         bool remove, bool hits_only) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const float* weights = per_beam(e, points.shape(0), "e");
  nb::gil_scoped_release released;
  add_beams<D>(grid, scans, weights, remove ? -1 : 1, threads, hits_only);
}

template <int D>
void ends(OccupancyGrid<D>& grid, const Points<D>& points, const Flat<bool>& hit,
          const Flat<float>& e, const Flat<int64_t>& offset, const Poses<D>& poses, bool remove) {
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const float* weights = per_beam(e, points.shape(0), "e");
  nb::gil_scoped_release released;
  add_end_points<D>(grid, scans, weights, remove ? -1 : 1);
}

void fill(OccupancyGrid<2>& grid, const Points<2>& points, const Flat<bool>& hit,
          const Flat<float>& e, const Flat<int64_t>& offset, const Poses<2>& poses, double max_gap,
          double tolerance, double max_gap_ratio, bool remove) {
  const auto scans = scans_from<2>(points, hit, offset, poses);
  const float* weights = per_beam(e, points.shape(0), "e");
  require(max_gap >= 0.0 && tolerance >= 0.0 && max_gap_ratio >= 0.0,
          "max_gap, tolerance, max_gap_ratio: expected numbers that are not negative");
  nb::gil_scoped_release released;
  EndPointInterpolator(grid, scans, weights, remove ? -1 : 1, {max_gap, tolerance, max_gap_ratio})
      .add();
}

template <int D>
void add_no_return(OccupancyGrid<D>* grid, OccupancyGrid<D>* rest, const Points<D>& points,
                   const Flat<bool>& hit, const Flat<int64_t>& offset, const Poses<D>& poses,
                   const Cells<D>& stop_cells, double end_margin, int threads) {
  require(grid || rest, "grid, rest: expected at least one of them");
  require(!grid || !rest || (grid != rest && grid->resolution() == rest->resolution()),
          "rest: expected another grid of the same resolution");
  require(end_margin >= 0.0, "end_margin: expected a length in metres that is not negative");
  const auto scans = scans_from<D>(points, hit, offset, poses);
  std::vector<Cell<D>> cells;
  for (size_t k = 0; k < stop_cells.shape(0); ++k) cells.push_back(cell_from<D>(stop_cells, k));
  nb::gil_scoped_release released;
  const double cells_to_end = end_margin / (grid ? grid : rest)->resolution();
  add_no_return_beams<D>(grid, rest, scans, {cells, cells_to_end}, threads);
}

void near_returns(OccupancyGrid<2>& grid, const Points<2>& points, const Flat<bool>& hit,
                  const Flat<float>& e, const Flat<int64_t>& offset, const Poses<2>& poses,
                  const Flat<int64_t>& selected, double correlation_length,
                  const OccupancyGrid<2>* other, bool everywhere) {
  const auto all = scans_from<2>(points, hit, offset, poses);
  const float* weights = per_beam(e, points.shape(0), "e");
  require(correlation_length > 0.0, "correlation_length: expected a positive length in metres");
  require(!grid.with_moments(), "grid: expected one without moments");
  require(!other || other->resolution() == grid.resolution(),
          "other: expected the same resolution");
  std::vector<Scans<2>> scans;
  for (size_t k = 0; k < selected.shape(0); ++k) {
    const auto t = static_cast<size_t>(selected.data()[k]);
    require(t < all.n_scans, "scans: out of range");
    scans.push_back({all.points, all.hit, all.offset + t, all.poses + 9 * t, 1});
  }
  nb::gil_scoped_release released;
  ReturnTiles tiles(grid, other, everywhere);
  count_near_returns(grid, scans, weights, correlation_length, tiles);
}

template <int D>
auto expected_labels(const OccupancyGrid<D>& grid, const Points<D>& points, const Flat<bool>& hit,
                     const Flat<int64_t>& offset, const Poses<D>& poses, double prior,
                     int threads) {
  require_probability(prior, "prior");
  const auto scans = scans_from<D>(points, hit, offset, poses);
  std::vector<float> e(points.shape(0));
  {
    nb::gil_scoped_release released;
    e_step<D>(grid, scans, prior, threads, e.data());
  }
  const size_t n = e.size();
  return to_numpy(std::move(e), {n});
}

template <int D>
auto likelihood(const OccupancyGrid<D>& grid, const Points<D>& points, const Flat<bool>& hit,
                const Flat<float>& e, const Flat<int64_t>& offset, const Poses<D>& poses,
                double prior, int threads) {
  require_probability(prior, "prior");
  const auto scans = scans_from<D>(points, hit, offset, poses);
  const float* weights = per_beam(e, points.shape(0), "e");
  std::vector<LogLikelihoodTerms> terms(scans.n_scans);
  {
    nb::gil_scoped_release released;
    log_likelihood<D>(grid, scans, weights, prior, threads, terms.data());
  }
  std::vector<double> out;
  out.reserve(4 * terms.size());
  for (const auto& t : terms) out.insert(out.end(), {t.end, t.traversed, t.gamma, t.entropy});
  return to_numpy(std::move(out), {scans.n_scans, 4});
}

template <int D>
void bind(nb::module_& m) {
  m.def("add_beams", &add<D>, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("threads") = 1, nb::kw_only(),
        nb::arg("remove") = false, nb::arg("hits_only") = false,
        "Adds the sums alpha, beta of (10) of all beams to the grid, or of those with a return; e "
        "(M,) float32. With remove it subtracts the same sums exactly.");
  m.def("add_end_points", &ends<D>, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::kw_only(), nb::arg("remove") = false,
        "Adds or removes the part of the sums of `add_beams` that depends on e (end cells of "
        "returns). Removing it with the old e and adding it with a new one updates the grid "
        "exactly.");
  m.def("add_no_return_beams", &add_no_return<D>, nb::arg("grid").none(), nb::arg("rest").none(),
        nb::arg("points").noconvert(), nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("stop_cells").noconvert(),
        nb::arg("end_margin"), nb::arg("threads") = 1,
        "Adds the beams without a return as `add_beams` does, split over two grids: the trusted "
        "part to grid, the remainder to rest; None leaves a part out. Runs of fewer than three "
        "such beams are not trusted; "
        "the others are trusted up to the first of stop_cells (S, D) int64 and not within "
        "`end_margin` metres (may be infinite) of their end.");
  m.def("e_step", &expected_labels<D>, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("prior"), nb::arg("threads") = 1,
        "Equations (6), (8): e (M,) float32. NaN for unusable beams; the prior for maximum-range "
        "beams and unobserved end cells.");
  m.def("log_likelihood", &likelihood<D>, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("prior"), nb::arg("threads") = 1,
        "(T, 4) float64 per scan: end-point terms of (5), traversal terms of (5), gamma of (7), "
        "entropy of e. Logarithms are floored at ln 1e-12.");
}

}  // namespace

void bind_beam_counting(nb::module_& m) {
  bind<2>(m);
  bind<3>(m);
  m.def("count_near_returns", &near_returns, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::arg("scans").noconvert(), nb::kw_only(),
        nb::arg("correlation_length"), nb::arg("other").none() = nb::none(),
        nb::arg("everywhere") = false,
        "Adds the sums of (10) of some scans (n,) int64 that the evidence of a map needs: e of the "
        "end points times `evidence_shares`, and the lengths of beams near returns of these scans "
        "or of another grid, or everywhere.");
  m.def("interpolate_end_points", &fill, nb::arg("grid"), nb::arg("points").noconvert(),
        nb::arg("hit").noconvert(), nb::arg("e").noconvert(), nb::arg("offset").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::kw_only(), nb::arg("max_gap"),
        nb::arg("tolerance"), nb::arg("max_gap_ratio"), nb::arg("remove") = false,
        "Interpolates end points, one per cell, between neighbouring end points at most `max_gap` "
        "metres apart that are collinear with a third one within `tolerance` metres; the gap is at "
        "most `max_gap_ratio` times that to the third one. They take the smaller e of the two and "
        "add nothing to crossed cells. With remove it subtracts the same sums exactly.");
}

}  // namespace stillmap::bindings
