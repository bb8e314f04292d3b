// Things are larger than a cell: what the elements beside one say about it.
//
// Mean field of a random field over elements near each other. Static ones speak for an element as
// far as both were hit in the same time, dynamic ones as far as it was hit while they were and at
// no other time; both as far as the two can be of one surface. See docs/space.md.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "stillmap/grid/window_query.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct BesideOptions {
  double radius;       // cells between those that speak for each other
  double coplanar;     // cells: standard deviation of a mean from the plane of another
  double for_static;   // log odds that static neighbours are worth, if there are no others
  double for_dynamic;  // the same of dynamic ones
  double least, most;  // log odds that an element's own looks are worth
  double moved;        // change of a probability of which the neighbours want to know
  int rounds;          // at most
};

template <int D>
class Beside {
 public:
  // log_odds: (E,) of being static, by an element's own looks; the surface knows when these hit
  Beside(const Surface<D>& surface, const float* log_odds, const BesideOptions& options,
         int threads)
      : surface_(surface),
        options_(options),
        threads_(threads),
        p_(surface.size()),
        near_(rows_around<D>(options.radius, false)) {
    rows_.reserve(surface.size());
    for (size_t k = 0; k < surface.size(); ++k) {
      rows_.push_back(row_of(static_cast<int32_t>(k), log_odds[k]));
      p_[k] = probability(log_odds[k]);
    }
  }

  // (E,) probability of being static, by what is beside as well.
  const std::vector<float>& settle() {
    std::vector<uint8_t> asked(p_.size(), 1);
    for (int round = 0; round < options_.rounds; ++round) {
      const std::vector<float> before = p_;
      parallel_shares(even_shares(p_.size(), threads_), [&](size_t, size_t from, size_t to) {
        Around<D> around(surface_);
        for (size_t k = from; k < to; ++k)
          if (asked[k]) p_[k] = opinion(around, k, before);
      });
      if (!pass_on(before, asked)) break;
    }
    return p_;
  }

 private:
  using Vecf = Eigen::Matrix<float, D, 1>;

  struct Row {
    Vecf mean, normal;  // cells; the normal of what is round is zero
    Span hit;
    float own;  // log odds
  };

  Row row_of(int32_t k, float log_odds) const {
    const Element<D>& e = surface_.element(k);
    return {e.mean.template cast<float>(), e.normal.template cast<float>(),
            surface_.hits()[static_cast<size_t>(k)],
            std::clamp(log_odds, static_cast<float>(options_.least),
                       static_cast<float>(options_.most))};
  }

  static float probability(float log_odds) { return 1.0f / (1.0f + std::exp(-log_odds)); }

  template <class Visit>
  void for_each_beside(Around<D>& around, size_t k, Visit&& visit) const {
    around.each(surface_.cell(static_cast<int32_t>(k)), near_, [&](int32_t other) {
      if (static_cast<size_t>(other) != k) visit(static_cast<size_t>(other));
    });
  }

  float opinion(Around<D>& around, size_t k, const std::vector<float>& p) const {
    const Row& row = rows_[k];
    float for_it = 0.0f, against = 0.0f, weight = 1.0f;
    for_each_beside(around, k, [&](size_t other) {
      const Row& beside = rows_[other];
      const Span common{std::max(row.hit.first, beside.hit.first),
                        std::min(row.hit.last, beside.hit.last)};
      const int64_t both = common.looks();
      if (both <= 0) return;
      const bool is_static = p[other] > 0.5f;
      const int64_t of = is_static ? row.hit.looks() + beside.hit.looks() - both : row.hit.looks();
      const float w = together(row, beside) * static_cast<float>(both) / static_cast<float>(of);
      weight += w;
      (is_static ? for_it : against) += w * std::abs(2.0f * p[other] - 1.0f);
    });
    const auto pull = static_cast<float>(options_.for_static) * for_it -
                      static_cast<float>(options_.for_dynamic) * against;
    return probability(row.own + pull / weight);
  }

  // How far two can be of one surface.
  float together(const Row& a, const Row& b) const {
    const Vecf apart = b.mean - a.mean;
    const float off = std::max(std::abs(a.normal.dot(apart)), std::abs(b.normal.dot(apart)));
    const float of = off / static_cast<float>(options_.coplanar);
    return std::exp(-0.5f * of * of);
  }

  // Asks in the next round those beside whom somebody thinks otherwise than before.
  bool pass_on(const std::vector<float>& before, std::vector<uint8_t>& asked) const {
    std::fill(asked.begin(), asked.end(), uint8_t{0});
    bool any = false;
    Around<D> around(surface_);
    for (size_t k = 0; k < p_.size(); ++k) {
      if (!(std::abs(p_[k] - before[k]) > options_.moved)) continue;
      for_each_beside(around, k, [&](size_t other) { asked[other] = 1; });
      any = true;
    }
    return any;
  }

  const Surface<D>& surface_;
  BesideOptions options_;
  int threads_;
  std::vector<float> p_;
  std::vector<Row> rows_;
  CellRows<D> near_;
};

}  // namespace stillmap
