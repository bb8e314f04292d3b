#include <nanobind/stl/tuple.h>

#include <cmath>
#include <tuple>

#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/grid/plane_projection.hpp"

namespace stillmap::bindings {
namespace {

using Heights = nb::ndarray<const double, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

auto project_scan(const Points<3>& points, const Flat<bool>& hit, const OnePose<3>& T,
                  const Heights& height, double corner_x, double corner_y, double edge, double low,
                  double high, double top, double cell, int64_t directions, bool open_space) {
  require(hit.shape(0) == points.shape(0), "hit: expected one per point");
  require(height.shape(0) > 0 && height.shape(1) > 0, "height: expected at least one square");
  require(std::isfinite(corner_x) && std::isfinite(corner_y), "corner: not finite");
  require(edge > 0.0 && std::isfinite(edge), "edge: expected a positive length in metres");
  require(low <= high && high <= top, "low, high, top: must not fall");
  require(cell > 0.0 && std::isfinite(cell), "cell: expected a positive length in metres");
  require(directions >= 1 && directions <= (int64_t{1} << 24),
          "directions: expected 1 to 16777216");
  const Pose<3> pose = checked_pose<3>(T, "T_map_sensor");
  std::vector<PlanarBeam> kept;
  {
    nb::gil_scoped_release released;
    const GroundHeights ground{
        height.data(), height.shape(0), height.shape(1), {corner_x, corner_y}, edge};
    PlaneProjection projection(ground, {low, high, top, cell, directions, open_space});
    kept = projection.project(points.data(), hit.data(), points.shape(0), pose);
  }
  const size_t n = kept.size();
  std::vector<double> ends;
  std::vector<int64_t> beams;
  std::vector<uint8_t> hits;
  for (const PlanarBeam& one : kept) {
    ends.insert(ends.end(), {pose.t[0] + one.x, pose.t[1] + one.y});
    hits.push_back(one.hit);
    beams.push_back(one.beam);
  }
  return std::make_tuple(to_numpy(std::move(ends), {n, size_t{2}}), to_numpy(std::move(hits), {n}),
                         to_numpy(std::move(beams), {n}));
}

}  // namespace

void bind_plane_projection(nb::module_& m) {
  m.def("project_scan", &project_scan, nb::arg("points").noconvert(), nb::arg("hit").noconvert(),
        nb::arg("T_map_sensor").noconvert(), nb::kw_only(), nb::arg("height").noconvert(),
        nb::arg("corner_x"), nb::arg("corner_y"), nb::arg("edge"), nb::arg("low"), nb::arg("high"),
        nb::arg("top"), nb::arg("cell"), nb::arg("directions"), nb::arg("open_space"),
        "Planar beams of one scan (N, 3) float32: ends (K, 2) float64 metres in the map, uint8 "
        "(K,) 1 for hits, int64 (K,) numbers of the beams. Obstacles are `low` to `high` metres "
        "above the ground, beams show free space up to `top`. height (H, W) float64 metres, of "
        "squares of `edge` metres from the corner on, row 0 at the lowest y. Kept are, for each of "
        "`directions` around, the longest beam without a hit and the first hit in each `cell` "
        "metres, in this order; without open_space beams without a return are left out.");
}

}  // namespace stillmap::bindings
