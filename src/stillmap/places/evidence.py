"""Evidence of a session in the frame of its place: sums of hits and passes of its keyframes, (10).

Stored in blocks of cells, in 2D and 3D alike: one byte for the expected number of static hits of a
cell, and one for the length by which beams passed through it, in cells.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap import em
from stillmap.core.short_repr import ShortRepr
from stillmap.places.keyframes import Keyframes

Float = NDArray[np.float64]
Bytes = NDArray[np.uint8]

BLOCK = {2: 32, 3: 8}  # cells, edge of a block
_APPROACH = 0.2  # m before its end in which a beam is not used as free space
_MAX_GAP = 3  # cells between two channels of a lidar, at 0.15 m as far as 13 m with 2 degrees
UNITS = 4.0  # of a byte in a hit or a cell passed: sums end at 63
_MAX_BYTE = 255


@dataclass(frozen=True, eq=False)
class Evidence(ShortRepr):
    """Sums of a session over B blocks of cells.

    Attributes:
        corner: (B, D) int32, lowest cell of each block, a multiple of its edge, sorted.
        hits: (B, edge, ..., edge) uint8, expected number of static hits; axes as of `corner`.
        passes: (B, edge, ..., edge) uint8, cells that beams passed, and dynamic hits.
        resolution: m, edge of a cell.
    """

    corner: NDArray[np.int32]
    hits: Bytes
    passes: Bytes
    resolution: float

    @property
    def dimension(self) -> int:
        """2 or 3."""
        return int(self.corner.shape[1])

    @property
    def edge(self) -> int:
        """Cells along the edge of a block."""
        return BLOCK[self.dimension]

    def crop(self, low: NDArray[np.int64], shape: tuple[int, ...]) -> tuple[Bytes, Bytes]:
        """Hits and passes, in units of 1 / UNITS, in a box of cells from `low` (D,) on; 0 where
        nothing was observed."""
        edge = self.edge
        first = low // edge
        count = -(-(low + shape) // edge) - first
        at = self.corner // edge - first
        inside = np.flatnonzero(((at >= 0) & (at < count)).all(axis=1))
        blocks = tuple(i for column in at[inside].T for i in (column, slice(None)))
        whole = tuple((count * edge).tolist())
        split = tuple(n for one in count.tolist() for n in (one, edge))
        start = (low - first * edge).tolist()
        box = tuple(slice(begin, begin + n) for begin, n in zip(start, shape, strict=True))
        out = []
        for sums in (self.hits, self.passes):
            grid = np.zeros(split, np.uint8)
            grid[blocks] = sums[inside]
            out.append(grid.reshape(whole)[box])
        return out[0], out[1]


def crop_without_gaps(
    evidence: Evidence, low: NDArray[np.int64], shape: tuple[int, ...]
) -> tuple[Bytes, Bytes]:
    """`Evidence.crop`, in 3D without the gaps between the channels of a lidar.

    A cell counts as passed as far as cells above and below it, each within `_MAX_GAP`, were: beams
    of a lidar that drives by run one above the other. Below the ground none do, so it is no gap.
    """
    if evidence.dimension == 2:
        return evidence.crop(low, shape)
    margin = np.array([0, 0, _MAX_GAP])
    hits, passes = evidence.crop(low - margin, tuple((np.array(shape) + 2 * margin).tolist()))
    above, below = np.zeros_like(passes), np.zeros_like(passes)
    for step in range(1, _MAX_GAP + 1):
        np.maximum(above[..., :-step], passes[..., step:], out=above[..., :-step])
        np.maximum(below[..., step:], passes[..., :-step], out=below[..., step:])
    filled = np.maximum(passes, np.minimum(above, below))
    inner = slice(_MAX_GAP, -_MAX_GAP)
    return hits[..., inner], filled[..., inner]


def measure_evidence(
    keyframes: Keyframes, poses: Float, resolution: float, threads: int
) -> Evidence:
    """The sums (10) of keyframes at poses (K, D+1, D+1) in the place.

    Beams without a return are left out: they may have met glass.
    """
    D = keyframes.dimension
    kind = _core.OccupancyGrid2D if D == 2 else _core.OccupancyGrid3D
    grid = kind(resolution, _APPROACH)
    em.add_recording(grid, keyframes.recording, poses, keyframes.e, threads, hits_only=True)
    return _export(grid, D, resolution)


def _export(grid: em.Grid, D: int, resolution: float) -> Evidence:
    """The blocks of a grid that hold something."""
    edge = BLOCK[D]
    lowest = np.unique(np.asarray(grid.block_cells) // edge * edge, axis=0)
    corner, hits, passes = [], [], []
    for first in lowest.tolist():
        _, alpha, beta = grid.dense(first, (edge,) * D)
        if alpha.any() or beta.any():
            corner.append(first)
            # the grid's arrays have the last axis first
            hits.append(_to_bytes(alpha.transpose()))
            passes.append(_to_bytes(beta.transpose()))
    shape = (len(corner), *(edge,) * D)
    return Evidence(
        np.array(corner, np.int32).reshape(-1, D),
        np.array(hits, np.uint8).reshape(shape),
        np.array(passes, np.uint8).reshape(shape),
        resolution,
    )


def to_sums(units: NDArray[np.unsignedinteger]) -> NDArray[np.float32]:
    """Hits or passes of what `Evidence.crop` counts."""
    return units.astype(np.float32) / np.float32(UNITS)


def _to_bytes(sums: Float) -> Bytes:
    # never 0 where there is something
    return np.minimum(np.ceil(UNITS * sums), _MAX_BYTE).astype(np.uint8)
