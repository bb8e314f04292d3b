// Static partitioning of work over threads; exceptions are rethrown in the caller.
#pragma once

#include <algorithm>
#include <cstddef>
#include <exception>
#include <system_error>
#include <thread>
#include <vector>

namespace stillmap {

// Calls work(thread, bounds[i], bounds[i + 1]) for each range i, in parallel.
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
  others.reserve(n);
  for (size_t i = 1; i < n; ++i) {
    try {
      others.emplace_back(guarded, i);
    } catch (const std::system_error&) {  // no memory for another stack
      guarded(i);
    }
  }
  guarded(0);
  for (auto& other : others) other.join();
  for (const auto& error : errors)
    if (error) std::rethrow_exception(error);
}

// Range bounds of scans with about the same number of beams each; offset (scans + 1,).
inline std::vector<size_t> split_by_beams(const int64_t* offset, size_t scans, int threads) {
  const size_t n =
      std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1, std::max<size_t>(scans, 1));
  std::vector<size_t> bounds{0};
  for (size_t i = 1; i < n; ++i) {
    const int64_t target =
        offset[0] + (offset[scans] - offset[0]) * static_cast<int64_t>(i) / static_cast<int64_t>(n);
    const auto it = std::lower_bound(offset, offset + scans, target);
    bounds.push_back(std::max(bounds.back(), static_cast<size_t>(it - offset)));
  }
  bounds.push_back(scans);
  return bounds;
}

// Range bounds that split n items evenly; least: items that pay for a thread.
inline std::vector<size_t> split_evenly(size_t n, int threads, size_t least = 1 << 12) {
  const size_t n_ranges = std::clamp<size_t>(static_cast<size_t>(std::max(threads, 1)), 1,
                                             std::max<size_t>(n / least, 1));
  std::vector<size_t> bounds;
  for (size_t i = 0; i <= n_ranges; ++i) bounds.push_back(n * i / n_ranges);
  return bounds;
}

}  // namespace stillmap
