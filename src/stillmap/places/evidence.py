"""Evidence of a session in the frame of its place: sums of hits and passes of its keyframes, (10).

Stored in blocks of cells, in 2D and 3D alike: one byte for the expected number of static hits of a
cell, and one for the length by which beams passed through it, in cells. And the cells in which its
beams ended, by which a place labels them: in the session's own frame, so that they hold wherever
the place puts the session.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

import stillmap._core as _core
from stillmap import em
from stillmap.core import arrays, se2
from stillmap.core.array_types import Float, Float32, Index, Int32, Int64
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.core.square_box import cell_keys
from stillmap.places.keyframes import Keyframes
from stillmap.slam import PoseGraph


@dataclass(frozen=True, eq=False)
class BeamCells(ShortRepr):
    """The cells of a session in which its M beams ended, and its own labels.

    Attributes:
        cells: (C, D) int32, in the session's frame, sorted.
        node: (C,) int32, the pose graph's node nearest in time to the first beam of each.
        of_beam: (M,) int32, cell of each beam; -1: no hit.
        p_static: (M,) float16, P(static) by the session alone; NaN: unusable.
        resolution: m, edge of a cell.
    """

    cells: Int32
    node: Int32
    of_beam: Int32
    p_static: NDArray[np.float16]
    resolution: float

    def place_centres(self, session_nodes: Float, place_nodes: Float) -> Float:
        """(C, D) centres of the cells in the frame of the place.

        Args:
            session_nodes, place_nodes: (N, D+1, D+1) poses of the nodes in both frames.
        """
        D = self.cells.shape[1]
        correction = (place_nodes @ se2.inverse(session_nodes))[self.node]
        centres = (self.cells + 0.5) * self.resolution
        out: Float = np.einsum("nij,nj->ni", correction[:, :D, :D], centres) + correction[:, :D, D]
        return out


def find_beam_cells(
    deskewed: Recording, poses: Float, p_static: Float32, graph: PoseGraph, resolution: float
) -> BeamCells:
    """The cells in which the beams of a session ended.

    Args:
        deskewed: T scans with M beams.
        poses: (T, D+1, D+1) T_session_base.
        p_static: (M,) P(static) by the session alone.
        graph: of the session.
        resolution: m, edge of a cell.
    """
    cells = np.zeros((0, deskewed.dimension), np.int32)
    for _, ended in _iter_end_cells(deskewed, poses, resolution):
        cells = np.unique(np.concatenate([cells, ended]), axis=0)
    key = cell_keys(cells)
    of_beam = deskewed.allocate_per_beam(np.int32)
    own = deskewed.allocate_per_beam(np.float16)
    for block in arrays.iter_blocks(of_beam):
        of_beam[block] = -1
        own[block] = p_static[block]
    first_beam = np.full(len(cells), deskewed.n_beams, np.int64)
    for beams, ended in _iter_end_cells(deskewed, poses, resolution):
        at = np.searchsorted(key, cell_keys(ended))
        of_beam[beams] = at
        np.minimum.at(first_beam, at, beams)
    node = np.searchsorted(graph.keyframes, deskewed.scans_of(first_beam))
    node = np.clip(node, 0, len(graph.keyframes) - 1)
    return BeamCells(cells, np.asarray(node, np.int32), of_beam, own, resolution)


def _iter_end_cells(
    recording: Recording, poses: Float, resolution: float
) -> Iterator[tuple[Index, Int32]]:
    """Beams (n,) that hit, and the cells (n, D) in which they ended, block by block."""
    for block in arrays.iter_blocks(recording.hit):
        beams = block.start + np.flatnonzero(recording.hit[block])
        ends = recording.end_points(beams, poses)
        yield beams, np.floor(ends / resolution).astype(np.int32)


def look_up(
    cells: NDArray[np.integer], values: NDArray[Any], sought: Int64, default: float
) -> NDArray[Any]:
    """(n,) the values (K,) of cells (K, D) that are sought (n, D); a default for all others."""
    if not len(cells):
        return np.full(len(sought), default)
    keys, wanted = cell_keys(cells), cell_keys(sought)
    order = np.argsort(keys)
    at = order[np.minimum(np.searchsorted(keys, wanted, sorter=order), len(keys) - 1)]
    return np.where(keys[at] == wanted, values[at], default)


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

    corner: Int32
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

    def crop(self, low: Int64, shape: tuple[int, ...]) -> tuple[Bytes, Bytes]:
        """Hits and passes, in units of 1 / UNITS, in a box of cells from `low` (D,) on; 0 where
        nothing was observed."""
        edge = self.edge
        first = low // edge
        count = -(-(low + shape) // edge) - first
        at = self.corner // edge - first
        inside = np.flatnonzero(((at >= 0) & (at < count)).all(axis=1))
        blocks = tuple(i for column in at[inside].T for i in (column, slice(None)))
        whole = tuple((count * edge).tolist())
        split = tuple(n for n_blocks in count.tolist() for n in (n_blocks, edge))
        start = (low - first * edge).tolist()
        box = tuple(slice(begin, begin + n) for begin, n in zip(start, shape, strict=True))
        out = []
        for sums in (self.hits, self.passes):
            grid = np.zeros(split, np.uint8)
            grid[blocks] = sums[inside]
            out.append(grid.reshape(whole)[box])
        return out[0], out[1]


def crop_without_gaps(
    evidence: Evidence, low: Int64, shape: tuple[int, ...]
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


def to_sums(units: NDArray[np.unsignedinteger]) -> Float32:
    """Hits or passes of what `Evidence.crop` counts."""
    return units.astype(np.float32) / np.float32(UNITS)


def _to_bytes(sums: Float) -> Bytes:
    # never 0 where there is something
    return np.minimum(np.ceil(UNITS * sums), _MAX_BYTE).astype(np.uint8)
