// How probable what was seen of a cell is, for things that stay for different times.
//
// A cell is occupied or empty, a two-state Markov chain: occupied for a share rho of the time, with
// correlation exp(-dt / tau); or, of what can be seen from some places only, from a share rho of
// them, with a correlation over the view instead of the time. Each look at it sees something there,
// which something occupying it must have caused; or sees through it, which an occupied cell lets
// happen with probability 1 - detection * reliability. What stands still is the chain with rho near
// one.
#pragma once

#include <algorithm>
#include <atomic>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <vector>

#include "stillmap/occupancy/change_hmm.hpp"
#include "stillmap/occupancy/observation_collector.hpp"
#include "stillmap/occupancy/two_state_chains.hpp"

namespace stillmap {

// The likelihood of everything seen of each element under each class, look after look. Memory is
// that of the elements; looks come in the order of time.
template <int D>
class Dwell {
 public:
  Dwell(const Surface<D>& surface, DwellClasses classes, const LookOptions& options,
        int threads = 1)
      : surface_(checked(surface)),
        options_(options),
        tables_(options.lateral),
        neighbours_(surface, options.reach, threads),
        beam_tiles_(surface),
        chains_(places_of(surface), std::move(classes), options.seconds) {}

  Dwell(const Dwell&) = delete;  // what collects looks refers to it
  Dwell& operator=(const Dwell&) = delete;

  size_t classes() const { return chains_.size(); }
  const Surface<D>& surface() const { return surface_; }

  // Beams without a return, and those of them that cross something solid.
  Lost lost(const Scans<D>& scans, int threads = 1) const {
    const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
    std::vector<Lost> shares(bounds.size() - 1);
    parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
      shares[i] = lost_of(surface_, beam_tiles_, options_, scans, first, last);
    });
    for (size_t i = 1; i < shares.size(); ++i) {
      shares[0].beams += shares[i].beams;
      shares[0].through_solid += shares[i].through_solid;
    }
    return shares[0];
  }
  // The cells in which beams without a return meet something solid.
  std::vector<Cell<D>> solid() const {
    std::vector<Cell<D>> cells;
    for (size_t i = 0; i < surface_.size(); ++i)
      if (const auto k = static_cast<int32_t>(i); is_solid(surface_, k, options_.normals))
        cells.push_back(surface_.cell(k));
    return cells;
  }
  // How far to trust them beyond the first solid element, from now on.
  void trust(double open) {
    options_.open = open;
    rest();
  }
  // From now on asks, too, which elements are of things that were put there or taken away.
  // courses: what became of each, too, not only how probable that is.
  void watch(const ChangeModel& model, bool courses = true) {
    if (newest_ != kNone) throw std::invalid_argument("watch: before the first look");
    changes_.emplace(surface_.size(), model, options_.seconds, courses);
  }
  const Changes& changes() const {
    if (!changes_) throw std::invalid_argument("changes: nobody asked to watch for them");
    return *changes_;
  }

  // look (T,): number of each scan's look, not falling, and not below those added before. place
  // (T, D): in metres, where the robot stood; null: where the sensors did.
  void add(const Scans<D>& scans, const int64_t* look, const double* place, int threads) {
    const size_t T = scans.n_scans;
    for (size_t t = 0; t < T; ++t)
      if (look[t] < (t ? look[t - 1] : newest_)) throw std::invalid_argument("look: must not fall");
    if (changes_ && T && !(Changes::counts(look[0]) && Changes::counts(look[T - 1])))
      throw std::invalid_argument("look: expected 0 to 2147483647");
    std::vector<size_t> starts;  // of looks
    for (size_t t = 0; t < T; ++t)
      if (t == 0 || look[t] != look[t - 1]) starts.push_back(t);
    starts.push_back(T);
    const size_t looks = starts.size() - 1;
    const size_t n = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1,
                                        std::max<size_t>(looks, 1));
    try {
      collect_by(n);
      follow(scans, look, place, starts, n);
    } catch (...) {
      rest();  // sheets are half written
      throw;
    }
    if (T) newest_ = look[T - 1];
  }

  // (n, among): likelihood of everything else that was seen of n of the cells, given that a beam
  // ended in each, under some of the classes, relative to the best of them; and the logarithm of
  // the best. The cells are first, first + every, ...
  void likelihood(const std::vector<size_t>& among, size_t first, size_t every, size_t n,
                  int threads, float* relative, double* log_best) const {
    parallel_shares(even_shares(n, threads), [&](size_t, size_t from, size_t to) {
      for (size_t i = from; i < to; ++i)
        log_best[i] = chains_.likelihood(first + i * every, among, relative + i * among.size());
    });
  }

  // Nothing is kept that only the next looks would want; they would make it anew.
  void rest() { collectors_.clear(); }

 private:
  static constexpr size_t kWindow = 64;  // looks held at once
  static constexpr int64_t kNone = std::numeric_limits<int64_t>::min();

  static const Surface<D>& checked(const Surface<D>& surface) {
    if (!surface.fitted()) throw std::invalid_argument("surface: fit it first");
    return surface;
  }

  static std::vector<size_t> one_each(size_t n) {
    std::vector<size_t> bounds(n + 1);
    for (size_t i = 0; i <= n; ++i) bounds[i] = i;
    return bounds;
  }

  static std::vector<Eigen::Vector3f> places_of(const Surface<D>& surface) {
    std::vector<Eigen::Vector3f> places(surface.size(), Eigen::Vector3f::Zero());
    for (size_t k = 0; k < places.size(); ++k)
      places[k].template head<D>() =
          surface.element(static_cast<int32_t>(k)).mean.template cast<float>();
    return places;
  }

  void collect_by(size_t n) {
    const size_t made = collectors_.size();
    if (made >= n) return;
    collectors_.resize(n);
    parallel_shares(one_each(n - made), [&](size_t i, size_t, size_t) {
      collectors_[made + i] =
          std::make_unique<LookCollector<D>>(surface_, beam_tiles_, neighbours_, options_, tables_);
    });
  }

  void follow(const Scans<D>& scans, const int64_t* look, const double* place,
              const std::vector<size_t>& starts, size_t n) {
    const size_t looks = starts.size() - 1;
    std::vector<Seen> seen(kWindow);
    for (size_t from = 0; from < starts.size() - 1; from += kWindow) {
      const size_t to = std::min(from + kWindow, looks);
      std::vector<int32_t> taken;
      for (size_t l = from; l < to; ++l)
        taken.push_back(
            chains_.begin(look[starts[l]], taken_from(scans, place, starts[l], starts[l + 1])));
      std::atomic<size_t> next{from};
      parallel_shares(one_each(n), [&](size_t i, size_t, size_t) {
        for (size_t l = next++; l < to; l = next++) {
          collectors_[i]->add(scans, starts[l], starts[l + 1]);
          collectors_[i]->take(seen[l - from]);
        }
      });
      std::atomic<size_t> next_span{0};
      parallel_shares(one_each(n), [&](size_t, size_t, size_t) {
        for (size_t s = next_span++; s < Seen::spans(surface_.size()); s = next_span++)
          for (size_t l = from; l < to; ++l)
            apply(seen[l - from], s, look[starts[l]], taken[l - from]);
      });
    }
  }

  // Mean place in those scans, in cells. Of several sensors in turn it would go to and fro.
  Eigen::Vector3d taken_from(const Scans<D>& scans, const double* place, size_t first,
                             size_t last) const {
    using Place = Eigen::Matrix<double, D, 1>;
    Eigen::Vector3d sum = Eigen::Vector3d::Zero();
    for (size_t t = first; t < last; ++t)
      sum.template head<D>() += place ? Place(Eigen::Map<const Place>(place + t * D))
                                      : pose_from<D>(scans.poses + t * (D + 1) * (D + 1)).t;
    if (!sum.allFinite()) throw std::invalid_argument("T_map_sensor, place: expected finite poses");
    return sum / (static_cast<double>(last - first) * surface_.resolution());
  }

  void apply(const Seen& seen, size_t span, int64_t look, int32_t taken) {
    for (size_t i = seen.begin[span]; i < seen.begin[span + 1]; ++i) {
      const auto k = static_cast<size_t>(seen.looks[i].element);
      const float reliability = seen.looks[i].seen_through;
      if (reliability == Look::kHit) {
        chains_.hit(k, taken);
        if (changes_) changes_->hit(k, look);
      } else {
        chains_.seen_through(k, taken, reliability);
        if (changes_) changes_->seen_through(k, look, reliability);
      }
    }
  }

  const Surface<D>& surface_;
  LookOptions options_;
  MeetingTables tables_;
  Neighbours<D> neighbours_;
  Tiles<D> beam_tiles_;
  Chains<D == 2 ? 8 : 4> chains_;
  std::optional<Changes> changes_;
  // one for each thread; each has a sheet as large as the map
  std::vector<std::unique_ptr<LookCollector<D>>> collectors_;
  int64_t newest_ = kNone;
};

// The element each beam ended in: kNoElement for those that were not hit or ended elsewhere.
template <int D>
inline void elements_of(const Surface<D>& surface, const Scans<D>& scans, int threads,
                        int32_t* element) {
  std::fill(element + scans.offset[0], element + scans.offset[scans.n_scans], kNoElement);
  const auto bounds = shares_of(scans.offset, scans.n_scans, threads);
  parallel_shares(bounds, [&](size_t, size_t first, size_t last) {
    Cursor<const Surface<D>> cursor(surface);
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n]) return;
      const Segment<D> beam(pose, scans.points + n * D, surface.resolution());
      element[n] = surface.owner(cursor, beam.end);
    });
  });
}

}  // namespace stillmap
