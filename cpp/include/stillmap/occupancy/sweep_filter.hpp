// Causal E-step in 3D: cells with forward filters are looked up in the range image of each sweep.
// A sweep sees every cell around it, so this is cheaper than to follow its beams, and more
// complete.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstddef>
#include <cstdint>
#include <deque>
#include <memory>
#include <utility>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/range_image.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/occupancy/filter_map.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

struct SurfaceCell {
  static constexpr int32_t kNone = -1, kKnownFree = -2;
  int32_t filter = kNone;  // index of the cell's filter; negative: no beam ended here
};

class SweepFilter : public FilterMap<3, SurfaceCell> {
 public:
  using Base = FilterMap<3, SurfaceCell>;

  SweepFilter(double resolution, FilterOptions options) : Base(resolution, std::move(options)) {}

  SweepFilter(SweepFilter&&) noexcept = default;
  SweepFilter& operator=(SweepFilter&&) noexcept = default;
  SweepFilter(const SweepFilter&) = delete;  // copies of large maps would be accidental
  SweepFilter& operator=(const SweepFilter&) = delete;

  // Adds the hits of one sweep. pixel: of its range image. tag: of the sweep, for `take_over`.
  // The result does not depend on the threads.
  void add(const Scans<3>& sweep, PixelSize pixel, int64_t time_bin, int32_t tag, int threads) {
    const int32_t bin = checked_bin(time_bin);
    const Pose<3> T = pose_from<3>(sweep.poses);
    std::vector<RangeImage::Point> points;
    std::vector<Vec<3>> ends;  // in cells
    for_each_beam<3>(sweep, 0, 1, [&](size_t, int64_t n, const Pose<3>& pose) {
      if (!sweep.hit[n]) return;
      points.push_back(Eigen::Map<const RangeImage::Point>(sweep.points + n * 3));
      ends.push_back(BeamSegment<3>(pose, sweep.points + n * 3, resolution_).end);
    });
    const auto image = std::make_shared<const RangeImage>(points, pixel);
    const View view{T, image, bin, tag};
    miss_cells(view, threads);
    record_hits(ends, bin, tag, threads);
    // the first sweep of each bin stands for it
    if (views_.empty() || views_.back().bin < bin) views_.push_back(view);
    if (views_.size() > CellFilters::kMaxPasses) views_.pop_front();
  }

  // As of OccupancyFilter.
  void prime(const Cell<3>& cell, bool is_occupied, double log_ratio) {
    SurfaceCell& at = cell_at_or_new(cell);
    if (!is_occupied) {
      if (at.filter < 0) at.filter = SurfaceCell::kKnownFree;
      return;
    }
    if (at.filter < 0) at.filter = filters_.add(nullptr, 0, -1, 0);
    filters_.favour_static(at.filter, log_ratio);
  }

  // Calls visit(cell, P(standing)) for the cells of a block in which beams ended.
  template <class Visit>
  void for_each_known_in(const Block& block, float odds_factor, Visit&& visit) const {
    for_each_surface_in(block, odds_factor, visit);
  }

  // An empty filter of the same kind.
  SweepFilter sibling() const { return SweepFilter(resolution_, filters_.options()); }

  // As of OccupancyFilter. The views move with the first part.
  size_t take_over(const SweepFilter& from, const std::vector<Pose<3>>& motion, size_t first,
                   size_t count) {
    if (first == 0) take_over_views(from, motion);
    const size_t last =
        std::min(first + std::min(count, from.blocks().size()), from.blocks().size());
    for (size_t b = first; b < last; ++b) {
      const Block& block = *from.blocks()[b];
      for (int i = 0; i < kCells; ++i) {
        const int32_t k = block.values[static_cast<size_t>(i)].filter;
        if (k < 0) continue;
        const Cell<3> to = move_cell(cell_at(block.origin, i), from.filters_.tag(k), motion);
        take_over_filter(cell_at_or_new(to), from.filters_, k);
      }
    }
    return last;
  }

 private:
  static constexpr float kReliability = 0.9f;  // of a miss where surface fills its pixel
  static constexpr float kExtent = 1.4f;       // cells that the surface around a cell has at least
  static constexpr float kMinReliability = 0.1f;  // of a miss that counts
  static constexpr float kMargin = 1.5f;          // cells before the end that are not free
  static constexpr size_t kMinBlocks = 64, kMinFilters = 256;  // fewer do not pay for a thread

  // What a sweep saw from where.
  struct View {
    Pose<3> T_map_sensor;
    std::shared_ptr<const RangeImage> image;
    int32_t bin, tag;

    RangeImage::Point to_sensor(const Vec<3>& metres) const {
      return (T_map_sensor.R.transpose() * (metres - T_map_sensor.t)).cast<float>();
    }
  };

  Vec<3> centre_of(const Cell<3>& cell) const {
    return (cell.cast<double>().array() + 0.5).matrix() * resolution_;
  }

  // P(the beams of a view met the surface of a cell if it stood there); 0: they ended before it.
  float visibility(const View& view, float distance, float free_range) const {
    const auto cell = static_cast<float>(resolution_);
    if (distance + kMargin * cell >= free_range) return 0.0f;
    const PixelSize pixel = view.image->pixel();
    return kReliability * std::min(1.0f, kExtent * cell / (distance * pixel.azimuth)) *
           std::min(1.0f, kExtent * cell / (distance * pixel.elevation));
  }

  void miss_cells(const View& view, int threads) {
    std::vector<Block*> near;
    const double reach = static_cast<double>(view.image->longest()) + resolution_ * kEdge;
    for (const auto& block : blocks()) {
      const Vec<3> middle =
          (block->origin.template cast<double>().array() + 0.5).matrix() * (resolution_ * kEdge);
      if ((middle - view.T_map_sensor.t).squaredNorm() <= reach * reach)
        near.push_back(block.get());
    }
    std::vector<char> is_changed(near.size());
    const auto bounds = split_evenly(near.size(), threads, kMinBlocks);
    parallel_for_ranges(bounds, [&](size_t, size_t first, size_t last) {
      for (size_t b = first; b < last; ++b) is_changed[b] = miss_block(view, *near[b]);
    });
    for (size_t b = 0; b < near.size(); ++b)
      if (is_changed[b]) note_changed(near[b]->origin);
  }

  // Whether the view saw any of the cells of a block.
  bool miss_block(const View& view, const Block& block) {
    const SurfaceCells cells = find_cells(view, block);
    if (cells.count == 0) return false;
    std::array<float, kCells> free_range;
    view.image->free_ranges(cells.x.data(), cells.y.data(), cells.z.data(), cells.count,
                            free_range.data());
    bool is_seen = false;
    for (size_t n = 0; n < cells.count; ++n) {
      const float reliability = visibility(view, cells.distance(n), free_range[n]);
      if (reliability < kMinReliability) continue;
      is_seen = true;
      filters_.miss(cells.filter[n], view.bin, reliability);
    }
    return is_seen;
  }

  // The cells of a block that have filters, with their centres in the frame of the sensor.
  struct SurfaceCells {
    size_t count = 0;
    std::array<int32_t, kCells> filter;
    std::array<float, kCells> x, y, z;

    float distance(size_t n) const { return std::sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n]); }
  };

  SurfaceCells find_cells(const View& view, const Block& block) const {
    SurfaceCells out;
    const RangeImage::Point first = view.to_sensor(centre_of(cell_at(block.origin, 0)));
    const Eigen::Matrix3f steps =
        (view.T_map_sensor.R.transpose() * resolution_).template cast<float>();
    for (int row = 0; row < kCells; row += kEdge) {
      const SurfaceCell* cells = &block.values[static_cast<size_t>(row)];
      int32_t all = -1;
      for (int k = 0; k < kEdge; ++k) all &= cells[k].filter;
      if (all < 0) continue;  // each is: most rows have no filter
      for (int k = 0; k < kEdge; ++k) {
        if (cells[k].filter < 0) continue;
        const Cell<3> offset = cell_at(Cell<3>::Zero(), row + k);
        const RangeImage::Point p = first + steps * offset.cast<float>();
        out.filter[out.count] = cells[k].filter;
        out.x[out.count] = p.x();
        out.y[out.count] = p.y();
        out.z[out.count++] = p.z();
      }
    }
    return out;
  }

  void record_hits(const std::vector<Vec<3>>& ends, int32_t bin, int32_t tag, int threads) {
    std::vector<Vec<3>> first;  // of each cell
    std::vector<NewFilter> added;
    is_noted_.assign(filters_.size(), false);
    for (const Vec<3>& end : ends) {
      const Cell<3> cell = cell_of<3>(end);
      SurfaceCell& at = cell_at_or_new(cell);
      if (at.filter < 0) {
        const bool is_free = at.filter == SurfaceCell::kKnownFree;
        added.push_back({filters_.make_index(), centre_of(cell), is_free});
        at.filter = added.back().filter;
        is_noted_.resize(filters_.size(), false);
      }
      if (note(at.filter)) first.push_back(end);
    }
    parallel_for_ranges(
        split_evenly(added.size(), threads, kMinFilters), [&](size_t, size_t from, size_t to) {
          for (; from < to; from += RangeImage::kBatch)
            initialize(added.data() + from, std::min(to - from, RangeImage::kBatch), tag);
        });
    const std::vector<int32_t> hits = filters_near(first);
    parallel_for_ranges(split_evenly(hits.size(), threads), [&](size_t, size_t from, size_t to) {
      for (; from < to; ++from) {
        filters_.hit(hits[from], bin, tag);
        filters_.p_static(hits[from]);  // which the labels of the sweep ask for
      }
    });
  }

  // Whether a filter is noted for the first time.
  bool note(int32_t k) {
    const auto at = static_cast<size_t>(k);
    if (is_noted_[at]) return false;
    is_noted_[at] = true;
    return true;
  }

  // The filters that end points hit, each once.
  std::vector<int32_t> filters_near(const std::vector<Vec<3>>& ends) {
    std::vector<int32_t> out;
    is_noted_.assign(filters_.size(), false);
    ConstCursor cursor(*this);
    for (const Vec<3>& end : ends)
      for_each_filter_near(cursor, end, [&](int32_t k) {
        if (note(k)) out.push_back(k);
      });
    return out;
  }

  struct NewFilter {
    int32_t filter;
    Vec<3> centre;  // metres, of its cell
    bool is_free;   // another map says so
  };

  // Initializes filters, at most RangeImage::kBatch, after the views of the last time bins, in
  // which their cells were free, or as free as can be.
  void initialize(const NewFilter* added, size_t count, int32_t tag) {
    std::vector<std::array<float, CellFilters::kMaxPasses>> passes(count);
    std::vector<int> pass_count(count, 0);
    std::vector<int32_t> last_bin(count, -1);
    std::array<float, RangeImage::kBatch> x, y, z, free_range;
    for (size_t n = 0; n < count; ++n) {
      passes[n].fill(kReliability);
      if (added[n].is_free) pass_count[n] = CellFilters::kMaxPasses;
    }
    for (const View& view : views_) {
      for (size_t n = 0; n < count; ++n) {
        const RangeImage::Point p = view.to_sensor(added[n].centre);
        x[n] = p.x(), y[n] = p.y(), z[n] = p.z();
      }
      view.image->free_ranges(x.data(), y.data(), z.data(), count, free_range.data());
      for (size_t n = 0; n < count; ++n) {
        const float distance = std::sqrt(x[n] * x[n] + y[n] * y[n] + z[n] * z[n]);
        const float reliability = visibility(view, distance, free_range[n]);
        if (reliability < kMinReliability || added[n].is_free) continue;
        passes[n][static_cast<size_t>(pass_count[n]++)] = reliability;
        last_bin[n] = view.bin;
      }
    }
    for (size_t n = 0; n < count; ++n)
      filters_.initialize(added[n].filter, passes[n].data(), pass_count[n], last_bin[n], tag);
  }

  void take_over_views(const SweepFilter& from, const std::vector<Pose<3>>& motion) {
    for (View view : from.views_) {
      if (static_cast<size_t>(view.tag) < motion.size()) {
        const Pose<3>& T = motion[static_cast<size_t>(view.tag)];
        view.T_map_sensor = {T.R * view.T_map_sensor.R, T * view.T_map_sensor.t};
      }
      views_.push_back(view);
    }
    while (views_.size() > CellFilters::kMaxPasses) views_.pop_front();
  }

  std::deque<View> views_;      // one for each of the last time bins
  std::vector<bool> is_noted_;  // (filters,), see `note`
};

}  // namespace stillmap
