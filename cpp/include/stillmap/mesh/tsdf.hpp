// TSDF integration: Curless and Levoy, "A Volumetric Method for Building Complex Models from Range
// Images", SIGGRAPH 1996.
// Threads own blocks of voxels, not triangles. The terms of each voxel are added in the order of
// the triangles, so sums have the same bits for any number of threads.
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <stdexcept>
#include <vector>

#include "stillmap/grid/block_layout.hpp"
#include "stillmap/grid/block_map.hpp"
#include "stillmap/grid/cell.hpp"
#include "stillmap/grid/voxel_hash_map.hpp"
#include "stillmap/mesh/triangle_frustum.hpp"
#include "stillmap/util/parallel.hpp"

namespace stillmap {

// Weighted sum of signed distances.
struct TsdfVoxel {
  float weight = 0.0f;
  float weighted_distance = 0.0f;  // weight times metres in front of the surface
};

class TsdfVolume : public BlockMap<3, TsdfVoxel> {
 public:
  // voxel: edge in metres; truncation_front, truncation_back: metres in front of and behind
  // surfaces up to which distances are integrated.
  TsdfVolume(double voxel, double truncation_front, double truncation_back)
      : voxel_(voxel), truncation_front_(truncation_front), truncation_back_(truncation_back) {
    if (!(voxel > 0.0) || !std::isfinite(voxel))
      throw std::invalid_argument("voxel: expected a positive length in metres");
    if (!(truncation_front > 0.0) || !(truncation_front <= kMaxTruncationVoxels * voxel) ||
        !(truncation_back > 0.0) || !(truncation_back <= kMaxTruncationVoxels * voxel))
      throw std::invalid_argument(
          "truncation_front, truncation_back: expected above 0 to 64 voxels");
  }

  TsdfVolume(TsdfVolume&&) noexcept = default;
  TsdfVolume& operator=(TsdfVolume&&) noexcept = default;
  TsdfVolume(const TsdfVolume&) = delete;
  TsdfVolume& operator=(const TsdfVolume&) = delete;

  double voxel() const { return voxel_; }
  double truncation_front() const { return truncation_front_; }
  double truncation_back() const { return truncation_back_; }

  // Works in batches to bound the memory of pending terms.
  void integrate(const TriangleBatch& triangles, int threads) {
    const size_t batch_size = kFacesPerThread * static_cast<size_t>(std::clamp(threads, 1, 64));
    std::vector<TermBatch> batches;
    for (size_t first = 0; first < triangles.size; first += batch_size) {
      const auto bounds = split_evenly(std::min(batch_size, triangles.size - first), threads);
      if (batches.size() < bounds.size() - 1) batches.resize(bounds.size() - 1);
      parallel_for_ranges(bounds, [&](size_t batch, size_t low, size_t high) {
        batches[batch].terms.clear();
        for (size_t face = first + low; face < first + high; ++face)
          collect_terms(triangles, face, batches[batch]);
      });
      accumulate_terms(triangles, batches, bounds.size() - 1);
    }
  }

 private:
  static constexpr double kMaxTruncationVoxels = 64.0;
  static constexpr int64_t kMaxBlocksPerFace = 1 << 20;
  static constexpr double kMaxDirectEdge = 16.0;  // voxels; larger faces get whole blocks
  static constexpr float kWholeBlock = -1.0f;

  static constexpr size_t kFacesPerThread = 1 << 13;

  // Contribution of a triangle to one voxel, or of a large triangle to a whole block.
  struct Term {
    uint32_t block;  // index in its batch
    uint32_t index;  // of the voxel in the block, or of the face
    float weight;    // kWholeBlock: all voxels of the block
    float distance;
  };
  // Terms of successive triangles, in their order.
  struct TermBatch {
    std::vector<Term> terms;
    VoxelHashMap<3, uint32_t> blocks_seen;  // index of each block + 1
    std::vector<Block*> block;              // by index
    std::vector<size_t> owner;              // thread that integrates it
    Cell<3> last = Cell<3>::Zero();
    uint32_t last_number = 0;

    uint32_t block_index(const Cell<3>& cell) {
      if (blocks_seen.size() && cell == last) return last_number;
      uint32_t& number = blocks_seen.find_or_add(cell);
      if (number == 0) number = static_cast<uint32_t>(blocks_seen.size());
      last = cell;
      last_number = number - 1;
      return last_number;
    }
  };

  TriangleFrustum frustum_of(const TriangleBatch& triangles, size_t face) const {
    return TriangleFrustum(triangles, face, voxel_, truncation_front_, truncation_back_);
  }

  // lower weight behind the surface, where there may be another one
  Term make_term(uint32_t block, const Cell<3>& voxel, double distance, float weight) const {
    return {block, static_cast<uint32_t>(local_of(voxel)),
            weight * static_cast<float>(std::min(1.0, 1.0 + distance / truncation_back_)),
            static_cast<float>(distance)};
  }

  void collect_terms(const TriangleBatch& triangles, size_t face, TermBatch& batch) const {
    const float weight = triangles.weight[face];
    if (!(weight > 0.0f)) return;
    const TriangleFrustum frustum = frustum_of(triangles, face);
    if (frustum.empty()) return;
    if (frustum.longest_edge() <= kMaxDirectEdge) {
      frustum.for_each_voxel(
          frustum.low(), frustum.high(), [&](const Cell<3>& voxel, double distance) {
            batch.terms.push_back(
                make_term(batch.block_index(block_of(voxel)), voxel, distance, weight));
          });
      return;
    }
    const Cell<3> low = block_of(frustum.low()), high = block_of(frustum.high());
    int64_t blocks = 1;
    for (int d = 0; d < 3; ++d)
      blocks *= std::min<int64_t>(high[d] - low[d] + 1, kMaxBlocksPerFace + 1);
    if (blocks > kMaxBlocksPerFace || blocks < 1)
      throw std::invalid_argument("faces: one is too large for voxels of this edge");
    Cell<3> block;
    for (block[2] = low[2]; block[2] <= high[2]; ++block[2])
      for (block[1] = low[1]; block[1] <= high[1]; ++block[1])
        for (block[0] = low[0]; block[0] <= high[0]; ++block[0])
          if (!frustum.misses_cube(block * kEdge, kEdge))
            batch.terms.push_back(
                {batch.block_index(block), static_cast<uint32_t>(face), kWholeBlock, 0.0f});
  }

  // Each thread owns some blocks and adds their terms in order.
  void accumulate_terms(const TriangleBatch& triangles, std::vector<TermBatch>& batches, size_t n) {
    for (size_t i = 0; i < n; ++i)
      for (size_t k = batches[i].block.size(); k < batches[i].blocks_seen.size(); ++k) {
        const Cell<3>& cell = batches[i].blocks_seen.cell(k);
        batches[i].block.push_back(find_or_add(cell, TsdfVoxel{}));
        batches[i].owner.push_back(
            static_cast<size_t>(BlockLayout<3>::Hash{}(BlockLayout<3>::key(cell))));
      }
    std::vector<size_t> bounds(n + 1);
    for (size_t i = 0; i <= n; ++i) bounds[i] = i;
    parallel_for_ranges(bounds, [&](size_t mine, size_t, size_t) {
      for (size_t i = 0; i < n; ++i)
        for (const Term& term : batches[i].terms)
          if (n == 1 || batches[i].owner[term.block] % n == mine)
            accumulate_term(triangles, term, *batches[i].block[term.block]);
    });
  }

  void accumulate_term(const TriangleBatch& triangles, const Term& term, Block& block) const {
    if (term.weight != kWholeBlock) {
      add_term(block, term);
      return;
    }
    const TriangleFrustum frustum = frustum_of(triangles, term.index);
    const Cell<3> corner = block.origin * kEdge;
    const Cell<3> low = frustum.low().cwiseMax(corner);
    const Cell<3> high = frustum.high().cwiseMin((corner.array() + (kEdge - 1)).matrix());
    frustum.for_each_voxel(low, high, [&](const Cell<3>& voxel, double distance) {
      add_term(block, make_term(term.block, voxel, distance, triangles.weight[term.index]));
    });
  }

  static void add_term(Block& block, const Term& term) {
    TsdfVoxel& voxel = block.values[term.index];
    voxel.weight += term.weight;
    voxel.weighted_distance += term.weight * term.distance;
  }

  double voxel_, truncation_front_, truncation_back_;
};

}  // namespace stillmap
