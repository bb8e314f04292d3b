// Causal E-step in 2D: beams are followed through the cells of a map with forward filters, scan by
// scan. What a cell says about a beam follows from earlier scans and this one only.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <utility>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/ray_traversal.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/filter_map.hpp"
#include "stillmap/occupancy/observation.hpp"

namespace stillmap {

// What is known of a cell in which no beam ended: in how many time bins beams passed.
struct PassedCell {
  int32_t filter = -1;    // index of the cell's filter; -1: no beam ended here
  int32_t last_bin = -1;  // in which a beam passed; -1: none did
  int32_t tag = -1;       // of the scan that passed last
  int32_t passed_bins = 0;
};

template <int D>
class OccupancyFilter : public FilterMap<D, PassedCell> {
 public:
  using Map = FilterMap<D, PassedCell>;
  using typename Map::Block;

  OccupancyFilter(double resolution, FilterOptions options)
      : Map(resolution, std::move(options)), tables_(filters_.options().lateral_std) {}

  OccupancyFilter(OccupancyFilter&&) noexcept = default;
  OccupancyFilter& operator=(OccupancyFilter&&) noexcept = default;
  OccupancyFilter(const OccupancyFilter&) = delete;  // copies of large maps would be accidental
  OccupancyFilter& operator=(const OccupancyFilter&) = delete;

  // Adds the beams of one scan. margin: (M,) cells before the end of each beam that it has not
  // passed. tag: of the scan, for `take_over`.
  void add(const Scans<D>& scans, const float* margin, int64_t time_bin, int32_t tag) {
    const int32_t bin = checked_bin(time_bin);
    for_each_hit(scans, [&](const BeamSegment<D>& beam, int64_t n) {
      record_pass(beam, margin[n], bin, tag);
    });
    for_each_hit(scans, [&](const BeamSegment<D>& beam, int64_t) { add_filter(beam.end, tag); });
    typename Map::ConstCursor cursor(*this);
    for_each_hit(scans, [&](const BeamSegment<D>& beam, int64_t) {
      this->for_each_filter_near(cursor, beam.end, [&](int32_t k) { filters_.hit(k, bin, tag); });
    });
  }

  // Initializes a cell from another map: occupied by static surface, or free.
  // log_ratio: nats by which dynamic classes fall behind.
  void prime(const Cell<D>& cell, bool is_occupied, double log_ratio) {
    PassedCell& at = this->cell_at_or_new(cell);
    if (!is_occupied) {
      at.passed_bins = std::max(at.passed_bins, CellFilters::kMaxPasses);
      return;
    }
    if (at.filter < 0) at.filter = add_filter(at, at.tag);
    filters_.favour_static(at.filter, log_ratio);
  }

  // Calls visit(cell, P(standing)) for the cells of a block that beams passed or ended in.
  template <class Visit>
  void for_each_known_in(const Block& block, float odds_factor, Visit&& visit) const {
    this->for_each_surface_in(block, odds_factor, visit);
    for (int i = 0; i < Map::kCells; ++i) {
      const PassedCell& cell = block.values[static_cast<size_t>(i)];
      if (cell.filter < 0 && cell.passed_bins > 0) visit(Map::cell_at(block.origin, i), 0.0f);
    }
  }

  // An empty filter of the same kind.
  OccupancyFilter sibling() const { return OccupancyFilter(resolution_, filters_.options()); }

  // Adds the cells of a part of the blocks of another filter, each moved by the motion (from the
  // old map to the new one) of the scan that observed it last. Cells that meet add their evidence.
  // Returns the number of the first block that is left.
  size_t take_over(const OccupancyFilter& from, const std::vector<Pose<D>>& motion, size_t first,
                   size_t count) {
    const size_t last =
        std::min(first + std::min(count, from.blocks().size()), from.blocks().size());
    for (size_t b = first; b < last; ++b) {
      const Block& block = *from.blocks()[b];
      for (int i = 0; i < Map::kCells; ++i)
        take_over_cell(from, block.values[static_cast<size_t>(i)], Map::cell_at(block.origin, i),
                       motion);
    }
    return last;
  }

 private:
  using Map::filters_, Map::resolution_;

  static constexpr float kMinReliability = 0.05f;
  static constexpr float kClearlyPassed = 0.5f;  // reliability of passes before the first hit

  template <class Visit>
  void for_each_hit(const Scans<D>& scans, Visit&& visit) const {
    for_each_beam<D>(scans, 0, scans.n_scans, [&](size_t, int64_t n, const Pose<D>& pose) {
      if (scans.hit[n]) visit(BeamSegment<D>(pose, scans.points + n * D, resolution_), n);
    });
  }

  void record_pass(const BeamSegment<D>& beam, float margin, int32_t bin, int32_t tag) {
    const Vec<D> chord = beam.end - beam.start;
    const double length = chord.norm(), usable = length - static_cast<double>(margin);
    if (!(usable > 0.0)) return;
    const Vec<D> direction = chord / length;
    const Vec<D> to_centre = Vec<D>::Constant(0.5) - beam.start;
    const auto pass = [&](PassedCell* cell, const Cell<D>& at) {
      if (cell->tag == tag && is_settled(*cell, bin)) return;
      const Vec<D> off = at.template cast<double>() + to_centre;
      double squared;  // of the distance of the beam from the centre
      if constexpr (D == 2) {
        const double distance = off[0] * direction[1] - off[1] * direction[0];
        squared = distance * distance;
      } else {
        const double along = off.dot(direction);
        squared = std::max(off.squaredNorm() - along * along, 0.0);
      }
      const auto reliability = tables_.isotropic(static_cast<float>(squared));
      if (reliability < kMinReliability) return;
      if (cell->filter >= 0) {
        filters_.miss(cell->filter, bin, reliability);
      } else if (reliability >= kClearlyPassed && cell->last_bin < bin) {
        ++cell->passed_bins;
        cell->last_bin = bin;
      }
      cell->tag = tag;
    };
    BlockCursor<OccupancyFilter> cursor(*this);
    RayWalker<OccupancyFilter, decltype(pass)> walker(cursor, pass);
    const Vec<D> last = beam.start + usable * direction;
    traverse<D>(beam.start, last, walker);
    walker.visit(0.0);
  }

  // Whether another pass in a bin changes nothing but the tag: most beams of a fast sensor pass
  // where others did just before.
  bool is_settled(const PassedCell& cell, int32_t bin) const {
    return cell.filter >= 0 ? filters_.is_settled(cell.filter, bin) : cell.last_bin >= bin;
  }

  // The filter of the cell in which a beam ended.
  void add_filter(const Vec<D>& end, int32_t tag) {
    PassedCell& at = this->cell_at_or_new(cell_of<D>(end));
    if (at.filter < 0) at.filter = add_filter(at, tag);
    at.tag = tag;
  }

  int32_t add_filter(const PassedCell& at, int32_t tag) {
    std::array<float, CellFilters::kMaxPasses> passes;
    passes.fill(kClearlyPassed);
    return filters_.add(passes.data(), std::min(at.passed_bins, CellFilters::kMaxPasses),
                        at.last_bin, tag);
  }

  void take_over_cell(const OccupancyFilter& from, const PassedCell& source, const Cell<D>& cell,
                      const std::vector<Pose<D>>& motion) {
    const bool has_filter = source.filter >= 0;
    if (!has_filter && source.passed_bins == 0) return;
    const int32_t tag = has_filter ? from.filters_.tag(source.filter) : source.tag;
    PassedCell& at = this->cell_at_or_new(this->move_cell(cell, tag, motion));
    at.last_bin = std::max(at.last_bin, source.last_bin);
    at.passed_bins = std::max(at.passed_bins, source.passed_bins);
    at.tag = std::max(at.tag, source.tag);
    if (has_filter) this->take_over_filter(at, from.filters_, source.filter);
  }

  friend class BlockCursor<OccupancyFilter>;

  IntersectionTables tables_;
};

}  // namespace stillmap
