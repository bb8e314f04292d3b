#include "arrays.hpp"
#include "bindings.hpp"
#include "stillmap/util/shortest_paths.hpp"

namespace stillmap::bindings {
namespace {

auto lengths_from(const Cells<2>& edges, const Flat<double>& lengths, int64_t count, int64_t from) {
  require(lengths.shape(0) == edges.shape(0), "lengths: expected one for each edge");
  require(count >= 1 && from >= 0 && from < count, "start: expected one of the nodes");
  std::vector<GraphEdge> given;
  for (size_t k = 0; k < edges.shape(0); ++k) {
    const GraphEdge edge{edges.data()[2 * k], edges.data()[2 * k + 1], lengths.data()[k]};
    for (const int64_t node : {edge.first, edge.second})
      require(node >= 0 && node < count, "edges: expected nodes below count");
    require(edge.length >= 0.0, "lengths: expected numbers that are not negative");
    given.push_back(edge);
  }
  const auto n = static_cast<size_t>(count);
  std::vector<double> found;
  {
    nb::gil_scoped_release released;
    found = shortest_paths(n, given, static_cast<size_t>(from));
  }
  return to_numpy(std::move(found), {n});
}

}  // namespace

void bind_shortest_paths(nb::module_& m) {
  m.def("shortest_paths", &lengths_from, nb::arg("edges").noconvert(),
        nb::arg("lengths").noconvert(), nb::arg("count"), nb::arg("start"),
        "Lengths (count,) of the shortest paths from node `start` of a graph, inf where there is "
        "none. edges (E, 2) int64 between two nodes each, in both directions; lengths (E,).");
}

}  // namespace stillmap::bindings
