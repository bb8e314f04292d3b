// Where beams ended: one element of surface per cell, with the mean of its end points, the normal
// of the surface around it, and how far end points scatter across surfaces.
#pragma once

#include <Eigen/Eigenvalues>
#include <algorithm>
#include <array>
#include <cmath>
#include <deque>
#include <limits>
#include <stdexcept>
#include <utility>
#include <vector>

#include "stillmap/grid/cell_index.hpp"
#include "stillmap/grid/window_query.hpp"
#include "stillmap/occupancy/beam_counting.hpp"
#include "stillmap/occupancy/surfel.hpp"

namespace stillmap {

constexpr int32_t kNoElement = CellIndex<2>::kNone;

template <int D>
class Surface : public CellIndex<D> {
 public:
  // In space things stand on surfaces, on the ground most of all; in a plane they stand beside
  // them, and what lies off a wall is most often the wall, seen from a pose that is off.
  static constexpr bool kStandsOn = D == 3;
  static constexpr double kOff = 2.0;     // standard deviations by which a cell is off a surface
  static constexpr double kOffEnd = 3.0;  // scatters by which a single end point is
  static constexpr double kNear = 0.2;    // cells; nearer is on it, however smooth it is

  using Block = typename CellIndex<D>::Block;

  explicit Surface(double resolution) : resolution_(resolution) {
    if (!(resolution > 0.0) || !std::isfinite(resolution))
      throw std::invalid_argument("resolution: expected a positive length in metres");
  }
  Surface(const Surface&) = delete;
  Surface& operator=(const Surface&) = delete;

  double resolution() const { return resolution_; }
  size_t size() const { return fitted_ ? cells_.size() : sums_.size(); }
  // standard deviation of end points across surfaces, in cells
  double scatter() const { return scatter_; }
  const Element<D>& element(int32_t k) const { return elements_[static_cast<size_t>(k)]; }
  int64_t beams(int32_t k) const { return beams_[static_cast<size_t>(k)]; }
  const Cell<D>& cell(int32_t k) const { return cells_[static_cast<size_t>(k)]; }
  // when beams ended in each cell, if looks were given
  const std::vector<Span>& hits() const { return hits_; }

  // Notes the end points of all beams that were hit, and the looks of their scans if given.
  void add(const Scans<D>& scans, const int64_t* look = nullptr, int threads = 1) {
    if (fitted_) throw std::invalid_argument("surface: was fitted, and takes no more end points");
    if (sums_.empty()) dated_ = look != nullptr;
    if (dated_ != (look != nullptr)) throw std::invalid_argument("look: of all scans, or of none");
    const std::vector<size_t> bounds = shares_of(scans.offset, scans.n_scans, threads);
    std::deque<Surface> others;
    for (size_t i = 2; i < bounds.size(); ++i) others.emplace_back(resolution_);
    parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
      (i == 0 ? *this : others[i - 1]).add_share(scans, look, first, last);
    });
    // blocks come in the order in which a single thread would have met them
    for (const Surface& other : others)
      for (const Sums<D>& sums : other.sums_) sums_of(sums.cell).add(sums);
  }

  // The element of a cell, or kNoElement.
  int32_t at(Cursor<const Surface<D>>& cursor, const Cell<D>& cell) const {
    const Block* block = cursor.block(cell);
    return block ? block->counts[static_cast<size_t>(this->local_of(cell))] : kNoElement;
  }

  // The element that an end point is of: that of its cell, or where it lies off the surface there,
  // the nearest one beside it that it does not lie off.
  int32_t owner(Cursor<const Surface<D>>& cursor, const Vec<D>& end) const {
    const Cell<D> cell = cell_of<D>(end);
    const int32_t own = at(cursor, cell);
    if (!kStandsOn || own == kNoElement || !lies_off(own, end)) return own;
    int32_t nearest = own;
    double least = std::numeric_limits<double>::infinity();
    for_each_near<D>(cell, 1, [&](const Cell<D>& beside) {
      const int32_t k = at(cursor, beside);
      if (k == kNoElement || lies_off(k, end)) return;
      const double apart = (element(k).mean - end).squaredNorm();
      if (apart < least) least = apart, nearest = k;
    });
    return nearest;
  }

  // Means, normals and scatter from all end points; a second time changes nothing.
  void fit(int threads = 1) {
    if (fitted_) return;
    number_by_place();
    elements_.assign(size(), {});
    for (size_t k = 0; k < size(); ++k) elements_[k].mean = mean_of(sums_[k]);
    // noise as large as the window would hide every wall: then a wider one
    for (const int radius : {2, 4, 6})
      if (fit_normals(radius, threads) >= 0.5) break;
    cells_.reserve(size());
    beams_.reserve(size());
    if (dated_) hits_.reserve(size());
    for (const Sums<D>& sums : sums_) {
      cells_.push_back(sums.cell);
      beams_.push_back(sums.count);
      if (dated_) hits_.push_back(sums.hit);
    }
    std::vector<Sums<D>>().swap(sums_);  // as large as all the rest
    fitted_ = true;
  }
  bool fitted() const { return fitted_; }

 private:
  bool lies_off(int32_t k, const Vec<D>& end) const {
    const Element<D>& e = element(k);
    return std::abs(e.normal.dot(end - e.centre)) > kOffEnd * scatter_ + kNear;
  }

  // Neighbours get neighbouring numbers, tile by tile, so that a beam in any direction finds them
  // close together in memory.
  void number_by_place() {
    std::vector<Sums<D>> sorted;
    sorted.reserve(sums_.size());
    const std::vector<size_t> order = by_tiles();
    for (const auto& block : this->blocks())
      for (const size_t local : order) {
        int32_t& k = block->counts[local];
        if (k == kNoElement) continue;
        sorted.push_back(sums_[static_cast<size_t>(k)]);
        k = static_cast<int32_t>(sorted.size() - 1);
      }
    sums_.swap(sorted);
  }

  // The cells of a block in the order of tiles of four cells a side.
  static std::vector<size_t> by_tiles() {
    constexpr int tile = 4;
    std::vector<std::pair<int64_t, size_t>> keyed;
    for (size_t local = 0; local < static_cast<size_t>(CellIndex<D>::kCells); ++local) {
      int64_t outer = 0, inner = 0;
      for (int d = D - 1; d >= 0; --d) {
        const auto at = static_cast<int>((local >> (d * CellIndex<D>::kShift)) &
                                         static_cast<size_t>(CellIndex<D>::kEdge - 1));
        outer = outer * CellIndex<D>::kEdge + at / tile;
        inner = inner * tile + at % tile;
      }
      keyed.emplace_back(outer * 64 + inner, local);
    }
    std::sort(keyed.begin(), keyed.end());
    std::vector<size_t> order;
    for (const auto& entry : keyed) order.push_back(entry.second);
    return order;
  }

  void add_share(const Scans<D>& scans, const int64_t* look, size_t first, size_t last) {
    for_each_beam<D>(scans, first, last, [&](size_t t, int64_t n, const Pose<D>& pose) {
      if (!scans.hit[n]) return;
      const Segment<D> beam(pose, scans.points + n * D, resolution_);
      Sums<D>& sums = sums_of(cell_of<D>(beam.end));
      sums.add(beam.end);
      if (look) sums.hit.widen(look[t]);
    });
  }

  // Those of a cell, of no end point at first.
  Sums<D>& sums_of(const Cell<D>& cell) {
    int32_t& at = this->place_of(cell);
    if (at == kNoElement) {
      at = static_cast<int32_t>(sums_.size());
      sums_.emplace_back();
      sums_.back().cell = cell;
    }
    return sums_[static_cast<size_t>(at)];
  }

  static Vec<D> mean_of(const Sums<D>& s) {
    Vec<D> mean;
    for (int d = 0; d < D; ++d)
      mean[d] =
          s.cell[d] + from_fixed(s.first[static_cast<size_t>(d)]) / static_cast<double>(s.count);
    return mean;
  }

  using Square = Eigen::Matrix<double, D, D>;

  // Principal axes of the end points within `radius` cells of each element; returns the share of
  // the beams that ended on surfaces.
  double fit_normals(int radius, int threads) {
    const std::vector<size_t> bounds = even_shares(size(), threads);
    std::vector<Fitted> shares(bounds.size() - 1);
    parallel_shares(bounds, [&](size_t i, size_t first, size_t last) {
      shares[i] = fit_normals(radius, first, last);
    });
    Fitted& total = shares.front();
    for (size_t i = 1; i < shares.size(); ++i) {
      total.all += shares[i].all;
      total.flat += shares[i].flat;
      total.across.insert(total.across.end(), shares[i].across.begin(), shares[i].across.end());
    }
    scatter_ = weighted_median(total.across);
    return total.all ? static_cast<double>(total.flat) / static_cast<double>(total.all) : 1.0;
  }

  // Beams in all and on surfaces; smallest deviation and weight of each of these.
  struct Fitted {
    int64_t all = 0, flat = 0;
    std::vector<std::pair<double, int64_t>> across;
  };

  Fitted fit_normals(int radius, size_t first_element, size_t last_element) {
    Fitted fitted;
    auto& [all, flat, across] = fitted;
    Around<D> around(*this);
    const CellRows<D> window = rows_around<D>(radius, true);
    for (size_t k = first_element; k < last_element; ++k) {
      Spread<D> spread;
      around.each(sums_[k].cell, window, [&](int32_t near) {
        spread.add(sums_[static_cast<size_t>(near)], sums_[k].cell);
      });
      const Eigen::SelfAdjointEigenSolver<Square> axes(spread.covariance());
      const Vec<D> variance = axes.eigenvalues().cwiseMax(0.0);  // rising
      Element<D>& element = elements_[k];
      element.normal.setZero();
      element.off_plane = 0.0;
      element.centre = element.mean;
      element.half = 0.5;
      element.prominence = static_cast<double>(sums_[k].count) / spread.most;
      all += sums_[k].count;
      const bool wide = variance[1] > 0.15 * radius * radius;  // over three cells of five
      if (!wide || variance[0] >= 0.25 * variance[1]) continue;
      const Vec<D> normal = axes.eigenvectors().col(0);
      const Vec<D> middle = sums_[k].cell.template cast<double>() + spread.mean();
      // feet, and wheels, are not of the ground that they stand on
      const double apart = std::abs(normal.dot(element.mean - middle));
      if (kStandsOn && apart > kNear && apart * apart > kOff * kOff * variance[0]) continue;
      flat += sums_[k].count;
      across.emplace_back(std::sqrt(variance[0]), sums_[k].count);
      element.normal = normal;
      element.centre = middle;
      // evenly spread points reach sqrt(3) deviations; the inner half is surely surface
      element.half = 0.5 * std::sqrt(3.0 * variance[1]);
      const Vec<D> centre = Vec<D>::Constant(0.5);  // as seen from the cell's corner
      element.off_plane = element.normal.dot(centre - spread.mean());
    }
    return fitted;
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
  double scatter_ = 0.0;
  bool fitted_ = false;
  bool dated_ = false;         // whether looks were given
  std::vector<Sums<D>> sums_;  // until it is fitted
  std::vector<Element<D>> elements_;
  std::vector<Cell<D>> cells_;
  std::vector<int64_t> beams_;
  std::vector<Span> hits_;  // if dated
};

}  // namespace stillmap
