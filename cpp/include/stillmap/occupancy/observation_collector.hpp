// Follows the beams of one look: which elements they hit, and which they saw through.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <optional>
#include <vector>

#include "stillmap/occupancy/no_return_beams.hpp"
#include "stillmap/occupancy/observation.hpp"
#include "stillmap/occupancy/surfel_map.hpp"
#include "stillmap/occupancy/surfel_neighbours.hpp"
#include "stillmap/occupancy/surfel_traversal.hpp"

namespace stillmap {

// Whether an element is one of a surface on which many beams ended: it is there for sure, at least
// at times.
template <int D>
inline bool is_solid(const Surface<D>& surface, int32_t k, bool normals) {
  constexpr int64_t many = 10;
  return normals && !surface.element(k).normal.isZero(0.0) && surface.beams(k) >= many;
}

// Where a beam stops being one that tells of free space; nothing, if it is too short to tell.
template <int D>
inline std::optional<Vec<D>> free_end(const Segment<D>& beam, bool hit, double beyond) {
  if (hit) return beam.end;
  const Vec<D> way = beam.end - beam.start;
  const double length = way.norm(), usable = length - beyond;
  if (!(usable > 0.0)) return std::nullopt;
  return Vec<D>(beam.start + way / length * usable);
}

// Of the beams of scans [first, last) without a return, what else is known of the surface.
template <int D>
inline Lost lost_of(const Surface<D>& surface, const Tiles<D>& tiles, const LookOptions& options,
                    const Scans<D>& scans, size_t first, size_t last) {
  Lost lost;
  Crossing<D> crossing(surface, tiles);
  for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
    if (scans.hit[n] || !in_a_row(scans, t, n)) return;
    ++lost.beams;
    const Segment<D> beam(pose, scans.points + n * D, surface.resolution());
    const std::optional<Vec<D>> end = free_end(beam, false, options.beyond);
    bool through = false;
    if (end)
      crossing.follow(beam.start, *end, tiles.marks(), [&](const auto& place) {
        through |= is_solid(surface, place.element, options.normals);
      });
    lost.through_solid += through;
  });
  return lost;
}

// Collects the beams of one look.
template <int D>
class LookCollector {
 public:
  LookCollector(const Surface<D>& surface, const Tiles<D>& tiles, const Neighbours<D>& neighbours,
                const LookOptions& options, const MeetingTables& tables)
      : surface_(surface),
        tiles_(tiles),
        neighbours_(neighbours),
        options_(options),
        margin_(static_cast<float>(options.margin)),
        tables_(tables),
        sheet_(surface.size()),
        touched_(Seen::spans(surface.size())),
        open_(tiles.marks()),
        crossing_(surface, tiles) {
    for (size_t k = 0; k < sheet_.size(); ++k)
      sheet_[k] = row_of(surface, static_cast<int32_t>(k), options.normals);
  }

  void add(const Scans<D>& scans, size_t first, size_t last) {
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n] && !in_a_row(scans, t, n)) return;
      const Segment<D> beam(pose, scans.points + n * D, surface_.resolution());
      const bool has_length = pass(beam, scans.hit[n]);
      if (!scans.hit[n]) return;
      const Cell<D> end = cell_of<D>(beam.end);
      const int32_t k = has_length ? crossing_.element_at_end(end) : tiles_.element(end);
      if (k != kNoElement && strike(k)) struck_.push_back(k);
    });
  }

  // What the look says, and a clean sheet for the next one.
  void take(Seen& out) {
    spread_hits();
    out.looks.clear();
    out.begin.assign(1, 0);
    for (auto& touched : touched_) {
      for (const int32_t k : touched) {
        float& missed = sheet_[static_cast<size_t>(k)].missed;
        if (missed < kLeast) out.looks.push_back({k, seen_through(missed)});
        missed = kUntouched;
      }
      touched.clear();
      out.begin.push_back(out.looks.size());
    }
    struck_.clear();
    for (const size_t block : shut_) open_[block] = tiles_.marks()[block];
    shut_.clear();
  }

 private:
  using Vecf = Eigen::Matrix<float, D, 1>;
  static constexpr float kStruck = -1.0f, kUntouched = 2.0f;
  static constexpr float kSure = 0.05f;  // more beams of the same look would change nothing
  static constexpr float kLeast = 0.98f;

  // What a beam has to know of an element, in few bytes: most of the time goes into fetching them.
  struct Row {
    float missed = kUntouched;      // probability that every beam of this look went past
    std::array<int16_t, D> centre;  // seen from the cell's corner, in units of 1 / kUnit
    std::array<int16_t, D> normal;  // likewise
    int16_t half;                   // likewise; zero: no surface
    bool solid;                     // a surface that many beams ended on

    static constexpr float kUnit = 4096.0f;
    static int16_t packed(double value) { return static_cast<int16_t>(std::lround(value * kUnit)); }
    static Vecf unpacked(const std::array<int16_t, D>& packed) {
      Vecf v;
      for (int d = 0; d < D; ++d) v[d] = packed[static_cast<size_t>(d)] * (1.0f / kUnit);
      return v;
    }
  };

  static Row row_of(const Surface<D>& surface, int32_t k, bool normals) {
    const Element<D>& e = surface.element(k);
    const bool flat = normals && !e.normal.isZero(0.0);
    const Vec<D> centre = (flat ? e.centre : e.mean) - surface.cell(k).template cast<double>();
    Row row;
    for (int d = 0; d < D; ++d) {
      row.centre[static_cast<size_t>(d)] = Row::packed(std::clamp(centre[d], -7.9, 7.9));
      row.normal[static_cast<size_t>(d)] = flat ? Row::packed(e.normal[d]) : int16_t{0};
    }
    row.solid = is_solid(surface, k, normals);
    row.half = flat ? Row::packed(std::clamp(e.half, 1e-3, 7.0)) : int16_t{0};
    return row;
  }

  static float seen_through(float missed) {
    if (missed == kStruck) return Look::kHit;
    return missed < kSure ? 1.0f : 1.0f - missed;
  }

  // Whether that is news.
  bool strike(int32_t k) {
    float& missed = sheet_[static_cast<size_t>(k)].missed;
    if (missed == kStruck) return false;
    if (missed == kUntouched) touched_[Seen::span_of(k)].push_back(k);
    missed = kStruck;
    if constexpr (Crossing<D>::kByMarks) {
      const Cell<D>& cell = surface_.cell(k);
      shut(static_cast<size_t>(tiles_.find(Grid<D>::block_of(cell))), cell);
    }
    return true;
  }

  // Of the element in a cell more beams of this look tell nothing.
  void shut(size_t block, const Cell<D>& cell) {
    auto& open = open_[block];
    if (open.tiles == tiles_.marks()[block].tiles) shut_.push_back(block);
    open.unmark(cell);
  }

  // A beam in single precision, from the corner of the cell in which it starts.
  struct Line {
    Cell<D> corner;
    Vecf start, direction;
    float length;
    bool hit;
  };

  // Lists the elements whose cells a beam crosses before it ends, of which it may tell anything;
  // returns whether it has a length. The end cell is not visited: an end in it is a hit, and free
  // range stops before it.
  std::optional<Line> cross(const Segment<D>& beam, bool hit) {
    crossed_.clear();
    const Vec<D> way = beam.end - beam.start;
    const double length = way.norm();
    const std::optional<Vec<D>> end = free_end(beam, hit, options_.beyond);
    if (!end || !(length > 0.0)) return std::nullopt;
    const Vec<D> direction = way / length;
    // what is solid stops one without a return, whether it is known to be there or not
    crossing_.follow(beam.start, *end, hit ? open_ : tiles_.marks(), [&](const auto& place) {
      __builtin_prefetch(sheet_.data() + place.element, 1);
      crossed_.push_back(place);
    });
    const Cell<D> corner = cell_of<D>(beam.start);
    return Line{corner, (beam.start - corner.template cast<double>()).template cast<float>(),
                direction.template cast<float>(), static_cast<float>(length), hit};
  }

  // Notes what the beam passed. One without a return passed what lies before the first solid
  // element in its way; that it did not end there without an echo is only so sure. Returns whether
  // it has a length.
  bool pass(const Segment<D>& beam, bool hit) {
    const std::optional<Line> line = cross(beam, hit);
    if (!line) return false;
    float trust = 1.0f;
    for (const auto& crossed : crossed_) {
      Row& row = sheet_[static_cast<size_t>(crossed.element)];
      if (!hit && row.solid) trust = static_cast<float>(options_.open);
      if (row.missed < kSure) continue;
      const float met = trust * probability_met(row, crossed.cell, *line);
      if (met <= 0.0f) continue;
      if (row.missed == kUntouched) {
        touched_[Seen::span_of(crossed.element)].push_back(crossed.element);
        row.missed = 1.0f;
      }
      row.missed *= 1.0f - met;
      if constexpr (Crossing<D>::kByMarks)
        if (row.missed < kSure) shut(crossed.block, crossed.cell);
    }
    return true;
  }

  // Of the beam crossing the surface within the element, as far as `lateral` lets one tell: small
  // at grazing angles.
  float probability_met(const Row& row, const Cell<D>& cell, const Line& line) const {
    const Vecf off =
        (cell - line.corner).template cast<float>() + Row::unpacked(row.centre) - line.start;
    const float along = off.dot(line.direction);
    const float aside_squared = (off - along * line.direction).squaredNorm();
    if (row.half == 0) {
      const float behind = line.length - along;
      if (line.hit && behind * behind + aside_squared < margin_ * margin_) return 0.0f;
      return tables_.round(aside_squared);
    }
    const Vecf normal = Row::unpacked(row.normal);
    const float facing = normal.dot(line.direction);
    if (line.hit && std::abs(line.length * facing - normal.dot(off)) < margin_) return 0.0f;
    const float half = row.half * (1.0f / Row::kUnit) * std::abs(facing);
    return tables_(half, std::sqrt(aside_squared));
  }

  void spread_hits() {
    for (const int32_t from : struck_)
      for (const int32_t* k = neighbours_.begin(from); k != neighbours_.end(from); ++k) strike(*k);
  }

  const Surface<D>& surface_;
  const Tiles<D>& tiles_;
  const Neighbours<D>& neighbours_;
  LookOptions options_;
  float margin_;
  const MeetingTables& tables_;
  std::vector<Row> sheet_;
  std::vector<std::vector<int32_t>> touched_;  // by spans
  std::vector<int32_t> struck_;
  std::vector<typename Crossing<D>::Place>
      crossed_;                                 // of one beam: fetched all at once, then looked at
  std::vector<typename Tiles<D>::Marks> open_;  // cells of which more beams of this look tell more
  std::vector<size_t> shut_;                    // blocks in which some do not
  Crossing<D> crossing_;
};

}  // namespace stillmap
