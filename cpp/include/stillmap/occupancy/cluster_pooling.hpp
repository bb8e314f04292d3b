// What stands apart from all else in a sweep is one body: what is known of its parts, on average.
//
// Elements that beams of a sweep ended in are of one body where the columns over the ground that
// they stand in touch. Sums over sweeps are integers, so that their order does not matter. See
// docs/space.md.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numeric>
#include <vector>

#include "stillmap/occupancy/ground_columns.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct BodyOptions {
  int32_t column;  // cells, edge of the columns
  int64_t fewest;  // elements of a body: fewer tell nothing
};

class Bodies {
 public:
  // stands: (E,) of which elements bodies consist; values: (E, kinds) what is known of each
  Bodies(const Surface<3>& surface, const bool* stands, const float* values, size_t kinds,
         const BodyOptions& options)
      : surface_(surface),
        options_(options),
        kinds_(kinds),
        stands_(stands, stands + surface.size()),
        values_(values, values + surface.size() * kinds),
        sums_(values_.size(), 0),
        sweeps_(surface.size(), 0) {}

  size_t kinds() const { return kinds_; }

  void add(const Scans<3>& scans, int threads) {
    const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
    std::vector<Said> said(bounds.size() - 1);
    parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
      Columns columns(surface_, options_.column);
      for (size_t t = first; t < last; ++t) {
        gather(scans, t, columns);
        say(columns, said[i]);
      }
    });
    for (const Said& part : said)
      for (size_t i = 0; i < part.elements.size(); ++i) {
        const size_t k = part.elements[i];
        for (size_t v = 0; v < kinds_; ++v) sums_[k * kinds_ + v] += part.means[i * kinds_ + v];
        ++sweeps_[k];
      }
  }

  // (E, kinds) mean over the body around each element, mean over the sweeps that saw it; NaN where
  // none did.
  std::vector<float> means() const {
    std::vector<float> out(sums_.size(), std::numeric_limits<float>::quiet_NaN());
    for (size_t i = 0; i < out.size(); ++i)
      if (const int32_t n = sweeps_[i / kinds_])
        out[i] = static_cast<float>(static_cast<double>(sums_[i]) / kOne / n);
    return out;
  }

 private:
  static constexpr double kOne = 1 << 20;

  struct Said {
    std::vector<size_t> elements;
    std::vector<int64_t> means;  // of the body of each, in parts of kOne
  };

  // The elements that a scan's beams ended in.
  void gather(const Scans<3>& scans, size_t t, Columns& columns) const {
    columns.clear();
    Cursor<const Surface<3>> cursor(surface_);
    for_each_beam<3>(scans, t, t + 1, [&](size_t, int64_t n, const Pose<3>& pose) {
      if (!scans.hit[n]) return;
      const Segment<3> beam(pose, scans.points + n * 3, surface_.resolution());
      const int32_t k = surface_.at(cursor, cell_of<3>(beam.end));
      if (k != kNoElement && stands_[static_cast<size_t>(k)]) columns.add(k);
    });
    columns.sort();
  }

  // What is known of the body of each element.
  void say(const Columns& columns, Said& said) const {
    std::vector<size_t> root = joined(columns);
    std::vector<double> sums(root.size() * kinds_, 0.0);
    std::vector<int64_t> all(root.size(), 0);
    for (size_t c = 0; c < root.size(); ++c) {
      const size_t body = root[c] = root_of(root, c);
      columns.for_each_in(c, [&](size_t k) {
        for (size_t v = 0; v < kinds_; ++v)
          sums[body * kinds_ + v] += static_cast<double>(values_[k * kinds_ + v]);
        ++all[body];
      });
    }
    for (size_t c = 0; c < root.size(); ++c) {
      if (all[root[c]] < options_.fewest) continue;
      const double one = kOne / static_cast<double>(all[root[c]]);
      columns.for_each_in(c, [&](size_t k) {
        said.elements.push_back(k);
        for (size_t v = 0; v < kinds_; ++v)
          said.means.push_back(std::llround(one * sums[root[c] * kinds_ + v]));
      });
    }
  }

  // Columns that touch, corners too: the next in the same row, and up to three in the row after.
  static std::vector<size_t> joined(const Columns& columns) {
    const size_t n = columns.size();
    std::vector<size_t> root(n);
    std::iota(root.begin(), root.end(), size_t{0});
    size_t beside = 0;
    for (size_t c = 0; c < n; ++c) {
      const auto [x, y] = columns.at(c);
      if (c + 1 < n && columns.at(c + 1) == Column{x, y + 1}) unite(root, c, c + 1);
      while (beside < n && columns.at(beside) < Column{x + 1, y - 1}) ++beside;
      for (size_t other = beside; other < n && columns.at(other) <= Column{x + 1, y + 1}; ++other)
        unite(root, c, other);
    }
    return root;
  }

  static size_t root_of(std::vector<size_t>& root, size_t c) {
    while (root[c] != c) c = root[c] = root[root[c]];
    return c;
  }

  static void unite(std::vector<size_t>& root, size_t a, size_t b) {
    a = root_of(root, a), b = root_of(root, b);
    root[std::max(a, b)] = std::min(a, b);
  }

  const Surface<3>& surface_;
  BodyOptions options_;
  size_t kinds_;
  std::vector<uint8_t> stands_;
  std::vector<float> values_;
  std::vector<int64_t> sums_;    // of means, in parts of kOne
  std::vector<int32_t> sweeps_;  // in which each was of a body
};

}  // namespace stillmap
