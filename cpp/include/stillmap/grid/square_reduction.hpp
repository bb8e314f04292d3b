// Reduction of a dense layer of cells to squares of several cells, for pictures of maps.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstddef>
#include <cstdint>

namespace stillmap {

// A dense array (height, width) in row-major order.
template <class T>
struct DenseLayer {
  const T* values;
  size_t height, width;
};

inline size_t squares_along(size_t cells, size_t factor) { return (cells + factor - 1) / factor; }

// Calls visit(value) for the cells of square (row, column), which is cut off at the borders.
template <class T, class Visit>
inline void for_each_in_square(const DenseLayer<T>& layer, size_t factor, size_t row, size_t column,
                               Visit&& visit) {
  const size_t last_row = std::min(layer.height, (row + 1) * factor);
  const size_t last_column = std::min(layer.width, (column + 1) * factor);
  for (size_t i = row * factor; i < last_row; ++i)
    for (size_t j = column * factor; j < last_column; ++j) visit(layer.values[i * layer.width + j]);
}

// Occupancy in percent per square, `unknown` where all cells are NaN: the largest value where it
// exceeds `occupied`, so that thin walls stay visible, else the mean of the known cells.
inline void reduce_occupancy(const DenseLayer<float>& p, size_t factor, float occupied,
                             uint8_t unknown, uint8_t* percent) {
  const size_t rows = squares_along(p.height, factor), columns = squares_along(p.width, factor);
  for (size_t row = 0; row < rows; ++row)
    for (size_t column = 0; column < columns; ++column) {
      float largest = 0.0f;
      double sum = 0.0;
      size_t known = 0;
      for_each_in_square(p, factor, row, column, [&](float value) {
        if (std::isnan(value)) return;
        ++known;
        sum += static_cast<double>(value);
        largest = std::max(largest, value);
      });
      const double mean = known ? sum / static_cast<double>(known) : 0.0;
      const double shown = largest > occupied ? static_cast<double>(largest) : mean;
      percent[row * columns + column] =
          known ? static_cast<uint8_t>(std::lrint(100.0 * std::clamp(shown, 0.0, 1.0))) : unknown;
    }
}

// Number of true cells per square.
inline void count_in_squares(const DenseLayer<bool>& mask, size_t factor, int64_t* counts) {
  const size_t rows = squares_along(mask.height, factor);
  const size_t columns = squares_along(mask.width, factor);
  for (size_t row = 0; row < rows; ++row)
    for (size_t column = 0; column < columns; ++column) {
      int64_t count = 0;
      for_each_in_square(mask, factor, row, column, [&](bool value) { count += value; });
      counts[row * columns + column] = count;
    }
}

}  // namespace stillmap
