#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/grid/square_reduction.hpp"

namespace stillmap::bindings {
namespace {

template <class T>
using Layer = nb::ndarray<const T, nb::numpy, nb::ndim<2>, nb::c_contig, nb::device::cpu>;

template <class T>
DenseLayer<T> layer_from(const Layer<T>& array, int64_t factor) {
  require(factor >= 1, "factor: expected at least one cell");
  return {array.data(), array.shape(0), array.shape(1)};
}

auto reduce(const Layer<float>& p, int64_t factor, float occupied, int unknown) {
  require(unknown >= 0 && unknown <= 255, "unknown: expected 0 to 255");
  const auto layer = layer_from(p, factor);
  const auto n = static_cast<size_t>(factor);
  const size_t rows = squares_along(layer.height, n), columns = squares_along(layer.width, n);
  std::vector<uint8_t> percent(rows * columns);
  {
    nb::gil_scoped_release released;
    reduce_occupancy(layer, n, occupied, static_cast<uint8_t>(unknown), percent.data());
  }
  return to_numpy(std::move(percent), {rows, columns});
}

auto count(const Layer<bool>& mask, int64_t factor) {
  const auto layer = layer_from(mask, factor);
  const auto n = static_cast<size_t>(factor);
  const size_t rows = squares_along(layer.height, n), columns = squares_along(layer.width, n);
  std::vector<int64_t> counts(rows * columns);
  {
    nb::gil_scoped_release released;
    count_in_squares(layer, n, counts.data());
  }
  return to_numpy(std::move(counts), {rows, columns});
}

}  // namespace

void bind_square_reduction(nb::module_& m) {
  m.def("reduce_occupancy", &reduce, nb::arg("p_occupied").noconvert(), nb::arg("factor"),
        nb::arg("occupied"), nb::arg("unknown"),
        "Occupancy in percent, uint8 (h, w), of squares of factor x factor cells of (H, W) "
        "float32, NaN where unobserved: the largest value where it exceeds `occupied`, else the "
        "mean of the known cells, `unknown` where there is none. Squares are cut off at the end "
        "of rows and columns.");
  m.def("count_in_squares", &count, nb::arg("mask").noconvert(), nb::arg("factor"),
        "Number of true cells, int64 (h, w), of squares of factor x factor cells of (H, W) bool.");
}

}  // namespace stillmap::bindings
