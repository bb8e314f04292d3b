// Array types of the Python interface, and checks of their shapes and values.
#pragma once

#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>

#include <stdexcept>
#include <string>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/util/lie.hpp"

namespace nb = nanobind;

namespace stillmap::bindings {

template <int D>
using Points = nb::ndarray<const float, nb::numpy, nb::shape<-1, D>, nb::c_contig, nb::device::cpu>;
template <int D>
using Poses = nb::ndarray<const double, nb::numpy, nb::shape<-1, D + 1, D + 1>, nb::c_contig,
                          nb::device::cpu>;
template <int D>
using Positions =
    nb::ndarray<const double, nb::numpy, nb::shape<-1, D>, nb::c_contig, nb::device::cpu>;
template <int D>
using OnePose =
    nb::ndarray<const double, nb::numpy, nb::shape<D + 1, D + 1>, nb::c_contig, nb::device::cpu>;
template <int D>
using Cells =
    nb::ndarray<const int64_t, nb::numpy, nb::shape<-1, D>, nb::c_contig, nb::device::cpu>;
template <class T>
using Flat = nb::ndarray<const T, nb::numpy, nb::ndim<1>, nb::c_contig, nb::device::cpu>;

// NumPy array that owns the data of a vector.
template <class T>
nb::ndarray<nb::numpy, T> to_numpy(std::vector<T>&& data, std::initializer_list<size_t> shape) {
  auto* held = new std::vector<T>(std::move(data));
  nb::capsule owner(held, [](void* p) noexcept { delete static_cast<std::vector<T>*>(p); });
  return nb::ndarray<nb::numpy, T>(held->data(), shape, owner);
}

inline void require(bool ok, const std::string& message) {
  if (!ok) throw std::invalid_argument(message);
}

template <int D>
Scans<D> scans_from(const Points<D>& points, const Flat<bool>& hit, const Flat<int64_t>& offset,
                    const Poses<D>& poses) {
  const size_t n_beams = points.shape(0), n_scans = poses.shape(0);
  require(hit.shape(0) == n_beams, "hit: expected " + std::to_string(n_beams) +
                                       " entries as points has rows, got " +
                                       std::to_string(hit.shape(0)));
  require(offset.shape(0) == n_scans + 1, "offset: expected " + std::to_string(n_scans + 1) +
                                              " entries, one more than T_map_sensor, got " +
                                              std::to_string(offset.shape(0)));
  const int64_t* o = offset.data();
  require(o[0] == 0 && o[n_scans] == static_cast<int64_t>(n_beams),
          "offset: expected to run from 0 to " + std::to_string(n_beams));
  for (size_t t = 0; t < n_scans; ++t) require(o[t] <= o[t + 1], "offset: must not decrease");
  return Scans<D>{points.data(), hit.data(), o, poses.data(), n_scans};
}

template <int D>
Cell<D> cell_from(const Cells<D>& cells, size_t k) {
  Cell<D> cell;
  for (int d = 0; d < D; ++d) {
    const int64_t c = cells.data()[k * D + static_cast<size_t>(d)];
    require(std::abs(c) < BlockLayout<D>::kMaxCell, "cells: out of range");
    cell[d] = static_cast<int32_t>(c);
  }
  return cell;
}

template <int D>
Pose<D> checked_pose(const OnePose<D>& T, const char* name) {
  const Pose<D> pose = pose_from<D>(T.data());
  require(pose.R.allFinite() && pose.t.allFinite(), std::string(name) + ": not finite");
  return pose;
}

template <int D>
auto matrix_of(const Pose<D>& pose) {
  const auto T = row_major(pose);
  return to_numpy(std::vector<double>(T.begin(), T.end()), {D + 1, D + 1});
}

inline const float* per_beam(const Flat<float>& values, size_t n_beams, const char* name) {
  require(values.shape(0) == n_beams, std::string(name) + ": expected " + std::to_string(n_beams) +
                                          " entries as points has rows, got " +
                                          std::to_string(values.shape(0)));
  return values.data();
}

inline void require_probability(double p, const char* name) {
  require(p >= 0.0 && p <= 1.0, std::string(name) + ": expected a probability in [0, 1]");
}

}  // namespace stillmap::bindings
