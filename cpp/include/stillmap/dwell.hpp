// How probable what was seen of a cell is, for things that stay for different times.
//
// A cell is occupied or empty, a two-state Markov chain in time: occupied for a share rho of the
// time, with correlation exp(-dt / tau). Each look at it sees something there, which something
// occupying it must have caused; or sees through it, which an occupied cell lets happen with
// probability 1 - detection * reliability. What stands still is the chain with rho near one.
#pragma once

#include <algorithm>
#include <array>
#include <atomic>
#include <cmath>
#include <limits>
#include <stdexcept>
#include <vector>

#include "stillmap/surface.hpp"

namespace stillmap {

constexpr size_t kMaxClasses = 64;

struct DwellClasses {
  std::vector<double> rho;  // share of time occupied, in (0, 1)
  std::vector<double> tau;  // seconds
  double detection;         // probability that an occupied cell is seen to be so
};

struct LookOptions {
  double seconds;  // between successive looks
  double lateral;  // cells: how far a beam may pass beside where it seems to
  double margin;   // cells: how far behind an element a beam must end to have passed it
  double reach;    // cells: hits so near to an element are hits of it
  double beyond;   // cells before its end up to which a maximum-range beam is trusted
  bool normals;    // whether surfaces face somewhere; else every element is round
};

// Gaussian distribution function from a table: the miss of every beam of every cell asks for it.
class NormalCdf {
 public:
  NormalCdf() : table_(2 * kLimit * kPerUnit + 2) {
    for (size_t i = 0; i < table_.size(); ++i) {
      const double x = static_cast<double>(i) / kPerUnit - kLimit;
      table_[i] = static_cast<float>(0.5 * std::erfc(-x / std::sqrt(2.0)));
    }
  }
  float operator()(double x) const {
    const double at = (std::clamp(x, -1.0 * kLimit, 1.0 * kLimit) + kLimit) * kPerUnit;
    return table_[static_cast<size_t>(at + 0.5)];
  }

 private:
  static constexpr int kLimit = 5, kPerUnit = 128;
  std::vector<float> table_;
};

// What one look says about one element.
struct Look {
  static constexpr float kHit = 2.0f;
  int32_t element;
  float seen_through;  // probability in (0, 1] that some beam met the element's place, or kHit
};

// Collects the beams of one look.
template <int D>
class LookCollector {
 public:
  // What a beam has to know of an element, in few bytes: most of the time goes into fetching them.
  struct Patch {
    std::array<float, D> centre;    // seen from the cell's corner
    std::array<int16_t, D> normal;  // in units of 1 / kUnit; zero where there is none
    int16_t half;                   // likewise
    static constexpr double kUnit = 4096.0;

    static int16_t packed(double value) { return static_cast<int16_t>(std::lround(value * kUnit)); }
    bool flat() const {
      for (const int16_t n : normal)
        if (n != 0) return true;
      return false;
    }
  };

  static std::vector<Patch> patches_of(const Surface<D>& surface, bool normals) {
    std::vector<Patch> patches(surface.size());
    for (size_t i = 0; i < patches.size(); ++i) {
      const auto k = static_cast<int32_t>(i);
      const Element<D>& e = surface.element(k);
      const bool flat = normals && !e.normal.isZero(0.0);
      const Vec<D> centre = (flat ? e.centre : e.mean) - surface.cell(k).template cast<double>();
      for (int d = 0; d < D; ++d) {
        patches[i].centre[static_cast<size_t>(d)] = static_cast<float>(centre[d]);
        patches[i].normal[static_cast<size_t>(d)] = flat ? Patch::packed(e.normal[d]) : int16_t{0};
      }
      patches[i].half = Patch::packed(flat ? std::min(e.half, 7.0) : 0.5);
    }
    return patches;
  }

  LookCollector(const Surface<D>& surface, const std::vector<Patch>& patches,
                const LookOptions& options, const NormalCdf& cdf)
      : surface_(surface),
        patches_(patches),
        options_(options),
        margin_squared_(options.margin * options.margin),
        per_lateral_(1.0 / options.lateral),
        cdf_(cdf),
        missed_(surface.size(), kUntouched),
        cursor_(surface) {}

  void add(const Scans<D>& scans, size_t first, size_t last) {
    for_each_beam<D>(scans, first, last, [&](size_t, int64_t n, const Pose<D>& pose) {
      const Segment<D> beam(pose, scans.points + n * D, surface_.resolution());
      hit_ = scans.hit[n];
      pass(beam);
      if (!hit_) return;
      if (const auto* k = at(cell_of<D>(beam.end)); k && strike(*k)) struck_.push_back(*k);
    });
  }

  // What the look says, and a clean sheet for the next one.
  void take(std::vector<Look>& out) {
    out.clear();
    spread_hits();
    for (const int32_t k : touched_) {
      float& missed = missed_[static_cast<size_t>(k)];
      if (missed == kStruck) {
        out.push_back({k, Look::kHit});
      } else if (missed < kSure) {
        out.push_back({k, 1.0f});
      } else if (missed < kLeast) {
        out.push_back({k, 1.0f - missed});
      }
      missed = kUntouched;
    }
    touched_.clear();
    struck_.clear();
  }

 private:
  static constexpr float kStruck = -1.0f, kUntouched = 2.0f;
  static constexpr float kSure = 0.05f;  // more beams of the same look would change nothing
  static constexpr float kLeast = 0.98f;

  // Whether that is news.
  bool strike(int32_t k) {
    float& missed = missed_[static_cast<size_t>(k)];
    if (missed == kStruck) return false;
    if (missed == kUntouched) touched_.push_back(k);
    missed = kStruck;
    return true;
  }

  const int32_t* at(const Cell<D>& cell) {
    const auto* block = cursor_.block(cell);
    if (!block) return nullptr;
    const int32_t* k = &block->counts[static_cast<size_t>(Surface<D>::local_of(cell))];
    return *k == kNoElement ? nullptr : k;
  }

  // Notes what the beam passed.
  void pass(const Segment<D>& beam) {
    const Vec<D> way = beam.end - beam.start;
    const double length = way.norm();
    const double usable = hit_ ? length : length - options_.beyond;
    if (!(usable > 0.0)) return;
    const Vec<D> direction = way / length;
    const Vec<D> end = hit_ ? beam.end : Vec<D>(beam.start + direction * usable);
    Walker walker(cursor_, [&](const int32_t* k, const Cell<D>& cell) {
      if (!k || *k == kNoElement) return;
      float& missed = missed_[static_cast<size_t>(*k)];
      if (missed < kSure) return;
      const float met = probability_met(patches_[static_cast<size_t>(*k)], cell, beam, direction);
      if (met <= 0.0f) return;
      if (missed == kUntouched) {
        touched_.push_back(*k);
        missed = 1.0f;
      }
      missed *= 1.0f - met;
    });
    traverse<D>(beam.start, end, walker);
    // the end cell is not visited: an end in it is a hit, and free range stops before it
  }

  // Of the beam crossing the surface within the element, as far as `lateral` lets one tell: small
  // at grazing angles.
  float probability_met(const Patch& patch, const Cell<D>& cell, const Segment<D>& beam,
                        const Vec<D>& direction) const {
    Vec<D> centre = cell.template cast<double>();
    for (int d = 0; d < D; ++d)
      centre[d] += static_cast<double>(patch.centre[static_cast<size_t>(d)]);
    const Vec<D> off = centre - beam.start, behind = beam.end - centre;
    double facing = 1.0;
    if (patch.flat()) {
      Vec<D> normal;
      for (int d = 0; d < D; ++d) normal[d] = patch.normal[static_cast<size_t>(d)] / Patch::kUnit;
      facing = std::abs(normal.dot(direction));
      if (hit_ && std::abs(normal.dot(behind)) < options_.margin) return 0.0f;
    } else if (hit_ && behind.squaredNorm() < margin_squared_) {
      return 0.0f;
    }
    const double along = off.dot(direction);
    const double aside = std::sqrt(std::max(0.0, off.squaredNorm() - along * along));
    const double half = patch.half / Patch::kUnit * facing;
    return cdf_((half - aside) * per_lateral_) - cdf_((-half - aside) * per_lateral_);
  }

  // Elements near one that was struck are struck: pose and range noise move end points about.
  void spread_hits() {
    const int radius = static_cast<int>(std::ceil(options_.reach));
    const double limit = options_.reach * options_.reach;
    for (const int32_t from : struck_) {
      const Vec<D>& mean = surface_.element(from).mean;
      for_each_near<D>(surface_.cell(from), radius, [&](const Cell<D>& cell) {
        const auto* k = at(cell);
        if (k && (surface_.element(*k).mean - mean).squaredNorm() <= limit) strike(*k);
      });
    }
  }

  const Surface<D>& surface_;
  const std::vector<Patch>& patches_;
  LookOptions options_;
  double margin_squared_, per_lateral_;
  const NormalCdf& cdf_;
  std::vector<float> missed_;  // probability that every beam of this look went past
  std::vector<int32_t> touched_, struck_;
  Cursor<const Surface<D>> cursor_;
  bool hit_ = false;
};

// The likelihood of everything seen of each element under each class, look after look. Memory is
// that of the elements; looks come in the order of time.
template <int D>
class Dwell {
 public:
  Dwell(const Surface<D>& surface, DwellClasses classes, const LookOptions& options)
      : surface_(surface), classes_(std::move(classes)), options_(options) {
    const size_t C = classes_.rho.size();
    if (!surface.fitted()) throw std::invalid_argument("surface: fit it first");
    patches_ = LookCollector<D>::patches_of(surface, options.normals);
    for (const double r : classes_.rho) rho_.push_back(static_cast<float>(r));
    heads_.resize(surface.size());
    state_.assign(surface.size() * 2 * C, 1.0f);
    for (size_t k = 0; k < surface.size(); ++k)
      for (size_t c = 0; c < C; ++c) occupied(k)[c] = static_cast<float>(classes_.rho[c]);
    for (int gap = 0; gap < kTable; ++gap) append_correlation(table_, gap);
    prepare_runs();
  }

  size_t classes() const { return classes_.rho.size(); }
  const Surface<D>& surface() const { return surface_; }

  // look (T,): number of each scan's look, not falling, and not below those added before.
  void add(const Scans<D>& scans, const int64_t* look, int threads) {
    if (!surface_.fitted() || heads_.size() != surface_.size())
      throw std::invalid_argument("surface: has changed since");
    const size_t T = scans.n_scans;
    for (size_t t = 0; t < T; ++t)
      if (look[t] < (t ? look[t - 1] : newest_)) throw std::invalid_argument("look: must not fall");
    std::vector<size_t> starts;  // of looks
    for (size_t t = 0; t < T; ++t)
      if (t == 0 || look[t] != look[t - 1]) starts.push_back(t);
    starts.push_back(T);
    const size_t looks = starts.size() - 1;
    // each has a sheet as large as the map
    const size_t n = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1,
                                        std::max<size_t>(looks, 1));
    std::vector<std::unique_ptr<LookCollector<D>>> collectors;
    for (size_t i = 0; i < n; ++i)
      collectors.push_back(std::make_unique<LookCollector<D>>(surface_, patches_, options_, cdf_));
    std::vector<std::vector<Look>> seen(kWindow);
    for (size_t from = 0; from < looks; from += kWindow) {
      const size_t to = std::min(from + kWindow, looks);
      std::atomic<size_t> next{from};
      parallel_shares(one_each(n), [&](size_t i, size_t, size_t) {
        for (size_t l = next++; l < to; l = next++) {
          collectors[i]->add(scans, starts[l], starts[l + 1]);
          collectors[i]->take(seen[l - from]);
        }
      });
      parallel_shares(one_each(n), [&](size_t i, size_t, size_t) {
        for (size_t l = from; l < to; ++l) apply(seen[l - from], look[starts[l]], i, n);
      });
    }
    if (T) newest_ = look[T - 1];
  }

  // (elements, classes): likelihood of everything else that was seen of a cell, given that a beam
  // ended in it, relative to the best class; and the logarithm of the best.
  void likelihood(float* relative, double* log_best) {
    const size_t C = classes();
    for (size_t k = 0; k < surface_.size(); ++k) {
      end_run(k);
      double best = 0.0;
      auto value = [&](size_t c) { return weight(k)[c] / (classes_.rho[c] * classes_.detection); };
      for (size_t c = 0; c < C; ++c) best = std::max(best, value(c));
      for (size_t c = 0; c < C; ++c) relative[k * C + c] = static_cast<float>(value(c) / best);
      log_best[k] = heads_[k].log_scale + std::log(best);
    }
  }

 private:
  static constexpr int64_t kNever = INT64_MIN;
  static constexpr size_t kWindow = 64;  // looks held at once
  static constexpr size_t kAhead = 8;    // elements
  static constexpr int kTable = 64;      // gaps whose correlations are kept
  static constexpr float kSmall = 1e-12f, kLeast = 1e-36f;
  static constexpr float kSeldom = 1e-20f;  // no filter is surer that a cell is empty

  // The same look again and again multiplies each class by the same factor, so a run of them is
  // only counted until something else is seen.
  struct Run {
    int32_t length = 0;  // looks that are counted but not yet taken into account
    int8_t misses = 0;   // sure misses in a row so far, at most calm_
    bool hits = false;   // the last look was a hit
  };

  struct Head {
    int64_t last = kNever;   // number of the last look
    double log_scale = 0.0;  // logarithm of what the weights were divided by
    Run run;
  };

  // Probability of being occupied now, and likelihood so far, under each class.
  float* occupied(size_t k) { return state_.data() + k * 2 * classes(); }
  float* weight(size_t k) { return occupied(k) + classes(); }

  void prepare_runs() {
    for (size_t c = 0; c < classes(); ++c) {
      const double rho = classes_.rho[c], a = classes_.detection, q = table_[classes() + c];
      double p = rho, through = 1.0;
      for (int i = 0; i < 200; ++i) {  // the fixed point of misses without end
        p = rho + (p - rho) * q;
        through = 1.0 - p * a;
        p *= (1.0 - a) / through;
      }
      log_hit_.push_back(std::log(a * (rho + (1.0 - rho) * q)));
      log_miss_.push_back(std::log(through));
      double after_hit = 1.0;  // from there it takes longest
      for (int8_t misses = 1; misses < 100; ++misses) {
        after_hit = rho + (after_hit - rho) * q;
        after_hit *= (1.0 - a) / (1.0 - after_hit * a);
        if (after_hit > 1.01 * p) calm_ = std::max<int8_t>(calm_, static_cast<int8_t>(misses + 1));
      }
    }
  }

  void end_run(size_t k) {
    Run& run = heads_[k].run;
    if (run.length == 0) return;
    const std::vector<double>& factor = run.hits ? log_hit_ : log_miss_;
    const size_t C = classes();
    float* w = weight(k);
    double best = -std::numeric_limits<double>::infinity();
    std::array<double, kMaxClasses> log_weight;
    for (size_t c = 0; c < C; ++c) {
      log_weight[c] = std::log(static_cast<double>(w[c])) + run.length * factor[c];
      best = std::max(best, log_weight[c]);
    }
    for (size_t c = 0; c < C; ++c)
      w[c] = std::max(static_cast<float>(std::exp(log_weight[c] - best)), kLeast);
    heads_[k].log_scale += best;
    run.length = 0;
  }

  static std::vector<size_t> one_each(size_t n) {
    std::vector<size_t> bounds(n + 1);
    for (size_t i = 0; i <= n; ++i) bounds[i] = i;
    return bounds;
  }

  void append_correlation(std::vector<float>& to, int64_t gap) const {
    for (const double tau : classes_.tau)
      to.push_back(
          static_cast<float>(std::exp(-static_cast<double>(gap) * options_.seconds / tau)));
  }

  // Elements lie far apart in memory: what is needed soon is asked for now.
  void prefetch(size_t k) {
    __builtin_prefetch(&heads_[k], 1);
    for (size_t c = 0; c < 2 * classes(); c += 16) __builtin_prefetch(occupied(k) + c, 1);
  }

  // Elements are dealt to threads by number, so that each is written by one thread alone.
  void apply(const std::vector<Look>& seen, int64_t look, size_t share, size_t shares) {
    std::vector<float> long_gap;
    for (size_t i = 0; i < seen.size(); ++i) {
      if (i + kAhead < seen.size()) prefetch(static_cast<size_t>(seen[i + kAhead].element));
      const Look& s = seen[i];
      const size_t k = static_cast<size_t>(s.element);
      if ((k >> 6) % shares != share) continue;
      Head& head = heads_[k];
      const bool first = head.last == kNever;
      const int64_t gap = first ? 0 : look - head.last;
      const bool next = !first && gap == 1;
      head.last = look;
      Run& run = head.run;
      const bool hit = s.seen_through == Look::kHit, sure_miss = s.seen_through == 1.0f;
      if (next && ((hit && run.hits) || (sure_miss && run.misses == calm_))) {
        ++run.length;
        continue;
      }
      end_run(k);
      run.hits = hit;
      run.misses = sure_miss ? static_cast<int8_t>(next ? std::min<int>(run.misses + 1, calm_) : 1)
                             : int8_t{0};
      const float* correlation = nullptr;
      if (gap >= kTable) {
        long_gap.clear();
        append_correlation(long_gap, gap);
        correlation = long_gap.data();
      } else if (!first) {
        correlation = table_.data() + static_cast<size_t>(gap) * classes();
      }
      update(k, correlation, s.seen_through);
    }
  }

  // One step of the filter of every class, forward in time.
  void update(size_t k, const float* correlation, float seen_through) {
    const size_t C = classes();
    float* p = occupied(k);
    float* w = weight(k);
    const float* rho = rho_.data();
    const float a = static_cast<float>(classes_.detection);
    if (correlation)
      for (size_t c = 0; c < C; ++c) {
        p[c] = rho[c] + (p[c] - rho[c]) * correlation[c];
      }
    float best = 0.0f;
    if (seen_through == Look::kHit) {
      for (size_t c = 0; c < C; ++c) {
        w[c] *= p[c] * a;
        p[c] = 1.0f;
        best = std::max(best, w[c]);
      }
    } else {
      const float missed = 1.0f - a * seen_through;
      for (size_t c = 0; c < C; ++c) {
        const float through = 1.0f - p[c] + p[c] * missed;
        w[c] *= through;
        p[c] = std::max(p[c] * missed / through, kSeldom);
        best = std::max(best, w[c]);
      }
    }
    if (best >= kSmall) return;
    const float up = 1.0f / best;
    for (size_t c = 0; c < C; ++c) w[c] = std::max(w[c] * up, kLeast);
    heads_[k].log_scale += std::log(best);
  }

  const Surface<D>& surface_;
  DwellClasses classes_;
  LookOptions options_;
  std::vector<typename LookCollector<D>::Patch> patches_;
  NormalCdf cdf_;
  std::vector<float> rho_;
  std::vector<Head> heads_;
  std::vector<float> state_;                // (elements, 2, classes)
  std::vector<double> log_hit_, log_miss_;  // of one more look in a run, per class
  int8_t calm_ = 1;                         // misses in a row after which the filters stand still
  std::vector<float> table_;
  int64_t newest_ = INT64_MIN;
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
      const Cell<D> cell = cell_of<D>(beam.end);
      if (const auto* block = cursor.block(cell))
        element[n] = block->counts[static_cast<size_t>(Surface<D>::local_of(cell))];
    });
  });
}

}  // namespace stillmap
