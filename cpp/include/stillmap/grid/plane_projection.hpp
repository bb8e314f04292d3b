// Projection of a 3D scan to the plane: of the beams that pass a band of heights above the ground,
// the longest one without a hit per direction, and the first hit per direction and cell.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

// Height of the ground in squares, row 0 at the lowest y.
struct GroundHeights {
  const double* height;  // (rows, columns) metres
  size_t rows, columns;
  Vec<2> corner;  // metres, lower left of the lowest square
  double edge;    // metres, of a square

  // Outside, the height of the nearest square at the edge.
  double at(double x, double y) const {
    return height[index(y - corner[1], rows) * columns + index(x - corner[0], columns)];
  }

 private:
  size_t index(double from_corner, size_t count) const {
    const double at = std::floor(from_corner / edge);
    return static_cast<size_t>(std::clamp(at, 0.0, static_cast<double>(count - 1)));
  }
};

struct PlaneProjectionOptions {
  double low, high;    // metres above the ground, of obstacles
  double top;          // metres above the ground, up to which a beam shows free space
  double cell;         // metres, of which one hit per direction is kept
  int64_t directions;  // of a turn
  bool open_space;     // whether beams without a return show free space
};

// Beam in the plane that is kept: its end from the sensor in metres, and its number in the scan.
struct PlanarBeam {
  double x, y;
  int64_t beam;
  bool hit;
};

// Beams of a scan of n points (n, 3) in the frame of T_map_sensor that are kept, ordered by
// direction; in a direction the beam without a hit comes first, then the hits by distance. Of
// equals the first is kept.
class PlaneProjection {
 public:
  PlaneProjection(const GroundHeights& ground, const PlaneProjectionOptions& options)
      : ground_(ground),
        options_(options),
        longest_(static_cast<size_t>(options.directions)),
        begin_(longest_.size() + 1) {}

  std::vector<PlanarBeam> project(const float* points, const bool* hit, size_t n,
                                  const Pose<3>& T_map_sensor) {
    std::fill(longest_.begin(), longest_.end(), Candidate{{0.0, 0.0, -1, false}, -1.0, 0});
    std::fill(begin_.begin(), begin_.end(), size_t{0});
    hits_.clear();
    const double start = T_map_sensor.t[2] - ground_.at(T_map_sensor.t[0], T_map_sensor.t[1]);
    for (size_t i = 0; i < n; ++i)
      if ((hit[i] || options_.open_space) && usable<3>(points + 3 * i))
        add(T_map_sensor * point_at<3>(points + 3 * i), T_map_sensor.t, start, hit[i],
            static_cast<int64_t>(i));
    return select();
  }

 private:
  struct Candidate {
    PlanarBeam beam;
    double length;
    size_t direction;
  };

  void add(const Vec<3>& end, const Vec<3>& sensor, double start, bool hit, int64_t number) {
    const double above = end[2] - ground_.at(end[0], end[1]);
    const bool is_obstacle = hit && above >= options_.low && above <= options_.high;
    const double share = share_in_band(start, above);
    const double x = (end[0] - sensor[0]) * share, y = (end[1] - sensor[1]) * share;
    const Candidate one{{x, y, number, is_obstacle}, std::sqrt(x * x + y * y), direction_of(x, y)};
    if (is_obstacle) {
      hits_.push_back(one);
      ++begin_[one.direction + 1];
    } else if (Candidate& best = longest_[one.direction]; one.length > best.length) {
      best = one;
    }
  }

  // Share of its length after which a beam leaves the band.
  double share_in_band(double start, double above) const {
    const double rise = above - start;
    double share = 1.0;
    if (above < options_.low) share = std::min(share, (start - options_.low) / -rise);
    if (above > options_.top) share = std::min(share, (options_.top - start) / rise);
    return std::clamp(share, 0.0, 1.0);
  }

  size_t direction_of(double x, double y) const {
    constexpr double turn = 2.0 * 3.141592653589793;
    const auto n = static_cast<double>(options_.directions);
    const auto direction = static_cast<int64_t>(std::floor(std::atan2(y, x) * (n / turn)));
    const int64_t wrapped = direction % options_.directions;
    return static_cast<size_t>(wrapped < 0 ? wrapped + options_.directions : wrapped);
  }

  std::vector<PlanarBeam> select() {
    for (size_t d = 1; d < begin_.size(); ++d) begin_[d] += begin_[d - 1];
    sorted_.resize(hits_.size());
    for (const Candidate& one : hits_) sorted_[begin_[one.direction]++] = &one;
    std::vector<PlanarBeam> kept;
    size_t first = 0;
    for (size_t d = 0; d < longest_.size(); ++d) {
      if (longest_[d].beam.beam >= 0) kept.push_back(longest_[d].beam);
      select_hits(first, begin_[d], kept);  // where direction d ends by now
      first = begin_[d];
    }
    return kept;
  }

  // The first of the hits [first, last) in each cell along their direction.
  void select_hits(size_t first, size_t last, std::vector<PlanarBeam>& kept) {
    const auto cell_of_hit = [&](const Candidate* one) {
      return std::floor(one->length / options_.cell);
    };
    const auto begin = sorted_.begin() + static_cast<std::ptrdiff_t>(first);
    const auto end = sorted_.begin() + static_cast<std::ptrdiff_t>(last);
    std::stable_sort(begin, end, [&](const Candidate* a, const Candidate* b) {
      return cell_of_hit(a) < cell_of_hit(b);
    });
    for (auto one = begin; one != end; ++one)
      if (one == begin || cell_of_hit(*one) != cell_of_hit(*(one - 1)))
        kept.push_back((*one)->beam);
  }

  GroundHeights ground_;
  PlaneProjectionOptions options_;
  std::vector<Candidate> longest_;  // by direction, without a hit; beam -1: none
  std::vector<Candidate> hits_;
  std::vector<size_t> begin_;             // where the hits of a direction begin
  std::vector<const Candidate*> sorted_;  // by direction
};

}  // namespace stillmap
