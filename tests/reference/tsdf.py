"""TSDF integration (Curless and Levoy 1996)."""

# ruff: noqa: ARG002  (threads: as the kernels have it)

import numpy as np

_MARGIN = 0.01  # of a triangle
_FLAT = 1e-12  # volume / product of the corner distances of a triangle seen edge-on
_NEAREST = 0.05  # of the range, start of integration
_SLANT = 100.0  # largest ratio of length along a line of sight to distance from the surface


class TsdfVolume:
    """Weights and weighted distances per voxel."""

    block_edge = 8

    def __init__(self, voxel, *, truncation_front, truncation_back):
        self.voxel = voxel
        self.truncation_front, self.truncation_back = truncation_front, truncation_back
        self._sums: dict[tuple[int, int, int], list[np.float32]] = {}

    def integrate(self, points, origin, standoff, faces, weight, threads=1):
        """As `_core.TsdfVolume`."""
        for face, w in zip(faces, weight, strict=True):
            if w > 0.0:
                self._add_triangle(points[face], origin[face].mean(axis=0), standoff[face], w)

    def _add_triangle(self, corners, o, standoff, w):
        M = (corners - o).T
        volume, h = np.linalg.det(M), float(standoff.mean())
        if abs(volume) <= _FLAT * np.prod(np.linalg.norm(M, axis=0)) or h <= 0.0:
            return
        per_metre = min(1.0 / h, _SLANT / float(np.linalg.norm(M.mean(axis=1))))
        nearest = max(1.0 - self.truncation_front * per_metre, _NEAREST)
        farthest = 1.0 + self.truncation_back * per_metre
        # start and end of the lines of sight through the enlarged triangle
        outer = M @ (np.eye(3) + 2 * _MARGIN * (3.0 * np.eye(3) - np.ones((3, 3))))
        ends = np.concatenate([nearest * outer, farthest * outer], axis=1).T + o
        low = np.floor(ends.min(axis=0) / self.voxel - 0.5).astype(int)
        high = np.ceil(ends.max(axis=0) / self.voxel - 0.5).astype(int)
        axes = [np.arange(a, b + 1) for a, b in zip(low, high, strict=True)]
        voxels = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
        mu = np.linalg.solve(M, ((voxels + 0.5) * self.voxel - o).T).T
        k = mu.sum(axis=1)
        within = (mu >= -_MARGIN).all(axis=1) & (k >= nearest) & (k <= farthest)
        mu, k = mu[within], k[within]
        metres = (1.0 - k) * (mu @ standoff) / k
        share = w * np.minimum(1.0, 1.0 + metres / self.truncation_back).astype(np.float32)
        for cell, s, d in zip(voxels[within], share, metres.astype(np.float32), strict=True):
            x, y, z = cell.tolist()
            sums = self._sums.setdefault((x, y, z), [np.float32(0), np.float32(0)])
            sums[0] += s
            sums[1] += s * d

    def blocks(self):
        """(B, 3) blocks with integrated voxels, sorted."""
        cells = np.array(list(self._sums), np.int64).reshape(-1, 3)
        return np.unique(cells // self.block_edge, axis=0)

    def dense(self, first_cell, shape):
        """[z, y, x] metres, NaN where unobserved, and weights."""
        metres, weight = np.full(shape, np.nan, np.float32), np.zeros(shape, np.float32)
        for cell, (w, product) in self._sums.items():
            at = tuple((np.array(cell) - first_cell)[::-1])
            if w > 0.0 and all(0 <= i < n for i, n in zip(at, shape, strict=True)):
                metres[at], weight[at] = product / w, w
        return metres, weight
