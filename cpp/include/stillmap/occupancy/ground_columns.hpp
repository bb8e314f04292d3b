// Vertical columns over the ground that hold the surfels of one sweep.
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap {

using GroundColumn = std::pair<int32_t, int32_t>;  // x, y

// Column of a cell; column_cells: edge of a column, in cells.
inline GroundColumn ground_column(const Cell<3>& cell, int32_t column_cells) {
  const auto floor_divide = [column_cells](int32_t coordinate) {
    const int32_t remainder = coordinate % column_cells;
    return (coordinate - remainder) / column_cells - (remainder < 0 ? 1 : 0);
  };
  return {floor_divide(cell[0]), floor_divide(cell[1])};
}

class GroundColumns {
 public:
  GroundColumns(const SurfelMap<3>& surfel_map, int32_t column_cells)
      : surfel_map_(surfel_map), column_cells_(column_cells), last_sweep_(surfel_map.size(), -1) {}

  int32_t column_cells() const { return column_cells_; }

  void begin_sweep() {
    ++sweep_;
    members_.clear();
  }

  // Whether a surfel is new in this sweep.
  bool first_seen(int32_t surfel) {
    return std::exchange(last_sweep_[static_cast<size_t>(surfel)], sweep_) != sweep_;
  }

  // Adds a surfel once per sweep.
  void add(int32_t surfel) {
    if (first_seen(surfel))
      members_.emplace_back(ground_column(surfel_map_.cell(surfel), column_cells_),
                            static_cast<size_t>(surfel));
  }

  // Call after adding: orders columns by x, then y, and the surfels of each by number.
  void sort() {
    std::sort(members_.begin(), members_.end());
    column_begin_.clear();
    for (size_t i = 0; i < members_.size(); ++i)
      if (i == 0 || members_[i].first != members_[i - 1].first) column_begin_.push_back(i);
    column_begin_.push_back(members_.size());
  }

  size_t size() const { return column_begin_.size() - 1; }
  const GroundColumn& at(size_t c) const { return members_[column_begin_[c]].first; }

  template <class Visit>
  void for_each_in(size_t c, Visit&& visit) const {
    for (size_t i = column_begin_[c]; i < column_begin_[c + 1]; ++i) visit(members_[i].second);
  }

  // Index of a column; size() if there is none.
  size_t find_column(const GroundColumn& column) const {
    const auto is_before = [this](size_t i, const GroundColumn& wanted) {
      return members_[i].first < wanted;
    };
    const auto end = column_begin_.end() - 1;
    const auto found = std::lower_bound(column_begin_.begin(), end, column, is_before);
    if (found == end || members_[*found].first != column) return size();
    return static_cast<size_t>(found - column_begin_.begin());
  }

 private:
  const SurfelMap<3>& surfel_map_;
  int32_t column_cells_;
  int32_t sweep_ = 0;
  std::vector<int32_t> last_sweep_;                       // last sweep of each surfel
  std::vector<std::pair<GroundColumn, size_t>> members_;  // column and surfel
  std::vector<size_t> column_begin_;  // first member of each column, and the end
};

}  // namespace stillmap
