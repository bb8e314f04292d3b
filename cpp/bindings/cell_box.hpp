// Boxes of cells as dense arrays.
#pragma once

#include <array>
#include <cstdint>
#include <limits>
#include <optional>
#include <stdexcept>
#include <utility>
#include <vector>

#include "arrays.hpp"

namespace stillmap::bindings {

// first_cell or shape of a box as given by Python; the axes of a shape are in reverse order.
template <int D>
using OptionalCell = std::optional<std::array<int64_t, D>>;

// Lowest cells (B, D) int64 of the blocks of a block-sparse map, in order of insertion.
template <class Map>
auto lowest_cells(const Map& map) {
  constexpr int D = Map::kDimension;
  std::vector<int64_t> cells;
  cells.reserve(map.blocks().size() * D);
  for (const auto& block : map.blocks()) {
    const Cell<D> cell = BlockLayout<D>::cell_at(block->origin, 0);
    cells.insert(cells.end(), cell.data(), cell.data() + D);
  }
  return to_numpy(std::move(cells), {map.blocks().size(), static_cast<size_t>(D)});
}

// Box of cells with the array layout [(z,) y, x].
template <int D>
struct Box {
  Cell<D> first = Cell<D>::Zero();
  std::array<size_t, D> size{};  // along x, y(, z)

  Box() = default;

  Box(const std::array<int64_t, D>& first_cell, const std::array<int64_t, D>& shape) {
    constexpr int64_t kFar = std::numeric_limits<int32_t>::max() / 2;
    for (int d = 0; d < D; ++d) {
      const int64_t from = first_cell[static_cast<size_t>(d)];
      const int64_t n = shape[static_cast<size_t>(D - 1 - d)];
      if (from < -kFar || from > kFar || n < 0 || n > kFar)
        throw std::invalid_argument("first_cell, shape: expected a box of cells that can exist");
      first[d] = static_cast<int32_t>(from);
      size[static_cast<size_t>(d)] = static_cast<size_t>(n);
    }
  }

  bool contains(const Cell<D>& cell) const { return overlaps(cell, 1); }

  // Whether a cube of cells overlaps the box.
  bool overlaps(const Cell<D>& lowest, int edge) const {
    for (int d = 0; d < D; ++d) {
      const int64_t n = int64_t{lowest[d]} - first[d];
      if (n <= -edge || n >= static_cast<int64_t>(size[static_cast<size_t>(d)])) return false;
    }
    return true;
  }

  size_t total() const {
    size_t cells = 1;
    for (const size_t n : size) {
      if (n != 0 && cells > std::numeric_limits<size_t>::max() / (16 * n))
        throw std::invalid_argument("first_cell, shape: expected a box that fits into memory");
      cells *= n;
    }
    return cells;
  }

  size_t index(const Cell<D>& cell) const {
    size_t i = 0;
    for (int d = D - 1; d >= 0; --d)
      i = i * size[static_cast<size_t>(d)] + static_cast<size_t>(cell[d] - first[d]);
    return i;
  }

  // Calls visit(block) for the blocks of a block-sparse map that overlap the box.
  template <class Map, class Visit>
  void for_each_block(const Map& map, Visit&& visit) const {
    size_t blocks = 1;
    Cell<D> low, high;
    for (int d = 0; d < D; ++d) {
      const auto n = static_cast<int32_t>(size[static_cast<size_t>(d)]);
      if (n == 0) return;
      low[d] = first[d] >> BlockLayout<D>::kShift;
      high[d] = (first[d] + n - 1) >> BlockLayout<D>::kShift;
      blocks *= static_cast<size_t>(high[d] - low[d] + 1);
    }
    if (blocks < map.blocks().size()) {
      for_each_in_box<D>(low, high, [&](const Cell<D>& origin) {
        if (const auto* block = map.find(origin)) visit(*block);
      });
      return;
    }
    for (const auto& block : map.blocks())
      if (overlaps(BlockLayout<D>::cell_at(block->origin, 0), BlockLayout<D>::kEdge)) visit(*block);
  }

  auto first_cell() const {
    std::vector<int64_t> cell(first.data(), first.data() + D);
    return to_numpy(std::move(cell), {static_cast<size_t>(D)});
  }
  template <class T>
  auto shaped(std::vector<T>&& values) const {
    if constexpr (D == 2) return to_numpy(std::move(values), {size[1], size[0]});
    if constexpr (D == 3) return to_numpy(std::move(values), {size[2], size[1], size[0]});
  }
};

}  // namespace stillmap::bindings
