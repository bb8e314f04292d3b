// Occupancy HMM of each surfel (after Meyer-Delius et al. 2012): likelihood of its observations
// under several classes with different persistence. The filter: two_state_chains.hpp.
//
// Each class is a two-state Markov chain (occupied, empty) with stationary probability rho of being
// occupied and correlation exp(-dt / tau), or with a correlation over the viewing angle for what is
// visible from some places only. An observation is a hit, which needs an occupied cell, or a miss,
// which an occupied cell allows with probability 1 - p_detection * reliability. Which classes count
// as static is decided in Python (HmmClasses).
#pragma once

#include <algorithm>
#include <atomic>
#include <limits>
#include <memory>
#include <optional>
#include <stdexcept>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/change_hmm.hpp"
#include "stillmap/occupancy/observation.hpp"
#include "stillmap/occupancy/observation_collector.hpp"
#include "stillmap/occupancy/surfel_bitmap.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/occupancy/surfel_neighbours.hpp"
#include "stillmap/occupancy/surroundings.hpp"
#include "stillmap/occupancy/two_state_chains.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Forward algorithm over the observations of all surfels. Memory is proportional to the number of
// surfels; time bins arrive in order.
template <int D>
class OccupancyHmm {
 public:
  OccupancyHmm(const SurfelMap<D>& surfel_map, OccupancyClasses classes,
               const ObservationOptions& options, int threads = 1)
      : surfel_map_(require_fitted(surfel_map)),
        options_(options),
        tables_(options.lateral_std),
        neighbours_(surfel_map, options.hit_radius, threads),
        bitmap_(surfel_map),
        chains_(surfel_means(surfel_map), std::move(classes), options.bin_seconds) {}

  OccupancyHmm(const OccupancyHmm&) = delete;  // collectors refer to it
  OccupancyHmm& operator=(const OccupancyHmm&) = delete;

  size_t classes() const { return chains_.size(); }
  const SurfelMap<D>& surfel_map() const { return surfel_map_; }

  // Counts beams without a return, and those of them that cross something solid.
  NoReturnStats no_return_stats(const Scans<D>& scans, int threads = 1) const {
    const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
    std::vector<NoReturnStats> partial(bounds.size() - 1);
    parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
      partial[i] = count_no_return_beams(surfel_map_, bitmap_, options_, scans, first, last);
    });
    for (size_t i = 1; i < partial.size(); ++i) {
      partial[0].beam_count += partial[i].beam_count;
      partial[0].through_solid += partial[i].through_solid;
    }
    return partial[0];
  }
  // Cells in which a beam without a return meets a solid surfel.
  std::vector<Cell<D>> solid_cells() const {
    std::vector<Cell<D>> cells;
    for (size_t i = 0; i < surfel_map_.size(); ++i)
      if (const auto k = static_cast<int32_t>(i); is_solid(surfel_map_, k, options_.use_normals))
        cells.push_back(surfel_map_.cell(k));
    return cells;
  }
  // Reliability of beams without a return behind the first solid surfel, for later scans.
  void set_trust_beyond_solid(double trust_beyond_solid) {
    options_.trust_beyond_solid = trust_beyond_solid;
    release_buffers();
  }
  // Also runs a ChangeHmm on all later observations; with_paths: including state paths.
  void track_changes(const ChangeOptions& options, bool with_paths = true) {
    if (last_time_bin_ != kNoTimeBin)
      throw std::invalid_argument("track_changes: expected before the first observation");
    change_hmm_.emplace(surfel_map_.size(), options, options_.bin_seconds, with_paths);
  }
  // Also counts misses, and those while something in the surroundings was hit. edge: of the coarse
  // cells that surroundings are made of, in cells; 3D only.
  void track_surroundings(int32_t edge) {
    static_assert(D == 3);
    if (last_time_bin_ != kNoTimeBin)
      throw std::invalid_argument("track_surroundings: expected before the first observation");
    surroundings_.emplace(surfel_map_, edge);
    miss_counts_.assign(surfel_map_.size(), {});
    release_buffers();
  }
  const std::vector<MissCounts>& miss_counts() const {
    if (!surroundings_)
      throw std::invalid_argument("miss_counts: expected track_surroundings before");
    return miss_counts_;
  }
  const ChangeHmm& change_hmm() const {
    if (!change_hmm_) throw std::invalid_argument("changes: expected track_changes before");
    return *change_hmm_;
  }

  // time_bin (T,): of each scan, non-decreasing over all calls. positions (T, D): robot positions
  // in metres; null: those of the sensors.
  void add(const Scans<D>& scans, const int64_t* time_bin, const double* positions, int threads) {
    const size_t T = scans.n_scans;
    for (size_t t = 0; t < T; ++t)
      if (time_bin[t] < (t ? time_bin[t - 1] : last_time_bin_))
        throw std::invalid_argument("time_bin: must not fall");
    if ((change_hmm_ || surroundings_) && T &&
        !(ChangeHmm::is_valid_time_bin(time_bin[0]) &&
          ChangeHmm::is_valid_time_bin(time_bin[T - 1])))
      throw std::invalid_argument("time_bin: expected 0 to 2147483647");
    std::vector<size_t> bin_starts;  // first scan of each time bin
    for (size_t t = 0; t < T; ++t)
      if (t == 0 || time_bin[t] != time_bin[t - 1]) bin_starts.push_back(t);
    bin_starts.push_back(T);
    const size_t n_bins = bin_starts.size() - 1;
    const size_t n = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1,
                                        std::max<size_t>(n_bins, 1));
    try {
      make_collectors(n);
      process(scans, time_bin, positions, bin_starts, n);
    } catch (...) {
      release_buffers();  // collectors are in an undefined state
      throw;
    }
    if (T) last_time_bin_ = time_bin[T - 1];
  }

  // Likelihood (n, among) of all observations of n surfels, given that one is a hit, under some of
  // the classes, relative to the best of these, and its logarithm (n,). The surfels are first,
  // first + stride, ...
  void likelihood(const std::vector<size_t>& among, size_t first, size_t stride, size_t n,
                  int threads, float* relative, double* log_best) const {
    parallel_for_ranges(split_evenly(n, threads), [&](size_t, size_t from, size_t to) {
      for (size_t i = from; i < to; ++i)
        log_best[i] = chains_.likelihood(first + i * stride, among, relative + i * among.size());
    });
  }

  // Frees the collectors; later scans allocate them again.
  void release_buffers() { collectors_.clear(); }

 private:
  static constexpr size_t kBatchBins = 64;  // time bins per batch
  static constexpr int64_t kNoTimeBin = std::numeric_limits<int64_t>::min();

  static const SurfelMap<D>& require_fitted(const SurfelMap<D>& surfel_map) {
    if (!surfel_map.fitted()) throw std::invalid_argument("surfel_map: fit it first");
    return surfel_map;
  }

  static std::vector<size_t> one_per_thread(size_t n) {
    std::vector<size_t> bounds(n + 1);
    for (size_t i = 0; i <= n; ++i) bounds[i] = i;
    return bounds;
  }

  static std::vector<Eigen::Vector3f> surfel_means(const SurfelMap<D>& surfel_map) {
    std::vector<Eigen::Vector3f> means(surfel_map.size(), Eigen::Vector3f::Zero());
    for (size_t k = 0; k < means.size(); ++k)
      means[k].template head<D>() =
          surfel_map.surfel(static_cast<int32_t>(k)).mean.template cast<float>();
    return means;
  }

  void make_collectors(size_t n) {
    const size_t existing = collectors_.size();
    if (existing >= n) return;
    collectors_.resize(n);
    parallel_for_ranges(one_per_thread(n - existing), [&](size_t i, size_t, size_t) {
      collectors_[existing + i] = std::make_unique<ObservationCollector<D>>(
          surfel_map_, bitmap_, neighbours_, options_, tables_,
          surroundings_ ? &*surroundings_ : nullptr);
    });
  }

  void process(const Scans<D>& scans, const int64_t* time_bin, const double* positions,
               const std::vector<size_t>& bin_starts, size_t n) {
    const size_t n_bins = bin_starts.size() - 1;
    std::vector<ObservationBatch> batches(kBatchBins);
    for (size_t from = 0; from < bin_starts.size() - 1; from += kBatchBins) {
      const size_t to = std::min(from + kBatchBins, n_bins);
      std::vector<int32_t> viewpoints;
      for (size_t l = from; l < to; ++l)
        viewpoints.push_back(chains_.begin_observation(
            time_bin[bin_starts[l]],
            mean_position(scans, positions, bin_starts[l], bin_starts[l + 1])));
      std::atomic<size_t> next{from};
      parallel_for_ranges(one_per_thread(n), [&](size_t i, size_t, size_t) {
        for (size_t l = next++; l < to; l = next++) {
          collectors_[i]->add(scans, bin_starts[l], bin_starts[l + 1]);
          collectors_[i]->take_batch(batches[l - from]);
        }
      });
      std::atomic<size_t> next_span{0};
      parallel_for_ranges(one_per_thread(n), [&](size_t, size_t, size_t) {
        for (size_t s = next_span++; s < ObservationBatch::n_spans(surfel_map_.size());
             s = next_span++)
          for (size_t l = from; l < to; ++l)
            apply_batch(batches[l - from], s, time_bin[bin_starts[l]], viewpoints[l - from]);
      });
    }
  }

  // Mean position in cells over some scans: with several sensors it is smoother than their own.
  Eigen::Vector3d mean_position(const Scans<D>& scans, const double* positions, size_t first,
                                size_t last) const {
    using Position = Eigen::Matrix<double, D, 1>;
    Eigen::Vector3d sum = Eigen::Vector3d::Zero();
    for (size_t t = first; t < last; ++t)
      sum.template head<D>() += positions ? Position(Eigen::Map<const Position>(positions + t * D))
                                          : pose_from<D>(scans.poses + t * (D + 1) * (D + 1)).t;
    if (!sum.allFinite())
      throw std::invalid_argument("T_map_sensor, positions: expected finite poses");
    return sum / (static_cast<double>(last - first) * surfel_map_.resolution());
  }

  void apply_batch(const ObservationBatch& batch, size_t span, int64_t time_bin,
                   int32_t viewpoint) {
    for (size_t i = batch.begin[span]; i < batch.begin[span + 1]; ++i) {
      const Observation& seen = batch.observations[i];
      const auto k = static_cast<size_t>(seen.surfel);
      if (seen.is_hit()) {
        chains_.hit(k, viewpoint);
        if (change_hmm_) change_hmm_->hit(k, time_bin);
        if (surroundings_) miss_counts_[k].hit(time_bin);
        continue;
      }
      const float reliability = seen.reliability();
      chains_.miss(k, viewpoint, reliability);
      if (change_hmm_) change_hmm_->miss(k, time_bin, reliability);
      if (surroundings_) miss_counts_[k].miss(time_bin, reliability, seen.is_surrounded());
    }
  }

  const SurfelMap<D>& surfel_map_;
  ObservationOptions options_;
  IntersectionTables tables_;
  SurfelNeighbours<D> neighbours_;
  SurfelBitmap<D> bitmap_;
  TwoStateChains<D == 2 ? 8 : 4> chains_;
  std::optional<ChangeHmm> change_hmm_;
  std::optional<Surroundings> surroundings_;
  std::vector<MissCounts> miss_counts_;  // empty without surroundings
  // one per thread, each of the size of the map
  std::vector<std::unique_ptr<ObservationCollector<D>>> collectors_;
  int64_t last_time_bin_ = kNoTimeBin;
};

// Surfel that each beam is associated with; kNoSurfel without a return or where there is none.
template <int D>
inline void associate_beams(const SurfelMap<D>& surfel_map, const Scans<D>& scans, int threads,
                            int32_t* surfel) {
  std::fill(surfel + scans.offset[0], surfel + scans.offset[scans.n_scans], kNoSurfel);
  const auto bounds = split_by_beams(scans.offset, scans.n_scans, threads);
  parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
    BlockCursor<const SurfelMap<D>> cursor(surfel_map);
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n]) return;
      const Vec<D> end = beam_end<D>(pose, scans.points + n * D, surfel_map.resolution());
      surfel[n] = surfel_map.associate(cursor, end);
    });
  });
}

}  // namespace stillmap
