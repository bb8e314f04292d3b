// The elements that a sweep met, by the columns over the ground that they stand in.
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>
#include <vector>

#include "stillmap/occupancy/surfel_map.hpp"

namespace stillmap {

using Column = std::pair<int32_t, int32_t>;  // x, y

// edge: of a column, in cells
inline Column column_of(const Cell<3>& cell, int32_t edge) {
  const auto down = [edge](int32_t at) {
    const int32_t rest = at % edge;
    return (at - rest) / edge - (rest < 0 ? 1 : 0);
  };
  return {down(cell[0]), down(cell[1])};
}

class Columns {
 public:
  Columns(const Surface<3>& surface, int32_t edge)
      : surface_(surface), edge_(edge), seen_(surface.size(), -1) {}

  int32_t edge() const { return edge_; }

  // Begins a sweep.
  void clear() {
    ++sweep_;
    members_.clear();
  }

  // Whether an element was not told of before in this sweep.
  bool first_seen(int32_t element) {
    return std::exchange(seen_[static_cast<size_t>(element)], sweep_) != sweep_;
  }

  // Once for each element of the sweep, however often it is told.
  void add(int32_t element) {
    if (first_seen(element))
      members_.emplace_back(column_of(surface_.cell(element), edge_), static_cast<size_t>(element));
  }

  // After all were added: columns by x, then y, and the elements in each by their numbers.
  void sort() {
    std::sort(members_.begin(), members_.end());
    first_.clear();
    for (size_t i = 0; i < members_.size(); ++i)
      if (i == 0 || members_[i].first != members_[i - 1].first) first_.push_back(i);
    first_.push_back(members_.size());
  }

  size_t size() const { return first_.size() - 1; }
  const Column& at(size_t c) const { return members_[first_[c]].first; }

  template <class Visit>
  void for_each_in(size_t c, Visit&& visit) const {
    for (size_t i = first_[c]; i < first_[c + 1]; ++i) visit(members_[i].second);
  }

  // The number of a column, size() where there is none.
  size_t find(const Column& column) const {
    const auto of = [this](size_t i, const Column& wanted) { return members_[i].first < wanted; };
    const auto end = first_.end() - 1;
    const auto found = std::lower_bound(first_.begin(), end, column, of);
    if (found == end || members_[*found].first != column) return size();
    return static_cast<size_t>(found - first_.begin());
  }

 private:
  const Surface<3>& surface_;
  int32_t edge_;
  int32_t sweep_ = 0;
  std::vector<int32_t> seen_;                       // the last sweep in which each was added
  std::vector<std::pair<Column, size_t>> members_;  // elements
  std::vector<size_t> first_;                       // member of each column, and the end
};

}  // namespace stillmap
