"""The cells in which the beams of a session ended, by which a place labels them.

They lie in the session's own frame, so that they hold wherever the place puts the session.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from stillmap.core import arrays, se2
from stillmap.core.recording import Recording
from stillmap.core.short_repr import ShortRepr
from stillmap.slam import PoseGraph

Float = NDArray[np.float64]


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

    cells: NDArray[np.int32]
    node: NDArray[np.int32]
    of_beam: NDArray[np.int32]
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
    deskewed: Recording,
    poses: Float,
    p_static: NDArray[np.float32],
    graph: PoseGraph,
    resolution: float,
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
) -> Iterator[tuple[NDArray[np.intp], NDArray[np.int32]]]:
    """Beams (n,) that hit, and the cells (n, D) in which they ended, block by block."""
    for block in arrays.iter_blocks(recording.hit):
        beams = block.start + np.flatnonzero(recording.hit[block])
        ends = recording.end_points(beams, poses)
        yield beams, np.floor(ends / resolution).astype(np.int32)


def cell_keys(cells: NDArray[np.integer]) -> NDArray[np.int64]:
    """(N,) keys of cells (N, D), which sort as the cells do, column by column."""
    bits = 63 // cells.shape[1]
    key = np.zeros(len(cells), np.int64)
    for column in cells.T:
        key = (key << bits) + (column.astype(np.int64) + (1 << (bits - 1)))
    return key
