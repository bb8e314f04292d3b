// What stands apart from all else in a sweep is one body: how much of it is known to move.
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
#include <utility>
#include <vector>

#include "stillmap/parallel.hpp"
#include "stillmap/surface.hpp"

namespace stillmap {

struct BodyOptions {
  int32_t column;  // cells, edge of the columns
  int64_t fewest;  // elements of a body: fewer tell nothing
};

class Bodies {
 public:
  // stands: (E,) of which elements bodies consist; p_static: (E,) probability of being static
  Bodies(const Surface<3>& surface, const bool* stands, const float* p_static,
         const BodyOptions& options)
      : surface_(surface), options_(options), moves_(surface.size()), told_(surface.size()) {
    for (size_t k = 0; k < surface.size(); ++k) moves_[k] = stands[k] ? 1.0f - p_static[k] : kNone;
  }

  void add(const Scans<3>& scans, int threads) {
    const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
    std::vector<std::vector<Said>> said(bounds.size() - 1);
    parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
      Sweep sweep(surface_.size());
      for (size_t t = first; t < last; ++t) {
        gather(scans, t, sweep);
        say(sweep, said[i]);
      }
    });
    for (const auto& part : said)
      for (const auto& [k, share] : part) {
        told_[k].sum += share;
        ++told_[k].sweeps;
      }
  }

  // (E,) share of the body around each element that moves, mean over the sweeps that saw it; NaN
  // where none did.
  std::vector<float> share() const {
    std::vector<float> out;
    out.reserve(told_.size());
    for (const Told& one : told_)
      out.push_back(one.sweeps ? static_cast<float>(static_cast<double>(one.sum) / kOne /
                                                    static_cast<double>(one.sweeps))
                               : std::numeric_limits<float>::quiet_NaN());
    return out;
  }

 private:
  static constexpr float kNone = -1.0f;
  static constexpr double kOne = 1 << 20;

  struct Told {
    int64_t sum = 0;
    int32_t sweeps = 0;
  };
  using Said = std::pair<size_t, int64_t>;     // element, share of its body in parts of kOne
  using Column = std::pair<int32_t, int32_t>;  // x, y

  struct Sweep {
    explicit Sweep(size_t elements) : seen(elements, -1) {}

    std::vector<int32_t> seen;  // the last scan that did
    std::vector<std::pair<Column, size_t>> elements;
    std::vector<size_t> first;  // of each column, and the end
    std::vector<size_t> root;   // of each column
  };

  // The elements that a scan's beams ended in, by columns.
  void gather(const Scans<3>& scans, size_t t, Sweep& sweep) const {
    sweep.elements.clear();
    Cursor<const Surface<3>> cursor(surface_);
    const auto scan = static_cast<int32_t>(t);
    for_each_beam<3>(scans, t, t + 1, [&](size_t, int64_t n, const Pose<3>& pose) {
      if (!scans.hit[n]) return;
      const Segment<3> beam(pose, scans.points + n * 3, surface_.resolution());
      const int32_t at = surface_.at(cursor, cell_of<3>(beam.end));
      const auto k = static_cast<size_t>(at);
      if (at == kNoElement || moves_[k] == kNone) return;
      if (std::exchange(sweep.seen[k], scan) == scan) return;
      sweep.elements.emplace_back(column_of(surface_.cell(at)), k);
    });
    std::sort(sweep.elements.begin(), sweep.elements.end());
    sweep.first.clear();
    for (size_t i = 0; i < sweep.elements.size(); ++i)
      if (i == 0 || sweep.elements[i].first != sweep.elements[i - 1].first)
        sweep.first.push_back(i);
    sweep.root.resize(sweep.first.size());
    std::iota(sweep.root.begin(), sweep.root.end(), size_t{0});
    sweep.first.push_back(sweep.elements.size());
  }

  Column column_of(const Cell<3>& cell) const { return {down(cell[0]), down(cell[1])}; }

  int32_t down(int32_t cell) const {
    const int32_t rest = cell % options_.column;
    return (cell - rest) / options_.column - (rest < 0 ? 1 : 0);
  }

  // What the body of each element is worth to it.
  void say(Sweep& sweep, std::vector<Said>& said) const {
    join(sweep);
    const size_t n = sweep.root.size();
    std::vector<double> moves(n, 0.0);
    std::vector<int64_t> all(n, 0);
    for (size_t c = 0; c < n; ++c) {
      const size_t root = sweep.root[c] = root_of(sweep.root, c);
      for (size_t i = sweep.first[c]; i < sweep.first[c + 1]; ++i) {
        moves[root] += static_cast<double>(moves_[sweep.elements[i].second]);
        ++all[root];
      }
    }
    for (size_t c = 0; c < n; ++c) {
      const size_t root = sweep.root[c];
      if (all[root] < options_.fewest) continue;
      const int64_t share = std::llround(kOne * moves[root] / static_cast<double>(all[root]));
      for (size_t i = sweep.first[c]; i < sweep.first[c + 1]; ++i)
        said.emplace_back(sweep.elements[i].second, share);
    }
  }

  // Columns that touch, corners too: the next in the same row, and up to three in the row after.
  static void join(Sweep& sweep) {
    const size_t n = sweep.root.size();
    const auto at = [&](size_t c) { return sweep.elements[sweep.first[c]].first; };
    size_t beside = 0;
    for (size_t c = 0; c < n; ++c) {
      const auto [x, y] = at(c);
      if (c + 1 < n && at(c + 1) == Column{x, y + 1}) unite(sweep.root, c, c + 1);
      while (beside < n && at(beside) < Column{x + 1, y - 1}) ++beside;
      for (size_t other = beside; other < n && at(other) <= Column{x + 1, y + 1}; ++other)
        unite(sweep.root, c, other);
    }
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
  std::vector<float> moves_;  // (E,) probability of it, kNone: of no body
  std::vector<Told> told_;
};

}  // namespace stillmap
