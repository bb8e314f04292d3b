// Slices of rows, so that large results can be fetched in parts.
#pragma once

#include <array>
#include <cstddef>
#include <cstdint>
#include <optional>

#include "arrays.hpp"

namespace stillmap::bindings {

// The rows first, first + step, ..., n in total.
struct Rows {
  size_t first = 0, step = 1, n = 0;
};
using Slice = std::array<int64_t, 3>;  // first, last, step

inline Rows rows_from(const std::optional<Slice>& rows, size_t size) {
  if (!rows) return {0, 1, size};
  const auto [first, last, step] = *rows;
  require(0 <= first && first <= last && last <= static_cast<int64_t>(size) && step > 0,
          "rows: expected first <= last <= number of surfels, step > 0");
  return {static_cast<size_t>(first), static_cast<size_t>(step),
          static_cast<size_t>((last - first + step - 1) / step)};
}

}  // namespace stillmap::bindings
