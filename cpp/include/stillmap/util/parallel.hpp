// Static division of work over threads; exceptions reach the caller.
#pragma once

#include <algorithm>
#include <cstddef>
#include <exception>
#include <thread>
#include <vector>

namespace stillmap {

// Calls work(thread, first, last) on contiguous shares whose bounds are given: bounds[i] to
// bounds[i + 1].
template <class Work>
void parallel_for_ranges(const std::vector<size_t>& bounds, Work&& work) {
  const size_t n = bounds.size() - 1;
  std::vector<std::exception_ptr> errors(n);
  auto guarded = [&](size_t i) {
    try {
      work(i, bounds[i], bounds[i + 1]);
    } catch (...) {
      errors[i] = std::current_exception();
    }
  };
  std::vector<std::thread> others;
  for (size_t i = 1; i < n; ++i) others.emplace_back(guarded, i);
  guarded(0);
  for (auto& other : others) other.join();
  for (const auto& error : errors)
    if (error) std::rethrow_exception(error);
}

// Bounds that give each thread about the same number of beams; offset has one entry more than
// there are scans.
inline std::vector<size_t> split_by_beams(const int64_t* offset, size_t scans, int threads) {
  const size_t n =
      std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1, std::max<size_t>(scans, 1));
  std::vector<size_t> bounds{0};
  for (size_t i = 1; i < n; ++i) {
    const int64_t wanted =
        offset[0] + (offset[scans] - offset[0]) * static_cast<int64_t>(i) / static_cast<int64_t>(n);
    const auto it = std::lower_bound(offset, offset + scans, wanted);
    bounds.push_back(std::max(bounds.back(), static_cast<size_t>(it - offset)));
  }
  bounds.push_back(scans);
  return bounds;
}

// Bounds that give each thread about the same number of n things.
inline std::vector<size_t> split_evenly(size_t n, int threads) {
  constexpr size_t few = 1 << 12;  // of which no thread is worth while
  const size_t shares = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1,
                                           std::max<size_t>(n / few, 1));
  std::vector<size_t> bounds;
  for (size_t i = 0; i <= shares; ++i) bounds.push_back(n * i / shares);
  return bounds;
}

}  // namespace stillmap
