// Closest points on a mesh, among faces that are turned towards the viewpoint of each query.
//
// Faces are sorted by size into levels of cells, each with cells of about the size of its faces, so
// memory is proportional to the number of faces. A query searches the cells of each level that are
// closer than the best result so far. Closest points on triangles: Ericson, Real-Time Collision
// Detection, 2005, Sect. 5.1.5.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <utility>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/voxel_hash_map.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct NearestPoints {
  std::vector<int32_t> face;        // -1: none within the distance
  std::vector<double> barycentric;  // of its three corners
};

namespace mesh_distance {

constexpr double kSliver = 1e-12;  // squared sine of the angle of a degenerate triangle
constexpr double kMinSquaredLength = 1e-300;

using Triangle = std::array<Vec<3>, 3>;

struct ClosestPoint {
  std::array<double, 3> barycentric;
  double squared_distance;  // to the query point
};

// In the order of the reference implementation, so that both break ties alike.
inline double dot(const Vec<3>& a, const Vec<3>& b) {
  return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

inline Vec<3> normal_of(const Triangle& t) {
  const Vec<3> u = t[1] - t[0], v = t[2] - t[0];
  return {u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]};
}

inline ClosestPoint point_at(const Vec<3>& p, const Triangle& t, const std::array<double, 3>& w) {
  double squared_distance = 0.0;
  for (int d = 0; d < 3; ++d) {
    const double off = p[d] - (w[0] * t[0][d] + w[1] * t[1][d] + w[2] * t[2][d]);
    squared_distance += off * off;
  }
  return {w, squared_distance};
}

inline std::array<double, 3> closest_on_edges(const Vec<3>& p, const Triangle& t) {
  std::array<double, 3> barycentric{};
  double smallest = std::numeric_limits<double>::infinity();
  for (size_t first = 0; first < 3; ++first) {
    const size_t second = (first + 1) % 3;
    const Vec<3> along = t[second] - t[first], from_first = p - t[first];
    const double fraction = std::clamp(
        dot(from_first, along) / std::max(dot(along, along), kMinSquaredLength), 0.0, 1.0);
    const Vec<3> rest = from_first - fraction * along;
    const double squared = dot(rest, rest);
    if (!(squared < smallest)) continue;
    smallest = squared;
    barycentric = {};
    barycentric[first] = 1.0 - fraction, barycentric[second] = fraction;
  }
  return barycentric;
}

// Closest point on a triangle.
inline ClosestPoint closest_point(const Vec<3>& p, const Triangle& t) {
  const Vec<3> u = t[1] - t[0], v = t[2] - t[0], w = p - t[0];
  const double uu = dot(u, u), uv = dot(u, v), vv = dot(v, v), wu = dot(w, u), wv = dot(w, v);
  const double determinant = uu * vv - uv * uv;
  if (determinant > kSliver * uu * vv) {
    const double j = (vv * wu - uv * wv) / determinant, k = (uu * wv - uv * wu) / determinant;
    if (j >= 0.0 && k >= 0.0 && j + k <= 1.0) return point_at(p, t, {1.0 - j - k, j, k});
  }
  return point_at(p, t, closest_on_edges(p, t));
}

// From a point to a box.
inline double squared_distance_to_box(const Vec<3>& p, const Vec<3>& low, const Vec<3>& high) {
  double squared_distance = 0.0;
  for (int d = 0; d < 3; ++d) {
    const double below = low[d] - p[d], above = p[d] - high[d];
    const double more = below > above ? below : above, off = more > 0.0 ? more : 0.0;
    squared_distance += off * off;
  }
  return squared_distance;
}

inline std::pair<Vec<3>, Vec<3>> bounding_box(const Triangle& t) {
  Vec<3> low = t[0], high = t[0];
  for (int d = 0; d < 3; ++d)
    for (size_t i = 1; i < 3; ++i) {
      low[d] = t[i][d] < low[d] ? t[i][d] : low[d];
      high[d] = t[i][d] > high[d] ? t[i][d] : high[d];
    }
  return {low, high};
}

}  // namespace mesh_distance

class MeshDistance {
 public:
  // vertices (V, 3) metres, faces (F, 3); max_distance in metres.
  MeshDistance(const double* vertices, size_t V, const int32_t* faces, size_t F,
               double max_distance)
      : max_distance_(max_distance), faces_(faces, faces + 3 * F) {
    for (size_t i = 0; i < V; ++i)
      vertices_.emplace_back(vertices[3 * i], vertices[3 * i + 1], vertices[3 * i + 2]);
    for (const auto& vertex : vertices_)
      low_ = low_.cwiseMin(vertex), high_ = high_.cwiseMax(vertex);
    edge_ = max_distance;
    if (V) edge_ = std::max(edge_, (high_ - low_).maxCoeff() / kMaxCells);
    inverse_edge_ = 1.0 / edge_;
    margin_ = kRoundingMargin * edge_;
    build_levels();
  }

  double max_distance() const { return max_distance_; }
  size_t size() const { return faces_.size() / 3; }

  size_t memory_bytes() const {
    size_t bytes = vertices_.capacity() * sizeof(Vec<3>) + faces_.capacity() * sizeof(int32_t);
    for (const auto& level : levels_)
      bytes += level.cells.memory_bytes() + level.faces.capacity() * sizeof(int32_t);
    return bytes;
  }

  // Closest faces to points (n, 3) that were seen from origins (n, 3). Back faces and faces without
  // area are excluded; the lowest number wins ties.
  NearestPoints nearest(const double* points, const double* origins, size_t n, int threads) const {
    NearestPoints out{std::vector<int32_t>(n, -1), std::vector<double>(3 * n, 0.0)};
    parallel_for_ranges(split_evenly(n, threads), [&](size_t, size_t first, size_t last) {
      for (size_t i = first; i < last; ++i) {
        const Vec<3> point(points + 3 * i), origin(origins + 3 * i);
        Best best = {point, origin - point, -1, {{}, max_distance_ * max_distance_}, 0.0};
        search(best);
        out.face[i] = best.face;
        std::copy_n(best.closest.barycentric.begin(), 3,
                    out.barycentric.begin() + 3 * std::ptrdiff_t(i));
      }
    });
    return out;
  }

 private:
  static constexpr double kMaxCells = 1 << 19;     // along an axis
  static constexpr double kMaxCellsPerFace = 4.0;  // along an axis
  static constexpr double kRoundingMargin = 1e-3;  // of a cell, more than rounding errors

  struct FaceRange {
    size_t first = 0, size = 0;  // in Level::faces
  };

  struct Level {
    int number;  // cells are 2^number times those of level 0
    double edge;
    VoxelHashMap<3, FaceRange> cells;
    std::vector<int32_t> faces;  // by cell, ascending

    Cell<3> coarse_cell(const Cell<3>& smallest) const {
      return {smallest[0] >> number, smallest[1] >> number, smallest[2] >> number};
    }
  };

  struct Best {
    Vec<3> point, to_origin;  // query, and direction to its viewpoint
    int32_t face;
    mesh_distance::ClosestPoint closest;
    double squared_radius;  // search radius
  };

  mesh_distance::Triangle corners(int32_t face) const {
    const int32_t* indices = &faces_[3 * static_cast<size_t>(face)];
    const auto vertex = [&](int i) { return vertices_[static_cast<size_t>(indices[i])]; };
    return {vertex(0), vertex(1), vertex(2)};
  }

  // Cell of level 0.
  Cell<3> cell_at(const Vec<3>& point) const { return cell_of<3>((point - low_) * inverse_edge_); }

  template <class Visit>
  static void for_each_cell(const Cell<3>& low, const Cell<3>& high, Visit&& visit) {
    Cell<3> cell;
    for (cell[2] = low[2]; cell[2] <= high[2]; ++cell[2])
      for (cell[1] = low[1]; cell[1] <= high[1]; ++cell[1])
        for (cell[0] = low[0]; cell[0] <= high[0]; ++cell[0]) visit(cell);
  }

  void build_levels() {
    std::vector<std::vector<int32_t>> faces_of_level;
    for (size_t f = 0; f < size(); ++f) {
      const mesh_distance::Triangle t = corners(static_cast<int32_t>(f));
      if (mesh_distance::normal_of(t).isZero(0.0)) continue;
      const auto [low, high] = mesh_distance::bounding_box(t);
      const double longest = (high - low).maxCoeff();
      size_t level = 0;
      for (double edge = edge_; kMaxCellsPerFace * edge < longest; edge *= 2.0) ++level;
      if (faces_of_level.size() <= level) faces_of_level.resize(level + 1);
      faces_of_level[level].push_back(static_cast<int32_t>(f));
    }
    for (size_t k = 0; k < faces_of_level.size(); ++k)
      if (!faces_of_level[k].empty())
        levels_.push_back(build_level(static_cast<int>(k), faces_of_level[k]));
  }

  // Inserts each face into the cells whose bounding sphere it touches.
  Level build_level(int number, const std::vector<int32_t>& faces) const {
    const double edge = std::ldexp(edge_, number);
    Level level{number, edge, {}, {}};
    const double radius = 0.5 * std::sqrt(3.0) * edge + margin_;
    std::vector<std::pair<size_t, int32_t>> members;  // index of a cell, face
    for (const int32_t f : faces) {
      const mesh_distance::Triangle t = corners(f);
      const auto [low, high] = mesh_distance::bounding_box(t);
      for_each_cell(
          level.coarse_cell(cell_at(low)), level.coarse_cell(cell_at(high)),
          [&](const Cell<3>& cell) {
            const Vec<3> middle = low_ + edge * (cell.cast<double>() + Vec<3>::Constant(0.5));
            if (mesh_distance::closest_point(middle, t).squared_distance > radius * radius) return;
            FaceRange& range = level.cells.find_or_add(cell);
            if (range.size++ == 0) range.first = level.cells.size() - 1;
            members.emplace_back(range.first, f);
          });
    }
    std::vector<size_t> next(level.cells.size() + 1, 0);
    for (const auto& member : members) ++next[member.first + 1];
    for (size_t k = 1; k < next.size(); ++k) next[k] += next[k - 1];
    for (size_t k = 0; k < level.cells.size(); ++k)
      level.cells.find_or_add(level.cells.cell(k)).first = next[k];
    level.faces.resize(members.size());
    for (const auto& [index, f] : members) level.faces[next[index]++] = f;
    return level;
  }

  void search(Best& best) const {
    best.squared_radius = (max_distance_ + margin_) * (max_distance_ + margin_);
    if (mesh_distance::squared_distance_to_box(best.point, low_, high_) > best.squared_radius)
      return;
    const Cell<3> centre = cell_at(best.point);
    for (const Level& level : levels_) search_cell(level, level.coarse_cell(centre), best);
    const Vec<3> radius = Vec<3>::Constant(std::sqrt(best.squared_radius));
    const Cell<3> first = cell_at(best.point - radius), last = cell_at(best.point + radius);
    for (const Level& level : levels_)
      search_around(level, level.coarse_cell(centre), level.coarse_cell(first),
                    level.coarse_cell(last), best);
  }

  // Searches the cells around the query's own.
  void search_around(const Level& level, const Cell<3>& centre, const Cell<3>& first,
                     const Cell<3>& last, Best& best) const {
    if (first == last) return;
    for_each_cell(first, last, [&](const Cell<3>& cell) {
      if (cell == centre) return;
      const Vec<3> low = low_ + level.edge * cell.cast<double>();
      const Vec<3> high = low + Vec<3>::Constant(level.edge);
      if (mesh_distance::squared_distance_to_box(best.point, low, high) <= best.squared_radius)
        search_cell(level, cell, best);
    });
  }

  void search_cell(const Level& level, const Cell<3>& cell, Best& best) const {
    const FaceRange* range = level.cells.find(cell);
    if (!range) return;
    for (size_t i = range->first; i < range->first + range->size; ++i) {
      const int32_t f = level.faces[i];
      const mesh_distance::Triangle t = corners(f);
      const auto [low, high] = mesh_distance::bounding_box(t);
      if (mesh_distance::squared_distance_to_box(best.point, low, high) > best.squared_radius)
        continue;
      if (!(mesh_distance::dot(best.to_origin, mesh_distance::normal_of(t)) > 0.0)) continue;
      const mesh_distance::ClosestPoint closest = mesh_distance::closest_point(best.point, t);
      const bool is_tie =
          closest.squared_distance == best.closest.squared_distance && best.face >= 0;
      if (!(closest.squared_distance < best.closest.squared_distance || (is_tie && f < best.face)))
        continue;
      const double far = std::sqrt(closest.squared_distance) + margin_;
      best.face = f, best.closest = closest, best.squared_radius = far * far;
    }
  }

  double max_distance_, edge_, inverse_edge_, margin_;
  std::vector<Vec<3>> vertices_;
  std::vector<int32_t> faces_;
  Vec<3> low_ = Vec<3>::Constant(std::numeric_limits<double>::infinity());
  Vec<3> high_ = -low_;
  std::vector<Level> levels_;  // by ascending edge
};

}  // namespace stillmap
