// Surfel map: one surfel per cell with returns, which has the mean of its end points, the normal of
// the surface around it and the standard deviation of end points across surfaces.
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <deque>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/cell_index.hpp"
#include "stillmap/grid/occupancy_grid.hpp"
#include "stillmap/grid/ray_walker.hpp"
#include "stillmap/grid/scans.hpp"
#include "stillmap/grid/window_query.hpp"
#include "stillmap/occupancy/surfel.hpp"
#include "stillmap/util/lie.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

constexpr int32_t kNoSurfel = CellIndex<2>::kNone;

template <int D>
class SurfelMap : public SurfaceIndex<D> {
 public:
  // In 3D objects stand on surfaces, above all on the ground, so end points off a plane belong to
  // another object. In 2D objects stand neighbour walls, and end points off a wall are mostly the
  // wall under pose error.
  static constexpr bool kObjectsStandOnSurfaces = D == 3;
  static constexpr double kOffPlaneSigmas = 2.0;  // of plane noise, for the mean of a cell
  static constexpr double kEndPointSigmas = 3.0;  // of noise_std, for a single end point
  static constexpr double kMinOffPlane = 0.2;     // cells: closer points are on the plane
  static constexpr double kMaxFaceOffset = 1.0;   // cells, of a cell of a face from its plane
  static constexpr double kMaxStray = 0.1;        // share of the beams that are of neither face
  static constexpr double kMinSpanShare = 0.5;    // mean hit span of a cell over that of the face

  using Index = SurfaceIndex<D>;
  using Block = typename Index::Block;

  explicit SurfelMap(double resolution) : resolution_(resolution) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
  }
  SurfelMap(const SurfelMap&) = delete;
  SurfelMap& operator=(const SurfelMap&) = delete;

  double resolution() const { return resolution_; }
  size_t size() const { return fitted_ ? cells_.size() : sums_.size(); }
  // Standard deviation of end points across surfaces, in cells; 0 before fit.
  double noise_std() const { return noise_std_; }
  const Surfel<D>& surfel(int32_t k) const { return surfels_[static_cast<size_t>(k)]; }
  int64_t beam_count(int32_t k) const { return beam_counts_[static_cast<size_t>(k)]; }
  const Cell<D>& cell(int32_t k) const { return cells_[static_cast<size_t>(k)]; }
  // First and last return of each cell; empty without time bins.
  const std::vector<TimeSpan>& hit_spans() const { return hit_spans_; }

  // Adds the end points of all returns, and their time bins (T,) if given.
  void add(const Scans<D>& scans, const int64_t* time_bin = nullptr, int threads = 1) {
    if (fitted_)
      throw std::invalid_argument("surfel_map: already fitted, takes no more end points");
    if (sums_.empty()) has_time_bins_ = time_bin != nullptr;
    if (has_time_bins_ != (time_bin != nullptr))
      throw std::invalid_argument("time_bin: expected in all calls, or in none");
    const std::vector<size_t> bounds = split_by_beams(scans.offset, scans.n_scans, threads);
    std::deque<SurfelMap> thread_maps;
    for (size_t i = 2; i < bounds.size(); ++i) thread_maps.emplace_back(resolution_);
    parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
      (i == 0 ? *this : thread_maps[i - 1]).add_range(scans, time_bin, first, last);
    });
    // sums are merged in the order in which a single thread would have met the cells
    for (const SurfelMap& thread_map : thread_maps)
      for (const EndPointSums<D>& sums : thread_map.sums_) sums_at(sums.cell).add(sums);
  }

  // Surfel of a cell, or kNoSurfel.
  int32_t surfel_at(BlockCursor<const SurfelMap<D>>& cursor, const Cell<D>& cell) const {
    const Block* block = cursor.block(cell);
    return block ? block->values[static_cast<size_t>(this->local_of(cell))] : kNoSurfel;
  }

  // Surfel that an end point is associated with: that of its cell or, where the point lies off that
  // plane, the nearest neighbouring one whose plane it fits.
  int32_t associate(BlockCursor<const SurfelMap<D>>& cursor, const Vec<D>& end) const {
    const Cell<D> cell = cell_of<D>(end);
    const int32_t own = surfel_at(cursor, cell);
    if (!kObjectsStandOnSurfaces || own == kNoSurfel || !is_off_plane(own, end)) return own;
    int32_t nearest = own;
    double min_distance = std::numeric_limits<double>::infinity();
    for_each_in_cube<D>(cell, 1, [&](const Cell<D>& neighbour) {
      const int32_t k = surfel_at(cursor, neighbour);
      if (k == kNoSurfel || is_off_plane(k, end)) return;
      const double distance = (surfel(k).mean - end).squaredNorm();
      if (distance < min_distance) min_distance = distance, nearest = k;
    });
    return nearest;
  }

  // Fits means, normals and noise_std to all end points; further calls have no effect.
  void fit(int threads = 1) {
    if (fitted_) return;
    renumber_by_tile();
    surfels_.assign(size(), {});
    for (size_t k = 0; k < size(); ++k) surfels_[k].mean = mean_of(sums_[k]);
    // noise as large as the window hides every wall: enlarge the window
    const RowMasks<D> masks(*this);
    for (const int radius : {2, 4, 6}) {
      const bool are_planar = fit_normals(radius, masks, threads) >= 0.5;
      if constexpr (EndPointSums<D>::kHasFaces)
        if (are_planar && 2.0 * noise_std_ <= kMaxFaceOffset) fit_faces(radius, masks, threads);
      if (are_planar) break;
    }
    cells_.reserve(size());
    beam_counts_.reserve(size());
    if (has_time_bins_) hit_spans_.reserve(size());
    for (const EndPointSums<D>& sums : sums_) {
      cells_.push_back(sums.cell);
      beam_counts_.push_back(sums.count);
      if (has_time_bins_) hit_spans_.push_back(sums.hit_span);
    }
    std::vector<EndPointSums<D>>().swap(sums_);  // frees the memory
    fitted_ = true;
  }
  bool fitted() const { return fitted_; }

 private:
  bool is_off_plane(int32_t k, const Vec<D>& end) const {
    const Surfel<D>& e = surfel(k);
    return std::abs(e.normal.dot(end - e.centre)) > kEndPointSigmas * noise_std_ + kMinOffPlane;
  }

  // Numbers surfels tile by tile, so that surfels along a ray are close together in memory.
  void renumber_by_tile() {
    std::vector<EndPointSums<D>> sorted;
    sorted.reserve(sums_.size());
    const std::vector<size_t> order = tile_order();
    for (const auto& block : this->blocks())
      for (const size_t local : order) {
        const int32_t k = std::as_const(block->values)[local];
        if (k == kNoSurfel) continue;
        block->values[local] = static_cast<int32_t>(sorted.size());
        sorted.push_back(sums_[static_cast<size_t>(k)]);
      }
    sums_.swap(sorted);
  }

  // Local indices of the cells of a block, ordered by tiles of 4 cells a side.
  static std::vector<size_t> tile_order() {
    constexpr int tile = 4;
    std::vector<std::pair<int64_t, size_t>> keyed;
    for (size_t local = 0; local < static_cast<size_t>(Index::kCells); ++local) {
      int64_t outer = 0, inner = 0;
      for (int d = D - 1; d >= 0; --d) {
        const auto coordinate = static_cast<int>((local >> (d * Index::kShift)) &
                                                 static_cast<size_t>(Index::kEdge - 1));
        outer = outer * Index::kEdge + coordinate / tile;
        inner = inner * tile + coordinate % tile;
      }
      keyed.emplace_back(outer * 64 + inner, local);
    }
    std::sort(keyed.begin(), keyed.end());
    std::vector<size_t> order;
    for (const auto& entry : keyed) order.push_back(entry.second);
    return order;
  }

  void add_range(const Scans<D>& scans, const int64_t* time_bin, size_t first, size_t last) {
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n]) return;
      const Vec<D> end = beam_end<D>(pose, scans.points + n * D, resolution_);
      EndPointSums<D>& sums = sums_at(cell_of<D>(end));
      sums.add(end, pose.t / resolution_);
      if (time_bin) sums.hit_span.extend(time_bin[t]);
    });
  }

  // Sums of a cell, new if it has none.
  EndPointSums<D>& sums_at(const Cell<D>& cell) {
    int32_t& index = this->index_of(cell);
    if (index == kNoSurfel) {
      index = static_cast<int32_t>(sums_.size());
      sums_.emplace_back();
      sums_.back().cell = cell;
    }
    return sums_[static_cast<size_t>(index)];
  }

  static Vec<D> mean_of(const EndPointSums<D>& s) {
    Vec<D> mean;
    for (int d = 0; d < D; ++d)
      mean[d] =
          s.cell[d] + from_fixed(s.first[static_cast<size_t>(d)]) / static_cast<double>(s.count);
    return mean;
  }

  // Fits planes to the end points within `radius` cells of each surfel by principal component
  // analysis; returns the share of beams on planes.
  double fit_normals(int radius, const RowMasks<D>& masks, int threads) {
    const std::vector<size_t> bounds = split_evenly(size(), threads);
    std::vector<NormalFit> partial(bounds.size() - 1);
    parallel_for_ranges(bounds, [&](size_t i, size_t first, size_t last) {
      partial[i] = fit_normals(radius, masks, first, last);
    });
    NormalFit& total = partial.front();
    for (size_t i = 1; i < partial.size(); ++i) {
      total.n_beams += partial[i].n_beams;
      total.n_planar += partial[i].n_planar;
      total.deviations.insert(total.deviations.end(), partial[i].deviations.begin(),
                              partial[i].deviations.end());
    }
    noise_std_ = weighted_median(total.deviations);
    return total.n_beams ? static_cast<double>(total.n_planar) / static_cast<double>(total.n_beams)
                         : 1.0;
  }

  // Beams in total and on planes; smallest standard deviation and beam count of each plane.
  struct NormalFit {
    int64_t n_beams = 0, n_planar = 0;
    std::vector<std::pair<double, int64_t>> deviations;
  };

  NormalFit fit_normals(int radius, const RowMasks<D>& masks, size_t first_surfel,
                        size_t last_surfel) {
    NormalFit fit_result;
    WindowQuery<D> query(*this, masks);
    const CellRows<D> window = window_rows<D>(radius, true);
    for (size_t k = first_surfel; k < last_surfel; ++k) {
      const WindowMoments<D> moments = moments_around(k, query, window);
      Surfel<D>& surfel = surfels_[k];
      surfel.normal.setZero();
      surfel.centre_to_plane = 0.0;
      surfel.centre = surfel.mean;
      surfel.half_extent = 0.5;
      surfel.prominence = static_cast<double>(sums_[k].count) / moments.max_count;
      fit_result.n_beams += sums_[k].count;
      const PrincipalAxes<D> axes(moments, radius);
      if (!axes.is_flat) continue;
      // feet and wheels are not part of the ground below them
      const double distance = std::abs(axes.normal.dot(surfel.mean - centre_of(moments, k)));
      if (kObjectsStandOnSurfaces && distance > kMinOffPlane &&
          distance * distance > kOffPlaneSigmas * kOffPlaneSigmas * axes.variance[0])
        continue;
      fit_result.n_planar += sums_[k].count;
      fit_result.deviations.emplace_back(std::sqrt(axes.variance[0]), sums_[k].count);
      set_plane(k, moments, axes);
    }
    return fit_result;
  }

  // Fits planes to the faces of walls that are so thin that both of them lie in one window. They
  // are seen from opposite sides, or each of their cells is hit for much of the time for which the
  // face is: the feet of people who walk along a line hit one cell after the other.
  void fit_faces(int radius, const RowMasks<D>& masks, int threads) {
    parallel_for_ranges(split_evenly(size(), threads), [&](size_t, size_t first, size_t last) {
      WindowQuery<D> query(*this, masks);
      const CellRows<D> window = window_rows<D>(radius, true);
      for (size_t k = first; k < last; ++k) {
        if (!surfels_[k].normal.isZero(0.0)) continue;
        const PrincipalAxes<D> both(moments_around(k, query, window), radius);
        if (!both.is_extended) continue;
        const auto [own, other, strays] = split_faces(k, both.normal, query, window);
        const PrincipalAxes<D> axes(own, radius);
        if (axes.is_flat && other.count > 0.0 && PrincipalAxes<D>(other, radius).is_flat &&
            strays.count <= kMaxStray * (own.count + other.count + strays.count) &&
            (own.view.dot(axes.normal) * other.view.dot(axes.normal) < 0.0 ||
             std::min(own.mean_span_share(), other.mean_span_share()) >= kMinSpanShare))
          set_plane(k, own, axes);
      }
    });
  }

  // The face that a cell is on, the one with most beams to either side of it, and what is left.
  std::array<WindowMoments<D>, 3> split_faces(size_t k, const Vec<D>& normal, WindowQuery<D>& query,
                                              const CellRows<D>& window) const {
    std::array<WindowMoments<D>, 3> faces;
    query.for_each(sums_[k].cell, window, [&](int32_t neighbour) {
      const auto n = static_cast<size_t>(neighbour);
      const double offset = normal.dot(surfels_[n].mean - surfels_[k].mean);
      const size_t side = std::abs(offset) <= kMaxFaceOffset ? 0 : offset > 0.0 ? 1 : 2;
      faces[side].add(sums_[n], sums_[k].cell);
    });
    if (faces[2].count > faces[1].count) std::swap(faces[1], faces[2]);
    return faces;
  }

  WindowMoments<D> moments_around(size_t k, WindowQuery<D>& query,
                                  const CellRows<D>& window) const {
    WindowMoments<D> moments;
    query.for_each(sums_[k].cell, window, [&](int32_t neighbour) {
      moments.add(sums_[static_cast<size_t>(neighbour)], sums_[k].cell);
    });
    return moments;
  }

  Vec<D> centre_of(const WindowMoments<D>& moments, size_t k) const {
    return sums_[k].cell.template cast<double>() + moments.mean();
  }

  void set_plane(size_t k, const WindowMoments<D>& moments, const PrincipalAxes<D>& axes) {
    Surfel<D>& surfel = surfels_[k];
    surfel.normal = axes.normal;
    surfel.centre = centre_of(moments, k);
    // uniformly spread points reach sqrt(3) standard deviations; take the inner half
    surfel.half_extent = 0.5 * std::sqrt(3.0 * axes.variance[1]);
    const Vec<D> centre = Vec<D>::Constant(0.5);  // from the cell's corner
    surfel.centre_to_plane = surfel.normal.dot(centre - moments.mean());
  }

  static double weighted_median(std::vector<std::pair<double, int64_t>>& values) {
    int64_t total = 0;
    for (const auto& v : values) total += v.second;
    std::sort(values.begin(), values.end());
    int64_t so_far = 0;
    for (const auto& v : values)
      if (2 * (so_far += v.second) >= total) return v.first;
    return 0.0;
  }

  double resolution_;
  double noise_std_ = 0.0;
  bool fitted_ = false;
  bool has_time_bins_ = false;
  std::vector<EndPointSums<D>> sums_;  // cleared by fit
  std::vector<Surfel<D>> surfels_;
  std::vector<Cell<D>> cells_;
  std::vector<int64_t> beam_counts_;
  std::vector<TimeSpan> hit_spans_;  // empty without time bins
};

}  // namespace stillmap
