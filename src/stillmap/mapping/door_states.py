"""When doors were open and shut, from the beams that ended on their leaves."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.arrays import iter_blocks
from stillmap.core.components import group_indices
from stillmap.core.recording import Recording
from stillmap.mapping.door import Door, DoorState, Position

Float = NDArray[np.float64]
Cells = NDArray[np.int64]

_BIN_NS = 10**9  # in which the cells that were hit make one observation
# share of the cells of a leaf that are hit in an observation: who walks through hits fewer
_MIN_SHARE = 0.35
_RATIO = 2.0  # of that share to the one of the other position


def observe_states(
    doors: Sequence[Door], recording: Recording, poses: Float, resolution: float
) -> list[tuple[DoorState, ...]]:
    """The states of each door: its leaf is where beams end on much of one of its positions.

    Args:
        doors: with the cells of both positions.
        recording: T scans.
        poses: (T, 3, 3) T_map_base.
        resolution: m, edge of a cell.
    """
    masks = [_LeafMask.of_door(door) for door in doors]
    seen: list[list[NDArray[np.int64]]] = [[np.empty((0, 2), np.int64)] for _ in doors]
    for block in iter_blocks(recording.hit):
        beam = block.start + np.flatnonzero(recording.hit[block])
        scan = recording.scans_of(beam)
        cells = np.floor(recording.end_points(beam, poses) / resolution).astype(np.int64)
        for mask, rows in zip(masks, seen, strict=True):
            number = mask.find(cells)
            on_leaf = np.flatnonzero(number >= 0)
            rows.append(np.unique(np.column_stack([scan[on_leaf], number[on_leaf]]), axis=0))
    return [
        _list_states(mask, np.concatenate(rows), recording.stamp_ns)
        for mask, rows in zip(masks, seen, strict=True)
    ]


class _LeafMask(NamedTuple):
    """Numbers of the cells of both positions in a box from `low` on; -1: none.

    Those of the shut leaf come first, `n_shut` of them, then `n_open`.
    """

    low: Cells
    number: NDArray[np.int64]
    n_shut: int
    n_open: int

    @classmethod
    def of_door(cls, door: Door) -> "_LeafMask":
        cells = np.concatenate([door.shut_cells, door.open_cells])
        low = cells.min(axis=0)
        number = np.full(cells.max(axis=0) - low + 1, -1, np.int64)
        number[tuple((cells - low).T)] = np.arange(len(cells))
        return cls(low, number, len(door.shut_cells), len(door.open_cells))

    def find(self, cells: Cells) -> NDArray[np.int64]:
        """(N,) the numbers of cells (N, 2)."""
        out = np.full(len(cells), -1, np.int64)
        inside = ((cells >= self.low) & (cells < self.low + self.number.shape)).all(axis=1)
        out[inside] = self.number[tuple((cells[inside] - self.low).T)]
        return out


def _list_states(
    mask: _LeafMask, hits: NDArray[np.int64], stamp_ns: NDArray[np.int64]
) -> tuple[DoorState, ...]:
    """Runs of observations (N, 2), of scan and cell, that saw the leaf in the same position."""
    out: list[DoorState] = []
    bins = (stamp_ns[hits[:, 0]] - stamp_ns[0]) // _BIN_NS
    for one in group_indices(bins):
        scans, number = hits[one].T
        number = np.unique(number)
        n_shut = int(np.count_nonzero(number < mask.n_shut))
        shares = {"shut": n_shut / mask.n_shut, "open": (len(number) - n_shut) / mask.n_open}
        position: Position = "shut" if shares["shut"] >= shares["open"] else "open"
        if shares[position] < max(_MIN_SHARE, _RATIO * min(shares.values())):
            continue
        first, last = int(stamp_ns[scans.min()]), int(stamp_ns[scans.max()])
        if out and out[-1].position == position:
            first = out.pop().since_ns
        out.append(DoorState(position, first, last))
    return tuple(out)
