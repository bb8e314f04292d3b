// Pools values of surfels, such as P(dynamic), over the connected clusters of each sweep.
//
// The surfels that a sweep hit belong to one cluster if their ground columns touch. Sums over
// sweeps are integers and so do not depend on their order. See docs/estimator.md.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/ground_columns.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct ClusterOptions {
  int32_t column_cells;  // edge of a ground column, in cells
  int64_t min_surfels;   // smaller clusters are ignored
};

class ClusterPooling {
 public:
  // is_obstacle (E,): surfels that may belong to clusters; values (E, n_values): what is pooled.
  ClusterPooling(const SurfelMap<3>& surfel_map, const bool* is_obstacle, const float* values,
                 size_t n_values, const ClusterOptions& options)
      : surfel_map_(surfel_map),
        options_(options),
        n_values_(n_values),
        is_obstacle_(is_obstacle, is_obstacle + surfel_map.size()),
        values_(values, values + surfel_map.size() * n_values),
        sums_(values_.size(), 0),
        sweep_counts_(surfel_map.size(), 0) {}

  size_t n_values() const { return n_values_; }

  void add(const Scans<3>& scans, int threads) {
    const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
    std::vector<PooledValues> pooled(bounds.size() - 1);
    parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
      GroundColumns columns(surfel_map_, options_.column_cells);
      for (size_t t = first; t < last; ++t) {
        gather(scans, t, columns);
        pool(columns, pooled[i]);
      }
    });
    for (const PooledValues& part : pooled)
      for (size_t i = 0; i < part.surfels.size(); ++i) {
        const size_t k = part.surfels[i];
        for (size_t v = 0; v < n_values_; ++v)
          sums_[k * n_values_ + v] += part.means[i * n_values_ + v];
        ++sweep_counts_[k];
      }
  }

  // (E, n_values) mean over the cluster of each surfel, averaged over the sweeps that hit it; NaN
  // without any.
  std::vector<float> means() const {
    std::vector<float> out(sums_.size(), std::numeric_limits<float>::quiet_NaN());
    for (size_t i = 0; i < out.size(); ++i)
      if (const int32_t n = sweep_counts_[i / n_values_])
        out[i] = static_cast<float>(static_cast<double>(sums_[i]) / kFixedOne / n);
    return out;
  }

 private:
  static constexpr double kFixedOne = 1 << 20;

  struct PooledValues {
    std::vector<size_t> surfels;
    std::vector<int64_t> means;  // (n, n_values) mean of the cluster of each surfel, fixed point
  };

  // Columns of the obstacle surfels that one scan hit.
  void gather(const Scans<3>& scans, size_t t, GroundColumns& columns) const {
    columns.begin_sweep();
    BlockCursor<const SurfelMap<3>> cursor(surfel_map_);
    for_each_beam<3>(scans, t, t + 1, [&](size_t, int64_t n, const Pose<3>& pose) {
      if (!scans.hit[n]) return;
      const Vec<3> end = beam_end<3>(pose, scans.points + n * 3, surfel_map_.resolution());
      const int32_t k = surfel_map_.surfel_at(cursor, cell_of<3>(end));
      if (k != kNoSurfel && is_obstacle_[static_cast<size_t>(k)]) columns.add(k);
    });
    columns.sort();
  }

  // Means over the clusters of one scan.
  void pool(const GroundColumns& columns, PooledValues& pooled) const {
    std::vector<size_t> root = connect_columns(columns);
    std::vector<double> sums(root.size() * n_values_, 0.0);
    std::vector<int64_t> counts(root.size(), 0);
    for (size_t c = 0; c < root.size(); ++c) {
      const size_t cluster = root[c] = find_root(root, c);
      columns.for_each_in(c, [&](size_t k) {
        for (size_t v = 0; v < n_values_; ++v)
          sums[cluster * n_values_ + v] += static_cast<double>(values_[k * n_values_ + v]);
        ++counts[cluster];
      });
    }
    for (size_t c = 0; c < root.size(); ++c) {
      if (counts[root[c]] < options_.min_surfels) continue;
      const double scale = kFixedOne / static_cast<double>(counts[root[c]]);
      columns.for_each_in(c, [&](size_t k) {
        pooled.surfels.push_back(k);
        for (size_t v = 0; v < n_values_; ++v)
          pooled.means.push_back(std::llround(scale * sums[root[c] * n_values_ + v]));
      });
    }
  }

  // Unites touching columns (8-neighbourhood): the next in the same row and up to three in the next
  // row.
  static std::vector<size_t> connect_columns(const GroundColumns& columns) {
    const size_t n = columns.size();
    std::vector<size_t> root(n);
    std::iota(root.begin(), root.end(), size_t{0});
    size_t candidate = 0;
    for (size_t c = 0; c < n; ++c) {
      const auto [x, y] = columns.at(c);
      if (c + 1 < n && columns.at(c + 1) == GroundColumn{x, y + 1}) unite(root, c, c + 1);
      while (candidate < n && columns.at(candidate) < GroundColumn{x + 1, y - 1}) ++candidate;
      for (size_t other = candidate; other < n && columns.at(other) <= GroundColumn{x + 1, y + 1};
           ++other)
        unite(root, c, other);
    }
    return root;
  }

  static size_t find_root(std::vector<size_t>& root, size_t c) {
    while (root[c] != c) c = root[c] = root[root[c]];
    return c;
  }

  static void unite(std::vector<size_t>& root, size_t a, size_t b) {
    a = find_root(root, a), b = find_root(root, b);
    root[std::max(a, b)] = std::min(a, b);
  }

  const SurfelMap<3>& surfel_map_;
  ClusterOptions options_;
  size_t n_values_;
  std::vector<uint8_t> is_obstacle_;
  std::vector<float> values_;
  std::vector<int64_t> sums_;          // of cluster means, fixed point
  std::vector<int32_t> sweep_counts_;  // sweeps in which each surfel was in a cluster
};

}  // namespace stillmap
