// Signed distances from the surfaces that scans saw, averaged in voxels: Curless and Levoy, "A
// Volumetric Method for Building Complex Models from Range Images", SIGGRAPH 1996.
// Threads share blocks of voxels, not triangles: in each voxel the terms come in the triangles'
// order, so the sums have the same bits whatever the number of threads.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <unordered_set>
#include <vector>

#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/voxel_hash_map.hpp"
#include "stillmap/mesh/triangle_frustum.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Sums over the triangles that a voxel lies before or behind.
struct Distances {
  float weight = 0.0f;
  float product = 0.0f;  // weight times metres in front of the surface
};

class SignedDistances : public Blocks<3, Distances> {
 public:
  // voxel: metres, its edge; distances are summed from `before` metres in front of surfaces to
  // `behind` metres behind them
  SignedDistances(double voxel, double before, double behind)
      : voxel_(voxel), before_(before), behind_(behind) {
    if (!(voxel > 0.0) || !std::isfinite(voxel))
      throw std::invalid_argument("voxel: expected a positive length in metres");
    if (!(before > 0.0) || !(before <= kMostVoxels * voxel) || !(behind > 0.0) ||
        !(behind <= kMostVoxels * voxel))
      throw std::invalid_argument("before, behind: expected above 0 to 64 voxels");
  }

  SignedDistances(SignedDistances&&) noexcept = default;
  SignedDistances& operator=(SignedDistances&&) noexcept = default;
  SignedDistances(const SignedDistances&) = delete;
  SignedDistances& operator=(const SignedDistances&) = delete;

  double voxel() const { return voxel_; }
  double before() const { return before_; }
  double behind() const { return behind_; }

  size_t memory_bytes() const { return blocks().size() * (sizeof(Block) + 64); }

  // Voxels of these blocks are as if never met.
  void forget(const std::vector<Cell<3>>& blocks) {
    std::unordered_set<uint64_t, Grid<3>::Hash> gone;
    for (const Cell<3>& block : blocks) gone.insert(Grid<3>::key(block));
    keep_if([&](const Cell<3>& block) { return gone.find(Grid<3>::key(block)) == gone.end(); });
  }

  // In batches, so that what waits to be summed stays small.
  void add(const Triangles& triangles, int threads) {
    const size_t batch = kBatch * static_cast<size_t>(std::clamp(threads, 1, 64));
    std::vector<Share> shares;
    for (size_t first = 0; first < triangles.size; first += batch) {
      const auto bounds = even_shares(std::min(batch, triangles.size - first), threads);
      if (shares.size() < bounds.size() - 1) shares.resize(bounds.size() - 1);
      parallel_shares(bounds, [&](size_t share, size_t low, size_t high) {
        shares[share].terms.clear();
        for (size_t face = first + low; face < first + high; ++face)
          meet(triangles, face, shares[share]);
      });
      sum(triangles, shares, bounds.size() - 1);
    }
  }

 private:
  static constexpr double kMostVoxels = 64.0;
  static constexpr int64_t kMostBlocks = 1 << 20;  // around one triangle
  static constexpr double kSmall = 16.0;           // voxels along an edge
  static constexpr float kWhole = -1.0f;

  static constexpr size_t kBatch = 1 << 13;  // triangles for each thread

  // What a triangle adds to a voxel of a block; of a large triangle, all that it adds to the block.
  struct Term {
    uint32_t block;   // as its share numbers them
    uint32_t number;  // of the voxel in the block, or of the face
    float weight;     // kWhole: of the face
    float metres;
  };
  // What triangles that follow one another add, in their order.
  struct Share {
    std::vector<Term> terms;
    VoxelTable<3, uint32_t> known;  // one more than the number of each block
    std::vector<Block*> block;      // by its number
    std::vector<size_t> owner;      // which thread sums it
    Cell<3> last = Cell<3>::Zero();
    uint32_t last_number = 0;

    uint32_t number_of(const Cell<3>& cell) {
      if (known.size() && cell == last) return last_number;
      uint32_t& place = known.find_or_add(cell);
      if (place == 0) place = static_cast<uint32_t>(known.size());
      last = cell;
      last_number = place - 1;
      return last_number;
    }
  };

  Prism prism(const Triangles& triangles, size_t face) const {
    return Prism(triangles, face, voxel_, before_, behind_);
  }

  // less weight behind the surface, where there may be another one
  Term term(uint32_t block, const Cell<3>& voxel, double metres, float weight) const {
    return {block, static_cast<uint32_t>(local_of(voxel)),
            weight * static_cast<float>(std::min(1.0, 1.0 + metres / behind_)),
            static_cast<float>(metres)};
  }

  void meet(const Triangles& triangles, size_t face, Share& share) const {
    const float weight = triangles.weight[face];
    if (!(weight > 0.0f)) return;
    const Prism one = prism(triangles, face);
    if (one.empty()) return;
    if (one.longest() <= kSmall) {
      one.each(one.low(), one.high(), [&](const Cell<3>& voxel, double metres) {
        share.terms.push_back(term(share.number_of(block_of(voxel)), voxel, metres, weight));
      });
      return;
    }
    const Cell<3> low = block_of(one.low()), high = block_of(one.high());
    int64_t blocks = 1;
    for (int d = 0; d < 3; ++d) blocks *= std::min<int64_t>(high[d] - low[d] + 1, kMostBlocks + 1);
    if (blocks > kMostBlocks || blocks < 1)
      throw std::invalid_argument("faces: one is too large for voxels of this edge");
    Cell<3> block;
    for (block[2] = low[2]; block[2] <= high[2]; ++block[2])
      for (block[1] = low[1]; block[1] <= high[1]; ++block[1])
        for (block[0] = low[0]; block[0] <= high[0]; ++block[0])
          if (!one.misses(block * kEdge, kEdge))
            share.terms.push_back(
                {share.number_of(block), static_cast<uint32_t>(face), kWhole, 0.0f});
  }

  // Each thread has blocks of its own, and meets the terms in their order.
  void sum(const Triangles& triangles, std::vector<Share>& shares, size_t n) {
    for (size_t i = 0; i < n; ++i)
      for (size_t k = shares[i].block.size(); k < shares[i].known.size(); ++k) {
        const Cell<3>& cell = shares[i].known.cell(k);
        shares[i].block.push_back(find_or_add(cell, Distances{}));
        shares[i].owner.push_back(static_cast<size_t>(Grid<3>::Hash{}(Grid<3>::key(cell))));
      }
    std::vector<size_t> each(n + 1);
    for (size_t i = 0; i <= n; ++i) each[i] = i;
    parallel_shares(each, [&](size_t mine, size_t, size_t) {
      for (size_t i = 0; i < n; ++i)
        for (const Term& one : shares[i].terms)
          if (n == 1 || shares[i].owner[one.block] % n == mine)
            sum(triangles, one, *shares[i].block[one.block]);
    });
  }

  void sum(const Triangles& triangles, const Term& of, Block& block) const {
    if (of.weight != kWhole) {
      add_to(block, of);
      return;
    }
    const Prism one = prism(triangles, of.number);
    const Cell<3> corner = block.origin * kEdge;
    const Cell<3> low = one.low().cwiseMax(corner);
    const Cell<3> high = one.high().cwiseMin((corner.array() + (kEdge - 1)).matrix());
    one.each(low, high, [&](const Cell<3>& voxel, double metres) {
      add_to(block, term(of.block, voxel, metres, triangles.weight[of.number]));
    });
  }

  static void add_to(Block& block, const Term& one) {
    Distances& voxel = block.counts[one.number];
    voxel.weight += one.weight;
    voxel.product += one.weight * one.metres;
  }

  double voxel_, before_, behind_;
};

}  // namespace stillmap
