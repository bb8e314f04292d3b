// Causal E-step in 3D: cells with forward filters are looked up in the range image of each sweep.
// A sweep sees every cell around it, so this is cheaper than to follow its beams, and more
// complete.
#pragma once

#include <Eigen/Core>
#include <algorithm>
#include <array>
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

namespace stillmap {

struct SurfaceCell {
  int32_t filter = -1;  // index of the cell's filter; -1: no beam ended here
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
  void add(const Scans<3>& sweep, PixelSize pixel, int64_t time_bin, int32_t tag) {
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
    miss_cells(view);
    record_hits(ends, bin, tag);
    // the first sweep of each bin stands for it
    if (views_.empty() || views_.back().bin < bin) views_.push_back(view);
    if (views_.size() > CellFilters::kMaxPasses) views_.pop_front();
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
  float visibility(const View& view, const Vec<3>& centre) const {
    const auto cell = static_cast<float>(resolution_);
    const RangeImage::Point p = view.to_sensor(centre);
    const float distance = p.norm();
    if (distance + kMargin * cell >= view.image->free_range(p)) return 0.0f;
    const PixelSize pixel = view.image->pixel();
    return kReliability * std::min(1.0f, kExtent * cell / (distance * pixel.azimuth)) *
           std::min(1.0f, kExtent * cell / (distance * pixel.elevation));
  }

  void miss_cells(const View& view) {
    const double reach = static_cast<double>(view.image->longest()) + resolution_ * kEdge;
    for (const auto& block : blocks()) {
      const Vec<3> middle =
          (block->origin.template cast<double>().array() + 0.5).matrix() * (resolution_ * kEdge);
      if ((middle - view.T_map_sensor.t).squaredNorm() > reach * reach) continue;
      bool is_changed = false;
      for (int i = 0; i < kCells; ++i) {
        const int32_t k = block->values[static_cast<size_t>(i)].filter;
        if (k < 0) continue;
        const float reliability = visibility(view, centre_of(cell_at(block->origin, i)));
        if (reliability < kMinReliability) continue;
        filters_.miss(k, view.bin, reliability);
        is_changed = true;
      }
      if (is_changed) note_changed(block->origin);
    }
  }

  void record_hits(const std::vector<Vec<3>>& ends, int32_t bin, int32_t tag) {
    std::vector<Vec<3>> first;  // of each cell
    hit_.assign(filters_.size(), false);
    for (const Vec<3>& end : ends) {
      const Cell<3> cell = cell_of<3>(end);
      SurfaceCell& at = cell_at_or_new(cell);
      if (at.filter < 0) {
        at.filter = add_filter(cell, tag);
        hit_.push_back(false);
      }
      if (hit_[static_cast<size_t>(at.filter)]) continue;
      hit_[static_cast<size_t>(at.filter)] = true;
      first.push_back(end);
    }
    ConstCursor cursor(*this);
    for (const Vec<3>& end : first)
      for_each_filter_near(cursor, end, [&](int32_t k) { filters_.hit(k, bin, tag); });
  }

  // A filter after the views of the last time bins, in which its cell was free.
  int32_t add_filter(const Cell<3>& cell, int32_t tag) {
    const Vec<3> centre = centre_of(cell);
    std::array<float, CellFilters::kMaxPasses> passes;
    int count = 0;
    int32_t last_bin = -1;
    for (const View& view : views_) {
      const float reliability = visibility(view, centre);
      if (reliability < kMinReliability) continue;
      passes[static_cast<size_t>(count++)] = reliability;
      last_bin = view.bin;
    }
    return filters_.add(passes.data(), count, last_bin, tag);
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

  std::deque<View> views_;  // one for each of the last time bins
  std::vector<bool> hit_;   // (filters,), in the sweep that is being added
};

}  // namespace stillmap
