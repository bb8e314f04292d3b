// Shortest paths in a graph of undirected edges (Dijkstra 1959).
#pragma once

#include <cstddef>
#include <cstdint>
#include <functional>
#include <limits>
#include <queue>
#include <utility>
#include <vector>

namespace stillmap {

struct GraphEdge {
  int64_t first, second;  // nodes
  double length;          // not negative
};

// Lengths of the shortest paths from a node to each of n; infinite where there is none.
inline std::vector<double> shortest_paths(size_t n, const std::vector<GraphEdge>& edges,
                                          size_t from) {
  // the edges of each node one after another
  std::vector<size_t> begin(n + 1, 0);
  for (const GraphEdge& edge : edges)
    for (const int64_t node : {edge.first, edge.second}) ++begin[static_cast<size_t>(node) + 1];
  for (size_t k = 0; k < n; ++k) begin[k + 1] += begin[k];
  std::vector<std::pair<size_t, double>> neighbours(begin[n]);
  std::vector<size_t> next(begin.begin(), begin.end() - 1);
  const auto add = [&](int64_t node, int64_t other, double length) {
    neighbours[next[static_cast<size_t>(node)]++] = {static_cast<size_t>(other), length};
  };
  for (const GraphEdge& edge : edges) {
    add(edge.first, edge.second, edge.length);
    add(edge.second, edge.first, edge.length);
  }
  std::vector<double> length(n, std::numeric_limits<double>::infinity());
  using Reached = std::pair<double, size_t>;
  std::priority_queue<Reached, std::vector<Reached>, std::greater<>> queue;
  length[from] = 0.0;
  queue.push({0.0, from});
  while (!queue.empty()) {
    const auto [so_far, node] = queue.top();
    queue.pop();
    if (so_far > length[node]) continue;
    for (size_t k = begin[node]; k < begin[node + 1]; ++k) {
      const auto& [other, step] = neighbours[k];
      if (!(so_far + step < length[other])) continue;
      length[other] = so_far + step;
      queue.push({length[other], other});
    }
  }
  return length;
}

}  // namespace stillmap
