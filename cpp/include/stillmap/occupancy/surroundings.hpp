// Surroundings of surfels: whether beams still ended beside a surfel while others passed it.
//
// What moves leaves its whole place empty. A hedge, the inside of a car behind its windows, a post
// thinner than a cell, or anything that pose errors shift by decimetres does not: beams that pass
// one of its surfels end on others. See docs/estimator.md.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap {

// Coarse cells with surfels in them. The surroundings of a surfel are its coarse cell and the eight
// beside it at the same height.
class Surroundings {
 public:
  // edge: of coarse cells, in cells.
  Surroundings(const SurfelMap<3>& surfel_map, int32_t edge)
      : surfel_map_(surfel_map), edge_(edge), coarse_of_(surfel_map.size()) {
    const std::vector<Cell<3>> cells = number_cells();
    around_.resize(cells.size());
    for (auto& around : around_) around.fill(kNone);
    size_t side = 0;
    for (int dx = -1; dx <= 1; ++dx)
      for (int dy = -1; dy <= 1; ++dy) find_beside(cells, Cell<3>(dx, dy, 0), side++);
  }

  size_t n_cells() const { return around_.size(); }
  size_t coarse_index(int32_t surfel) const {
    return static_cast<size_t>(coarse_of_[static_cast<size_t>(surfel)]);
  }

  // Whether hits of a surfel show that what it belongs to is still there. A plane beside it is the
  // ground or a wall, and is hit whoever has left.
  bool counts(int32_t surfel) const { return surfel_map_.surfel(surfel).normal.isZero(0.0); }

  // Coarse cells in the surroundings of a surfel.
  template <class Visit>
  void for_each_around(int32_t surfel, Visit&& visit) const {
    for (const int32_t index : around_[coarse_index(surfel)])
      if (index != kNone) visit(static_cast<size_t>(index));
  }

 private:
  static constexpr int32_t kNone = -1;

  static bool is_before(const Cell<3>& a, const Cell<3>& b) {
    return std::lexicographical_compare(a.data(), a.data() + 3, b.data(), b.data() + 3);
  }

  // Numbers the coarse cells of all surfels in lexicographic order, and returns them. A map of
  // blocks would take kilobytes for each surfel that is far from all others.
  std::vector<Cell<3>> number_cells() {
    std::vector<Cell<3>> cells;
    for (size_t k = 0; k < coarse_of_.size(); ++k) {  // successive surfels often share theirs
      const Cell<3> cell = coarse_cell(static_cast<int32_t>(k));
      if (cells.empty() || cells.back() != cell) cells.push_back(cell);
      coarse_of_[k] = static_cast<int32_t>(cells.size() - 1);
    }
    std::vector<Cell<3>> sorted = cells;
    std::sort(sorted.begin(), sorted.end(), is_before);
    sorted.erase(std::unique(sorted.begin(), sorted.end()), sorted.end());
    std::vector<int32_t> number(cells.size());
    for (size_t i = 0; i < cells.size(); ++i)
      number[i] = static_cast<int32_t>(
          std::lower_bound(sorted.begin(), sorted.end(), cells[i], is_before) - sorted.begin());
    for (int32_t& coarse : coarse_of_) coarse = number[static_cast<size_t>(coarse)];
    return sorted;
  }

  // Writes the coarse cell at an offset from each. Both are in the same order, so one pass finds
  // them.
  void find_beside(const std::vector<Cell<3>>& cells, const Cell<3>& offset, size_t side) {
    size_t at = 0;
    for (size_t i = 0; i < cells.size(); ++i) {
      const Cell<3> beside = cells[i] + offset;
      while (at < cells.size() && is_before(cells[at], beside)) ++at;
      if (at < cells.size() && cells[at] == beside) around_[i][side] = static_cast<int32_t>(at);
    }
  }

  Cell<3> coarse_cell(int32_t surfel) const {
    const auto floor_divide = [this](int32_t x) {
      return (x - (x % edge_ + edge_) % edge_) / edge_;
    };
    return surfel_map_.cell(surfel).unaryExpr(floor_divide);
  }

  const SurfelMap<3>& surfel_map_;
  int32_t edge_;                                // cells
  std::vector<int32_t> coarse_of_;              // index of each surfel's coarse cell
  std::vector<std::array<int32_t, 9>> around_;  // by coarse cell; kNone where there is none
};

// The coarse cells in whose surroundings something was hit in one time bin.
class OccupiedSurroundings {
 public:
  explicit OccupiedSurroundings(const Surroundings& surroundings)
      : surroundings_(surroundings),
        is_hit_(surroundings.n_cells(), false),
        is_occupied_(surroundings.n_cells(), false) {}

  void hit(int32_t surfel) {
    const size_t coarse = surroundings_.coarse_index(surfel);
    if (is_hit_[coarse] || !surroundings_.counts(surfel)) return;
    is_hit_[coarse] = true;
    hits_.push_back(coarse);
    surroundings_.for_each_around(surfel, [&](size_t around) {
      if (is_occupied_[around]) return;
      is_occupied_[around] = true;
      occupied_.push_back(around);
    });
  }

  bool around(int32_t surfel) const { return is_occupied_[surroundings_.coarse_index(surfel)]; }

  void clear() {
    for (const size_t coarse : hits_) is_hit_[coarse] = false;
    for (const size_t coarse : occupied_) is_occupied_[coarse] = false;
    hits_.clear();
    occupied_.clear();
  }

 private:
  const Surroundings& surroundings_;
  std::vector<uint8_t> is_hit_, is_occupied_;  // by coarse cell
  std::vector<size_t> hits_, occupied_;
};

// Misses of a surfel, summed by their reliability. Those one time bin before or after a hit do not
// count: what moves slowly is then still, or already, beside it.
class MissCounts {
 public:
  void hit(int64_t time_bin) {
    if (time_bin - last_miss_ <= 1) latest_ = 0.0f;
    last_hit_ = static_cast<int32_t>(time_bin);
  }
  // is_surrounded: whether something was hit in the surroundings in that time bin.
  void miss(int64_t time_bin, float reliability, bool is_surrounded) {
    if (time_bin - last_hit_ <= 1) return;
    all_ = all();
    surrounded_ = surrounded();
    last_miss_ = static_cast<int32_t>(time_bin);
    latest_ = is_surrounded ? -reliability : reliability;
  }

  float all() const { return all_ + std::abs(latest_); }
  // Misses while something was hit in the surroundings.
  float surrounded() const { return surrounded_ + std::max(-latest_, 0.0f); }

 private:
  static constexpr int32_t kNever = -2;  // bins are counted from 0

  float all_ = 0.0f, surrounded_ = 0.0f;            // without the latest one
  int32_t last_hit_ = kNever, last_miss_ = kNever;  // time bins
  float latest_ = 0.0f;  // reliability of the latest miss, negative if surrounded; 0: none
};

}  // namespace stillmap
