// Ray traversal of the beams of one time bin: hits and misses of surfels.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <optional>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/no_return_beams.hpp"
#include "stillmap/occupancy/observation.hpp"
#include "stillmap/occupancy/surfel.hpp"
#include "stillmap/occupancy/surfel_bitmap.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/occupancy/surfel_neighbours.hpp"
#include "stillmap/occupancy/surfel_traversal.hpp"
#include "stillmap/occupancy/surroundings.hpp"
#include "stillmap/util/lie.hpp"

namespace stillmap {

// Whether a surfel is part of a plane on which many beams ended.
template <int D>
inline bool is_solid(const SurfelMap<D>& surfel_map, int32_t k, bool use_normals) {
  constexpr int64_t kMinBeams = 10;
  return use_normals && !surfel_map.surfel(k).normal.isZero(0.0) &&
         surfel_map.beam_count(k) >= kMinBeams;
}

// End of the free space along a beam; nullopt if there is none.
template <int D>
inline std::optional<Vec<D>> free_space_end(const BeamSegment<D>& beam, bool hit,
                                            double end_margin) {
  if (hit) return beam.end;
  const Vec<D> chord = beam.end - beam.start;
  const double length = chord.norm(), usable = length - end_margin;
  if (!(usable > 0.0)) return std::nullopt;
  return Vec<D>(beam.start + chord / length * usable);
}

// Counts beams without a return in the scans [first, last).
template <int D>
inline NoReturnStats count_no_return_beams(const SurfelMap<D>& surfel_map,
                                           const SurfelBitmap<D>& bitmap,
                                           const ObservationOptions& options, const Scans<D>& scans,
                                           size_t first, size_t last) {
  NoReturnStats stats;
  SurfelTraversal<D> traversal(surfel_map, bitmap);
  for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
    if (scans.hit[n] || !in_no_return_run(scans, t, n)) return;
    ++stats.beam_count;
    const BeamSegment<D> beam(pose, scans.points + n * D, surfel_map.resolution());
    const std::optional<Vec<D>> end = free_space_end(beam, false, options.end_margin);
    bool through = false;
    if (end)
      traversal.traverse_marked(beam.start, *end, bitmap.bits(), [&](const auto& crossing) {
        through |= is_solid(surfel_map, crossing.surfel, options.use_normals);
      });
    stats.through_solid += through;
  });
  return stats;
}

// Collects the observations of one time bin.
template <int D>
class ObservationCollector {
 public:
  // surroundings: null where misses are not to say whether something was hit around them.
  ObservationCollector(const SurfelMap<D>& surfel_map, const SurfelBitmap<D>& bitmap,
                       const SurfelNeighbours<D>& neighbours, const ObservationOptions& options,
                       const IntersectionTables& tables, const Surroundings* surroundings = nullptr)
      : surfel_map_(surfel_map),
        bitmap_(bitmap),
        neighbours_(neighbours),
        options_(options),
        margin_(static_cast<float>(options.margin)),
        tables_(tables),
        states_(surfel_map.size()),
        touched_(ObservationBatch::n_spans(surfel_map.size())),
        open_bits_(bitmap.bits()),
        has_closed_(bitmap.bits().size(), false),
        traversal_(surfel_map, bitmap) {
    if (surroundings) occupied_.emplace(*surroundings);
    for (size_t k = 0; k < states_.size(); ++k)
      states_[k] = state_of(surfel_map, static_cast<int32_t>(k), options.use_normals);
  }

  // Adds all scans of a time bin. Hits come first: beams that pass what was hit say nothing more,
  // so its cells need not be tested along their rays.
  void add(const Scans<D>& scans, size_t first, size_t last) {
    record_hits(scans, first, last);
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n] && !in_no_return_run(scans, t, n)) return;
      record_pass(BeamSegment<D>(pose, scans.points + n * D, surfel_map_.resolution()),
                  scans.hit[n]);
    });
  }

  // Writes the observations to `out` and resets the collector.
  void take_batch(ObservationBatch& out) {
    out.observations.clear();
    out.begin.assign(1, 0);
    for (auto& touched_span : touched_) {
      for (const int32_t k : touched_span) {
        float& p_missed = states_[static_cast<size_t>(k)].p_missed;
        if (p_missed < kMaxMissed) out.observations.push_back({k, observed_value(k, p_missed)});
        p_missed = kUntouched;
      }
      touched_span.clear();
      out.begin.push_back(out.observations.size());
    }
    hit_surfels_.clear();
    for (const size_t block : closed_blocks_) {
      open_bits_[block] = bitmap_.bits()[block];
      has_closed_[block] = false;
    }
    closed_blocks_.clear();
  }

 private:
  using Vecf = Eigen::Matrix<float, D, 1>;
  static constexpr float kHitMark = -1.0f, kUntouched = 2.0f;
  static constexpr float kSaturated = 0.05f;  // further beams of the time bin are skipped
  static constexpr float kMaxMissed = 0.98f;  // p_missed above this is no observation

  // Per-surfel data in few bytes, since memory access dominates the run time.
  struct SurfelState {
    float p_missed = kUntouched;    // P(all beams of this time bin missed)
    std::array<int16_t, D> centre;  // from the cell's corner, in units of 1 / kUnit
    std::array<int16_t, D> normal;  // same unit; zero: isotropic
    int16_t half_extent;            // same unit; zero: isotropic
    bool is_solid;                  // see is_solid()

    static constexpr float kUnit = 4096.0f;
    static int16_t pack(double value) { return static_cast<int16_t>(std::lround(value * kUnit)); }
    static Vecf unpack(const std::array<int16_t, D>& packed) {
      Vecf v;
      for (int d = 0; d < D; ++d) v[d] = packed[static_cast<size_t>(d)] * (1.0f / kUnit);
      return v;
    }
  };

  static SurfelState state_of(const SurfelMap<D>& surfel_map, int32_t k, bool use_normals) {
    const Surfel<D>& surfel = surfel_map.surfel(k);
    const bool planar = use_normals && !surfel.normal.isZero(0.0);
    const Vec<D> centre =
        (planar ? surfel.centre : surfel.mean) - surfel_map.cell(k).template cast<double>();
    SurfelState state;
    for (int d = 0; d < D; ++d) {
      state.centre[static_cast<size_t>(d)] = SurfelState::pack(std::clamp(centre[d], -7.9, 7.9));
      state.normal[static_cast<size_t>(d)] =
          planar ? SurfelState::pack(surfel.normal[d]) : int16_t{0};
    }
    state.is_solid = is_solid(surfel_map, k, use_normals);
    state.half_extent =
        planar ? SurfelState::pack(std::clamp(surfel.half_extent, 1e-3, 7.0)) : int16_t{0};
    return state;
  }

  float observed_value(int32_t k, float p_missed) const {
    if (p_missed == kHitMark) return Observation::kHit;
    const float reliability = p_missed < kSaturated ? 1.0f : 1.0f - p_missed;
    return occupied_ && occupied_->around(k) ? -reliability : reliability;
  }

  // Marks the surfels in which beams ended and their neighbours as hit, and closes their cells.
  void record_hits(const Scans<D>& scans, size_t first, size_t last) {
    Cell<D> block = Cell<D>::Zero();  // of the beam before: successive ones often share theirs
    int32_t number = bitmap_.block_number(block);
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n]) return;
      const Cell<D> end =
          cell_of<D>(beam_end<D>(pose, scans.points + n * D, surfel_map_.resolution()));
      if (const Cell<D> its = BlockLayout<D>::block_of(end); its != block) {
        block = its;
        number = bitmap_.block_number(block);
      }
      if (number == SurfelBitmap<D>::kNone) return;
      const auto its_block = static_cast<size_t>(number);
      if (!open_bits_[its_block].contains(end)) return;  // without a surfel, or hit before
      const int32_t k = bitmap_.surfel(number, end);
      record_hit(k);
      hit_surfels_.push_back(k);
    });
    spread_hits();
    if constexpr (SurfelTraversal<D>::kUsesBits)
      for (const size_t block : closed_blocks_) open_bits_[block].find_slices();
  }

  // Marks a hit; false if it was marked before.
  bool record_hit(int32_t k) {
    float& p_missed = states_[static_cast<size_t>(k)].p_missed;
    if (p_missed == kHitMark) return false;
    if (p_missed == kUntouched) touched_[ObservationBatch::span_of(k)].push_back(k);
    p_missed = kHitMark;
    open_for_closing(bitmap_.block_of_surfel(k)).clear_in_tile(surfel_map_.cell(k));
    return true;
  }

  // Excludes a cell from further traversals of this time bin.
  void close(size_t block, const Cell<D>& cell) { open_for_closing(block).clear(cell); }

  typename SurfelBitmap<D>::BlockBits& open_for_closing(size_t block) {
    if (!has_closed_[block]) closed_blocks_.push_back(block);
    has_closed_[block] = true;
    return open_bits_[block];
  }

  // Ray in single precision, relative to the corner of its start cell.
  struct LocalRay {
    Cell<D> corner;
    Vecf start, direction;
    float length;
    bool hit;
  };

  // Lists the unsaturated surfels along the free part of a beam; nullopt for a beam of zero length.
  // The end cell is not visited: a return in it is a hit, and the free part ends before it.
  std::optional<LocalRay> list_crossings(const BeamSegment<D>& beam, bool hit) {
    crossings_.clear();
    const Vec<D> chord = beam.end - beam.start;
    const double length = chord.norm();
    const std::optional<Vec<D>> end = free_space_end(beam, hit, options_.end_margin);
    if (!end || !(length > 0.0)) return std::nullopt;
    const Vec<D> direction = chord / length;
    // solid surfels stop beams without a return, so these need all cells
    traversal_.traverse_marked(beam.start, *end, hit ? open_bits_ : bitmap_.bits(),
                               [&](const auto& crossing) {
                                 __builtin_prefetch(states_.data() + crossing.surfel, 1);
                                 crossings_.push_back(crossing);
                               });
    if constexpr (SurfelTraversal<D>::kUsesBits)
      if (!hit)  // what is behind something solid counts less
        std::sort(crossings_.begin(), crossings_.end(),
                  [](const auto& a, const auto& b) { return a.n_before < b.n_before; });
    const Cell<D> corner = cell_of<D>(beam.start);
    return LocalRay{corner, (beam.start - corner.template cast<double>()).template cast<float>(),
                    direction.template cast<float>(), static_cast<float>(length), hit};
  }

  // Updates p_missed of the surfels that a beam passed. Behind the first solid surfel a beam
  // without a return counts by trust_beyond_solid.
  void record_pass(const BeamSegment<D>& beam, bool hit) {
    const std::optional<LocalRay> ray = list_crossings(beam, hit);
    if (!ray) return;
    float trust = 1.0f;
    for (const auto& crossing : crossings_) {
      SurfelState& state = states_[static_cast<size_t>(crossing.surfel)];
      if (!hit && state.is_solid) trust = static_cast<float>(options_.trust_beyond_solid);
      if (state.p_missed < kSaturated) continue;
      const float p_met = trust * intersection_probability(state, crossing.cell, *ray);
      if (p_met <= 0.0f) continue;
      if (state.p_missed == kUntouched) {
        touched_[ObservationBatch::span_of(crossing.surfel)].push_back(crossing.surfel);
        state.p_missed = 1.0f;
      }
      state.p_missed *= 1.0f - p_met;
      if constexpr (SurfelTraversal<D>::kUsesBits)
        if (state.p_missed < kSaturated) close(crossing.block, crossing.cell);
    }
  }

  // P(the beam intersects the surfel's extent) given the lateral noise; small at grazing incidence.
  float intersection_probability(const SurfelState& state, const Cell<D>& cell,
                                 const LocalRay& ray) const {
    const Vecf off =
        (cell - ray.corner).template cast<float>() + SurfelState::unpack(state.centre) - ray.start;
    const float projection = off.dot(ray.direction);
    const float offset_squared = (off - projection * ray.direction).squaredNorm();
    if (state.half_extent == 0) {
      const float past = ray.length - projection;
      if (ray.hit && past * past + offset_squared < margin_ * margin_) return 0.0f;
      return tables_.isotropic(offset_squared);
    }
    const Vecf normal = SurfelState::unpack(state.normal);
    const float cos_incidence = normal.dot(ray.direction);
    if (ray.hit && std::abs(ray.length * cos_incidence - normal.dot(off)) < margin_) return 0.0f;
    const float half_extent =
        state.half_extent * (1.0f / SurfelState::kUnit) * std::abs(cos_incidence);
    return tables_(half_extent, std::sqrt(offset_squared));
  }

  // Marks the neighbours of what was hit, and the surroundings of both.
  void spread_hits() {
    if (occupied_) occupied_->clear();
    const auto occupy = [this](int32_t k) {
      if (occupied_) occupied_->hit(k);
    };
    for (const int32_t from : hit_surfels_) {
      occupy(from);
      for (const int32_t* k = neighbours_.begin(from); k != neighbours_.end(from); ++k)
        if (record_hit(*k)) occupy(*k);
    }
  }

  const SurfelMap<D>& surfel_map_;
  const SurfelBitmap<D>& bitmap_;
  const SurfelNeighbours<D>& neighbours_;
  ObservationOptions options_;
  float margin_;
  const IntersectionTables& tables_;
  std::vector<SurfelState> states_;
  std::vector<std::vector<int32_t>> touched_;  // by span
  std::vector<int32_t> hit_surfels_;
  std::vector<typename SurfelTraversal<D>::Crossing> crossings_;  // of one beam, prefetched
  std::vector<typename SurfelBitmap<D>::BlockBits> open_bits_;    // cells that are not saturated
  std::vector<uint8_t> has_closed_;                               // by block: excluded cells
  std::vector<size_t> closed_blocks_;                             // these
  SurfelTraversal<D> traversal_;
  std::optional<OccupiedSurroundings> occupied_;
};

}  // namespace stillmap
