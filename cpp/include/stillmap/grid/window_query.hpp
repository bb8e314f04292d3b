// The cells around one, by the blocks around its block: cells asked for one after the other share
// most of these, so blocks are seldom looked for.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <vector>

#include "stillmap/grid/cell_index.hpp"
#include "stillmap/occupancy/surfel.hpp"

namespace stillmap {

// Cells in a row along x, as seen from some cell.
template <int D>
struct CellRow {
  Cell<D> middle;
  int32_t half;  // so many cells to either side of it
};
template <int D>
using CellRows = std::vector<CellRow<D>>;

// The rows, later axes last, of the cells whose centres lie within a radius of one; each a ball's
// width, or all as wide as its cube.
template <int D>
inline CellRows<D> rows_around(double radius, bool cube) {
  const auto cells = static_cast<int>(std::floor(radius));
  CellRows<D> rows;
  for_each_near<D>(Cell<D>::Zero(), cells, [&](const Cell<D>& off) {
    if (off[0] != 0) return;
    const double left = radius * radius - off.template cast<double>().squaredNorm();
    if (cube) rows.push_back({off, cells});
    if (!cube && left >= 0.0) rows.push_back({off, static_cast<int32_t>(std::sqrt(left))});
  });
  return rows;
}

template <int D>
class Around {
 public:
  explicit Around(const CellIndex<D>& index) : index_(index) {}

  // Calls visit(place) for the cells of which something is known in rows around one, in their
  // order.
  template <class Visit>
  void each(const Cell<D>& centre, const CellRows<D>& rows, Visit&& visit) {
    move_to(CellIndex<D>::block_of(centre));
    for (const CellRow<D>& row : rows) {
      Cell<D> cell = centre + row.middle;
      const int32_t last = cell[0] + row.half;
      for (cell[0] -= row.half; cell[0] <= last;) {
        const int32_t stop = std::min(last, cell[0] | (CellIndex<D>::kEdge - 1));
        const Block* block = block_at(CellIndex<D>::block_of(cell));
        if (block) {
          const int32_t* place = block->counts.data() + CellIndex<D>::local_of(cell);
          for (const int32_t* end = place + (stop - cell[0] + 1); place != end; ++place)
            if (*place != CellIndex<D>::kNone) visit(*place);
        }
        cell[0] = stop + 1;
      }
    }
  }

 private:
  using Block = typename CellIndex<D>::Block;
  static constexpr size_t kBlocks = D == 2 ? 9 : 27;

  void move_to(const Cell<D>& block) {
    if (ready_ && block == block_) return;
    block_ = block;
    ready_ = true;
    size_t i = 0;
    for_each_near<D>(block, 1, [&](const Cell<D>& near) { blocks_[i++] = index_.find(near); });
  }

  const Block* block_at(const Cell<D>& block) const {
    size_t i = 0;
    for (int d = D - 1; d >= 0; --d) {
      const int32_t step = block[d] - block_[d] + 1;
      if (step < 0 || step > 2) return index_.find(block);
      i = 3 * i + static_cast<size_t>(step);
    }
    return blocks_[i];
  }

  const CellIndex<D>& index_;
  Cell<D> block_ = Cell<D>::Zero();
  bool ready_ = false;
  std::array<const Block*, kBlocks> blocks_{};
};

}  // namespace stillmap
