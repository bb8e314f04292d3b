// Follows the beams of one look: which elements they hit, and which they saw through.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
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
#include "stillmap/util/lie.hpp"

namespace stillmap {

// Whether an element is one of a surface on which many beams ended: it is there for sure, at least
// at times.
template <int D>
inline bool is_solid(const SurfelMap<D>& surfel_map, int32_t k, bool use_normals) {
  constexpr int64_t kMinBeams = 10;
  return use_normals && !surfel_map.surfel(k).normal.isZero(0.0) &&
         surfel_map.beam_count(k) >= kMinBeams;
}

// Where a beam stops being one that tells of free space; nothing, if it is too short to tell.
template <int D>
inline std::optional<Vec<D>> free_space_end(const BeamSegment<D>& beam, bool hit,
                                            double end_margin) {
  if (hit) return beam.end;
  const Vec<D> chord = beam.end - beam.start;
  const double length = chord.norm(), usable = length - end_margin;
  if (!(usable > 0.0)) return std::nullopt;
  return Vec<D>(beam.start + chord / length * usable);
}

// Of the beams of scans [first, last) without a return, what else is known of the surface.
template <int D>
inline NoReturnStats count_no_return_beams(const SurfelMap<D>& surfel_map,
                                           const SurfelBitmap<D>& tiles,
                                           const ObservationOptions& options, const Scans<D>& scans,
                                           size_t first, size_t last) {
  NoReturnStats stats;
  SurfelTraversal<D> crossing(surfel_map, tiles);
  for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
    if (scans.hit[n] || !has_no_return_neighbours(scans, t, n)) return;
    ++stats.beam_count;
    const BeamSegment<D> beam(pose, scans.points + n * D, surfel_map.resolution());
    const std::optional<Vec<D>> end = free_space_end(beam, false, options.end_margin);
    bool through = false;
    if (end)
      crossing.traverse_marked(beam.start, *end, tiles.bits(), [&](const auto& crossing) {
        through |= is_solid(surfel_map, crossing.surfel, options.use_normals);
      });
    stats.through_solid += through;
  });
  return stats;
}

// Collects the beams of one look.
template <int D>
class ObservationCollector {
 public:
  ObservationCollector(const SurfelMap<D>& surfel_map, const SurfelBitmap<D>& tiles,
                       const SurfelNeighbours<D>& neighbours, const ObservationOptions& options,
                       const IntersectionTables& tables)
      : surfel_map_(surfel_map),
        bitmap_(tiles),
        neighbours_(neighbours),
        options_(options),
        margin_(static_cast<float>(options.margin)),
        tables_(tables),
        states_(surfel_map.size()),
        touched_(ObservationBatch::n_spans(surfel_map.size())),
        open_bits_(tiles.bits()),
        crossing_(surfel_map, tiles) {
    for (size_t k = 0; k < states_.size(); ++k)
      states_[k] = state_of(surfel_map, static_cast<int32_t>(k), options.use_normals);
  }

  void add(const Scans<D>& scans, size_t first, size_t last) {
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n] && !has_no_return_neighbours(scans, t, n)) return;
      const BeamSegment<D> beam(pose, scans.points + n * D, surfel_map_.resolution());
      const bool has_length = record_pass(beam, scans.hit[n]);
      if (!scans.hit[n]) return;
      const Cell<D> end = cell_of<D>(beam.end);
      const int32_t k = has_length ? crossing_.surfel_at_end(end) : bitmap_.surfel(end);
      if (k != kNoSurfel && record_hit(k)) hit_surfels_.push_back(k);
    });
  }

  // What the look says, and a clean sheet for the next one.
  void take_batch(ObservationBatch& out) {
    spread_hits();
    out.observations.clear();
    out.begin.assign(1, 0);
    for (auto& touched_span : touched_) {
      for (const int32_t k : touched_span) {
        float& p_missed = states_[static_cast<size_t>(k)].p_missed;
        if (p_missed < kMaxMissed) out.observations.push_back({k, miss_reliability(p_missed)});
        p_missed = kUntouched;
      }
      touched_span.clear();
      out.begin.push_back(out.observations.size());
    }
    hit_surfels_.clear();
    for (const size_t block : closed_blocks_) open_bits_[block] = bitmap_.bits()[block];
    closed_blocks_.clear();
  }

 private:
  using Vecf = Eigen::Matrix<float, D, 1>;
  static constexpr float kHitMark = -1.0f, kUntouched = 2.0f;
  static constexpr float kSaturated = 0.05f;  // more beams of the same look would change nothing
  static constexpr float kMaxMissed = 0.98f;

  // What a beam has to know of an element, in few bytes: most of the time goes into fetching them.
  struct SurfelState {
    float p_missed = kUntouched;    // probability that every beam of this look went past
    std::array<int16_t, D> centre;  // seen from the cell's corner, in units of 1 / kUnit
    std::array<int16_t, D> normal;  // likewise
    int16_t half_extent;            // likewise; zero: no surface
    bool is_solid;                  // a surface that many beams ended on

    static constexpr float kUnit = 4096.0f;
    static int16_t pack(double value) { return static_cast<int16_t>(std::lround(value * kUnit)); }
    static Vecf unpack(const std::array<int16_t, D>& pack) {
      Vecf v;
      for (int d = 0; d < D; ++d) v[d] = pack[static_cast<size_t>(d)] * (1.0f / kUnit);
      return v;
    }
  };

  static SurfelState state_of(const SurfelMap<D>& surfel_map, int32_t k, bool use_normals) {
    const Surfel<D>& e = surfel_map.surfel(k);
    const bool planar = use_normals && !e.normal.isZero(0.0);
    const Vec<D> centre = (planar ? e.centre : e.mean) - surfel_map.cell(k).template cast<double>();
    SurfelState state;
    for (int d = 0; d < D; ++d) {
      state.centre[static_cast<size_t>(d)] = SurfelState::pack(std::clamp(centre[d], -7.9, 7.9));
      state.normal[static_cast<size_t>(d)] = planar ? SurfelState::pack(e.normal[d]) : int16_t{0};
    }
    state.is_solid = is_solid(surfel_map, k, use_normals);
    state.half_extent =
        planar ? SurfelState::pack(std::clamp(e.half_extent, 1e-3, 7.0)) : int16_t{0};
    return state;
  }

  static float miss_reliability(float p_missed) {
    if (p_missed == kHitMark) return Observation::kHit;
    return p_missed < kSaturated ? 1.0f : 1.0f - p_missed;
  }

  // Whether that is news.
  bool record_hit(int32_t k) {
    float& p_missed = states_[static_cast<size_t>(k)].p_missed;
    if (p_missed == kHitMark) return false;
    if (p_missed == kUntouched) touched_[ObservationBatch::span_of(k)].push_back(k);
    p_missed = kHitMark;
    if constexpr (SurfelTraversal<D>::kUsesBits) {
      const Cell<D>& cell = surfel_map_.cell(k);
      close(static_cast<size_t>(bitmap_.block_number(BlockLayout<D>::block_of(cell))), cell);
    }
    return true;
  }

  // Of the element in a cell more beams of this look tell nothing.
  void close(size_t block, const Cell<D>& cell) {
    auto& bits_left = open_bits_[block];
    if (bits_left.tiles == bitmap_.bits()[block].tiles) closed_blocks_.push_back(block);
    bits_left.clear(cell);
  }

  // A beam in single precision, from the corner of the cell in which it starts.
  struct LocalRay {
    Cell<D> corner;
    Vecf start, direction;
    float length;
    bool hit;
  };

  // Lists the elements whose cells a beam crosses before it ends, of which it may tell anything;
  // returns whether it has a length. The end cell is not visited: an end in it is a hit, and free
  // range stops before it.
  std::optional<LocalRay> list_crossings(const BeamSegment<D>& beam, bool hit) {
    crossings_.clear();
    const Vec<D> chord = beam.end - beam.start;
    const double length = chord.norm();
    const std::optional<Vec<D>> end = free_space_end(beam, hit, options_.end_margin);
    if (!end || !(length > 0.0)) return std::nullopt;
    const Vec<D> direction = chord / length;
    // what is solid stops one without a return, whether it is known to be there or not
    crossing_.traverse_marked(beam.start, *end, hit ? open_bits_ : bitmap_.bits(),
                              [&](const auto& crossing) {
                                __builtin_prefetch(states_.data() + crossing.surfel, 1);
                                crossings_.push_back(crossing);
                              });
    const Cell<D> corner = cell_of<D>(beam.start);
    return LocalRay{corner, (beam.start - corner.template cast<double>()).template cast<float>(),
                    direction.template cast<float>(), static_cast<float>(length), hit};
  }

  // Notes what the beam passed. One without a return passed what lies before the first solid
  // element in its way; that it did not end there without an echo is only so sure. Returns whether
  // it has a length.
  bool record_pass(const BeamSegment<D>& beam, bool hit) {
    const std::optional<LocalRay> ray = list_crossings(beam, hit);
    if (!ray) return false;
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
    return true;
  }

  // Of the beam crossing the surface within the element, as far as `lateral` lets one tell: small
  // at grazing angles.
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

  void spread_hits() {
    for (const int32_t from : hit_surfels_)
      for (const int32_t* k = neighbours_.begin(from); k != neighbours_.end(from); ++k)
        record_hit(*k);
  }

  const SurfelMap<D>& surfel_map_;
  const SurfelBitmap<D>& bitmap_;
  const SurfelNeighbours<D>& neighbours_;
  ObservationOptions options_;
  float margin_;
  const IntersectionTables& tables_;
  std::vector<SurfelState> states_;
  std::vector<std::vector<int32_t>> touched_;  // by spans
  std::vector<int32_t> hit_surfels_;
  std::vector<typename SurfelTraversal<D>::Crossing>
      crossings_;  // of one beam: fetched all at once, then looked at
  std::vector<typename SurfelBitmap<D>::BlockBits>
      open_bits_;                      // cells of which more beams of this look tell more
  std::vector<size_t> closed_blocks_;  // blocks in which some do not
  SurfelTraversal<D> crossing_;
};

}  // namespace stillmap
