// Scans as flat arrays, and single beams in units of cells.
#pragma once

#include <cmath>
#include <cstddef>
#include <cstdint>
#include <stdexcept>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

// View of T scans with M beams in total.
template <int D>
struct Scans {
  const float* points;    // (M, D) metres, sensor frame; NaN: unusable
  const bool* hit;        // (M,); false: maximum range (zeta = 1) or unusable
  const int64_t* offset;  // (T + 1,) first beam of each scan
  const double* poses;    // (T, D + 1, D + 1) T_map_sensor, row-major
  size_t n_scans;
};

template <int D>
inline bool usable(const float* point) {
  for (int d = 0; d < D; ++d)
    if (!std::isfinite(point[d])) return false;
  return true;
}

template <int D>
inline Vec<D> point_at(const float* p) {
  return Eigen::Map<const Eigen::Matrix<float, D, 1>>(p).template cast<double>();
}

template <int D>
inline void require_near(const Vec<D>& position) {
  if (!all_below<D>(position, BlockLayout<D>::kMaxCell))
    throw std::invalid_argument("beam: a pose or end point is not finite or too far away");
}

// End of a beam in units of cells; throws where its coordinates exceed kMaxCell.
template <int D>
inline Vec<D> beam_end(const Pose<D>& T_map_sensor, const float* point, double resolution) {
  const Vec<D> end = (T_map_sensor * point_at<D>(point)) / resolution;
  require_near<D>(end);
  return end;
}

// One beam in units of cells; throws where its coordinates exceed kMaxCell.
template <int D>
struct BeamSegment {
  Vec<D> start, end;

  BeamSegment(const Pose<D>& T_map_sensor, const float* point, double resolution)
      : start(T_map_sensor.t / resolution), end(beam_end<D>(T_map_sensor, point, resolution)) {
    require_near<D>(start);
  }
};

inline double checked_probability(float e) {
  if (!(e >= 0.0f && e <= 1.0f)) throw std::invalid_argument("e: expected probabilities in [0, 1]");
  return static_cast<double>(e);
}

// Calls work(scan, beam, pose) for every usable beam of the scans [first, last).
template <int D, class Work>
inline void for_each_beam(const Scans<D>& scans, size_t first, size_t last, Work&& work) {
  for (size_t t = first; t < last; ++t) {
    const Pose<D> pose = pose_from<D>(scans.poses + t * (D + 1) * (D + 1));
    for (int64_t n = scans.offset[t]; n < scans.offset[t + 1]; ++n)
      if (usable<D>(scans.points + n * D)) work(t, n, pose);
  }
}

}  // namespace stillmap
