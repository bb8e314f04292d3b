// MRF smoothing of P(static) over neighbouring surfels by mean-field inference.
//
// A static neighbour counts by the share of time in which both surfels were hit, a dynamic
// neighbour by the share of the surfel's own time; both by how coplanar the two surfels are. See
// docs/estimator.md.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "stillmap/grid/window_query.hpp"
#include "stillmap/occupancy/surfel.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct MeanFieldOptions {
  double radius;            // cells, neighbourhood
  double coplanar_std;      // cells, standard deviation of a mean from a neighbour's plane
  double static_coupling;   // log odds, weight of static neighbours
  double dynamic_coupling;  // log odds, weight of dynamic neighbours
  double min_log_odds, max_log_odds;  // clamp of a surfel's own log odds
  double tolerance;  // change of P(static) that triggers an update of the neighbours
  int max_iterations;
};

template <int D>
class MeanField {
 public:
  // log_odds (E,) of being static from each surfel's own observations.
  MeanField(const SurfelMap<D>& surfel_map, const float* log_odds, const MeanFieldOptions& options,
            int threads)
      : surfel_map_(surfel_map),
        options_(options),
        threads_(threads),
        p_static_(surfel_map.size()),
        window_(window_rows<D>(options.radius, false)),
        masks_(surfel_map) {
    nodes_.reserve(surfel_map.size());
    for (size_t k = 0; k < surfel_map.size(); ++k) {
      nodes_.push_back(node_of(static_cast<int32_t>(k), log_odds[k]));
      p_static_[k] = sigmoid(log_odds[k]);
    }
  }

  // P(static) (E,) after convergence or max_iterations.
  const std::vector<float>& infer() {
    std::vector<uint8_t> active(p_static_.size(), 1);
    for (int iteration = 0; iteration < options_.max_iterations; ++iteration) {
      const std::vector<float> previous = p_static_;
      parallel_for_ranges(split_evenly(p_static_.size(), threads_),
                          [&](size_t, size_t begin, size_t end) {
                            WindowQuery<D> query(surfel_map_, masks_);
                            for (size_t k = begin; k < end; ++k)
                              if (active[k]) p_static_[k] = update(query, k, previous);
                          });
      if (!mark_neighbours_of_changed(previous, active)) break;
    }
    return p_static_;
  }

 private:
  using Vecf = Eigen::Matrix<float, D, 1>;

  struct Node {
    Vecf mean, normal;  // cells; zero normal: isotropic
    TimeSpan hit_span;
    float unary;  // own log odds
  };

  Node node_of(int32_t k, float log_odds) const {
    const Surfel<D>& e = surfel_map_.surfel(k);
    return {e.mean.template cast<float>(), e.normal.template cast<float>(),
            surfel_map_.hit_spans()[static_cast<size_t>(k)],
            std::clamp(log_odds, static_cast<float>(options_.min_log_odds),
                       static_cast<float>(options_.max_log_odds))};
  }

  static float sigmoid(float log_odds) { return 1.0f / (1.0f + std::exp(-log_odds)); }

  template <class Visit>
  void for_each_neighbour(WindowQuery<D>& query, size_t k, Visit&& visit) const {
    query.for_each(surfel_map_.cell(static_cast<int32_t>(k)), window_, [&](int32_t other) {
      if (static_cast<size_t>(other) != k) visit(static_cast<size_t>(other));
    });
  }

  float update(WindowQuery<D>& query, size_t k, const std::vector<float>& p_static) const {
    const Node& node = nodes_[k];
    float static_sum = 0.0f, dynamic_sum = 0.0f, weight = 1.0f;
    for_each_neighbour(query, k, [&](size_t other) {
      const Node& neighbour = nodes_[other];
      const TimeSpan shared{std::max(node.hit_span.first, neighbour.hit_span.first),
                            std::min(node.hit_span.last, neighbour.hit_span.last)};
      const int64_t overlap = shared.n_bins();
      if (overlap <= 0) return;
      const bool is_static = p_static[other] > 0.5f;
      const int64_t union_length =
          is_static ? node.hit_span.n_bins() + neighbour.hit_span.n_bins() - overlap
                    : node.hit_span.n_bins();
      const float w = coplanarity(node, neighbour) * static_cast<float>(overlap) /
                      static_cast<float>(union_length);
      weight += w;
      (is_static ? static_sum : dynamic_sum) += w * std::abs(2.0f * p_static[other] - 1.0f);
    });
    const auto message = static_cast<float>(options_.static_coupling) * static_sum -
                         static_cast<float>(options_.dynamic_coupling) * dynamic_sum;
    return sigmoid(node.unary + message / weight);
  }

  // Likelihood that two surfels lie on one surface.
  float coplanarity(const Node& a, const Node& b) const {
    const Vecf offset = b.mean - a.mean;
    const float distance = std::max(std::abs(a.normal.dot(offset)), std::abs(b.normal.dot(offset)));
    const float sigmas = distance / static_cast<float>(options_.coplanar_std);
    return std::exp(-0.5f * sigmas * sigmas);
  }

  // Activates the neighbours of changed surfels; returns whether there are any.
  bool mark_neighbours_of_changed(const std::vector<float>& previous,
                                  std::vector<uint8_t>& active) const {
    std::fill(active.begin(), active.end(), uint8_t{0});
    bool changed = false;
    WindowQuery<D> query(surfel_map_, masks_);
    for (size_t k = 0; k < p_static_.size(); ++k) {
      if (!(std::abs(p_static_[k] - previous[k]) > options_.tolerance)) continue;
      for_each_neighbour(query, k, [&](size_t other) { active[other] = 1; });
      changed = true;
    }
    return changed;
  }

  const SurfelMap<D>& surfel_map_;
  MeanFieldOptions options_;
  int threads_;
  std::vector<float> p_static_;
  std::vector<Node> nodes_;
  CellRows<D> window_;
  RowMasks<D> masks_;
};

}  // namespace stillmap
