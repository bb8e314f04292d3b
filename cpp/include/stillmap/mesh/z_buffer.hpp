// Z-buffer rendering of a mesh: depth and nearest face per pixel.
// Edge functions in homogeneous coordinates (Olano and Greer, Triangle scan conversion using 2D
// homogeneous coordinates, 1997), so faces that reach behind the camera need no clipping.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <limits>
#include <vector>

#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct Pinhole {
  Eigen::Matrix3d R;  // T_camera_map: x right, y down, z forward
  Eigen::Vector3d t;
  double fx, skew, cx, fy, cy;  // pixel centres have integer coordinates
  int32_t width, height;
  double near;  // metres, near plane
};

struct ZBuffer {
  std::vector<float> depth;   // metres along the optical axis; infinity: background
  std::vector<int32_t> face;  // -1: background
};

namespace z_buffer {

// A face in camera coordinates: it covers the pixels (u, v) at which no edge function is negative,
// with depth det / (sum of edge functions).
struct Face {
  std::array<Eigen::Vector3d, 3> edge;  // edge function = edge . (u, v, 1), positive inside
  double det, nearest, farthest;
  int32_t left, right, top, bottom;  // bounding box in pixels
};

inline Eigen::Vector3d to_camera(const Pinhole& camera, const double* p) {
  Eigen::Vector3d out;
  for (int r = 0; r < 3; ++r)
    out[r] = camera.R(r, 0) * p[0] + camera.R(r, 1) * p[1] + camera.R(r, 2) * p[2] + camera.t[r];
  return out;
}

inline int32_t pixel(double at, int32_t size) {
  return static_cast<int32_t>(std::clamp(at, -1.0, static_cast<double>(size)));
}

// Bounding box of the part in front of the near plane; false if it is outside the image.
inline bool compute_pixel_bounds(const Pinhole& c, const std::array<Eigen::Vector3d, 3>& corner,
                                 Face& face) {
  double u0 = std::numeric_limits<double>::infinity(), v0 = u0, u1 = -u0, v1 = -u0;
  const auto include = [&](double x, double y, double z) {
    const double u = (c.fx * x + c.skew * y) / z + c.cx, v = c.fy * y / z + c.cy;
    u0 = std::min(u0, u), u1 = std::max(u1, u), v0 = std::min(v0, v), v1 = std::max(v1, v);
  };
  for (size_t i = 0; i < 3; ++i) {
    const Eigen::Vector3d &a = corner[i], &b = corner[(i + 1) % 3];
    if (a.z() >= c.near) include(a.x(), a.y(), a.z());
    if ((a.z() >= c.near) == (b.z() >= c.near)) continue;
    const double s = (c.near - a.z()) / (b.z() - a.z());
    include(a.x() + s * (b.x() - a.x()), a.y() + s * (b.y() - a.y()), c.near);
  }
  if (!(u0 <= u1)) return false;
  // one pixel more on every side; the edge functions decide
  face.left = std::max(pixel(std::floor(u0), c.width), 0);
  face.right = std::min(pixel(std::ceil(u1), c.width), c.width - 1);
  face.top = std::max(pixel(std::floor(v0), c.height), 0);
  face.bottom = std::min(pixel(std::ceil(v1), c.height), c.height - 1);
  return face.left <= face.right && face.top <= face.bottom;
}

// a x b, exactly -(b x a): faces that share an edge leave no gap.
inline Eigen::Vector3d cross(const Eigen::Vector3d& a, const Eigen::Vector3d& b, bool swapped) {
  const Eigen::Vector3d &p = swapped ? b : a, &q = swapped ? a : b;
  const Eigen::Vector3d out(p.y() * q.z() - p.z() * q.y(), p.z() * q.x() - p.x() * q.z(),
                            p.x() * q.y() - p.y() * q.x());
  return swapped ? Eigen::Vector3d(-out) : out;
}

// Converts a linear function of the ray (x, y, 1) into one of the pixel (u, v, 1).
inline Eigen::Vector3d to_pixel_form(const Pinhole& c, const Eigen::Vector3d& n) {
  const double u = n.x() / c.fx, v = (n.y() - u * c.skew) / c.fy;
  return {u, v, n.z() - u * c.cx - v * c.cy};
}

// False if the face is outside the image or seen edge on.
inline bool setup_face(const Pinhole& c, const Eigen::Vector3d* points, const int32_t* at,
                       Face& face) {
  std::array<Eigen::Vector3d, 3> corner;
  for (size_t i = 0; i < 3; ++i) corner[i] = points[at[i]];
  if (!compute_pixel_bounds(c, corner, face)) return false;
  face.nearest = std::min({corner[0].z(), corner[1].z(), corner[2].z()});
  face.farthest = std::max({corner[0].z(), corner[1].z(), corner[2].z()});
  std::array<Eigen::Vector3d, 3> edge_normals;
  for (size_t i = 0; i < 3; ++i) {
    const size_t j = (i + 1) % 3, k = (i + 2) % 3;
    edge_normals[i] = cross(corner[j], corner[k], at[j] > at[k]);
  }
  const Eigen::Vector3d &n = edge_normals[0], &p = corner[0];
  face.det = n.x() * p.x() + n.y() * p.y() + n.z() * p.z();
  if (!(face.det != 0.0)) return false;
  const double sign = face.det > 0.0 ? 1.0 : -1.0;
  for (size_t i = 0; i < 3; ++i) face.edge[i] = sign * to_pixel_form(c, edge_normals[i]);
  face.det *= sign;
  return true;
}

inline void rasterise(const Pinhole& c, const Face& face, int32_t number, int32_t first,
                      int32_t last, ZBuffer& out) {
  for (int32_t v = std::max(face.top, first); v <= std::min(face.bottom, last); ++v) {
    std::array<double, 3> row;
    for (size_t i = 0; i < 3; ++i) row[i] = face.edge[i].y() * v + face.edge[i].z();
    const size_t begin = static_cast<size_t>(v) * static_cast<size_t>(c.width);
    for (int32_t u = face.left; u <= face.right; ++u) {
      const double e0 = face.edge[0].x() * u + row[0], e1 = face.edge[1].x() * u + row[1],
                   e2 = face.edge[2].x() * u + row[2];
      if (!(e0 >= 0.0 && e1 >= 0.0 && e2 >= 0.0)) continue;
      const double sum = e0 + e1 + e2;
      if (!(sum > 0.0)) continue;
      // the determinant is imprecise for faces seen edge on
      const double z = std::clamp(face.det / sum, face.nearest, face.farthest);
      if (z < c.near) continue;
      const size_t at = begin + static_cast<size_t>(u);
      const auto depth = static_cast<float>(z);
      if (depth < out.depth[at]) out.depth[at] = depth, out.face[at] = number;
    }
  }
}

}  // namespace z_buffer

// Renders vertices (V, 3) and faces (F, 3), double-sided. At equal depth (float32) the lower face
// number wins.
inline ZBuffer render_z_buffer(const double* vertices, size_t V, const int32_t* faces, size_t F,
                               const Pinhole& camera, int threads) {
  std::vector<Eigen::Vector3d> points(V);
  parallel_for_ranges(split_evenly(V, threads), [&](size_t, size_t first, size_t last) {
    for (size_t i = first; i < last; ++i) points[i] = z_buffer::to_camera(camera, vertices + 3 * i);
  });
  const size_t rows = static_cast<size_t>(camera.height);
  const size_t pixels = rows * static_cast<size_t>(camera.width);
  ZBuffer out{std::vector<float>(pixels, std::numeric_limits<float>::infinity()),
              std::vector<int32_t>(pixels, -1)};
  // each thread owns some rows and renders the faces in order
  const size_t n_threads = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1, rows);
  std::vector<size_t> bounds;
  for (size_t i = 0; i <= n_threads; ++i) bounds.push_back(rows * i / n_threads);
  parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
    const auto top = static_cast<int32_t>(first), bottom = static_cast<int32_t>(last) - 1;
    z_buffer::Face face;
    for (size_t f = 0; f < F; ++f)
      if (z_buffer::setup_face(camera, points.data(), faces + 3 * f, face))
        z_buffer::rasterise(camera, face, static_cast<int32_t>(f), top, bottom, out);
  });
  return out;
}

}  // namespace stillmap
