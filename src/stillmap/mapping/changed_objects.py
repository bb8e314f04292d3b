"""Objects that came and left: which changes are of one object, and the state of all its cells."""

from typing import NamedTuple

import numpy as np

from stillmap import em
from stillmap.core.array_types import Bool, Cells, Float, Float32, Index
from stillmap.core.square_box import connected_components, neighbor_pairs
from stillmap.mapping.change_detection import Change
from stillmap.mapping.doors import is_row

_RADIUS = 3.0  # cells between cells of a recurring change that decide together
_MIN_WEIGHT = 1e-3


class ShownCells(NamedTuple):
    """The map in some state, in E cells.

    Attributes:
        listed: (E,) cells that changes concern.
        p_in_map: (E,) float32, probability that the map shows something there.
        p_leaf: (E,) float32, probability that it is the leaf of a door, in any position.
    """

    listed: Bool
    p_in_map: Float32
    p_leaf: Float32


def find_shown_cells(
    histories: em.CellHistories, changes: list[Change], state: em.MapState
) -> ShownCells:
    """The map in some state, in the cells of places that changed.

    Args:
        histories: of E cells.
        changes: from `detect_changes`, and `join_doors`.
        state: state of changed places that the map shows.
    """
    keys = cell_keys(histories.cells)
    listed = np.isin(keys, cell_keys(np.concatenate([one.cells for one in changes])))
    p = histories.p_in_map(state, pool_states(histories, changes, state))
    p_leaf = _weigh_leaves(keys, changes)
    for door in (one.door for one in changes if one.door is not None):
        shown = door.position_in(state)
        for position, leaf in (("open", door.open_cells), ("shut", door.shut_cells)):
            of = _rows(keys, leaf)
            p_leaf[of], p[of], listed[of] = 1.0, float(position == shown), True
    return ShownCells(listed, p, p_leaf)


def _weigh_leaves(keys: Cells, changes: list[Change]) -> Float32:
    """(E,) probability that what changed in the cells with these keys is the leaf of a door.

    A straight row of cells that changed may be a leaf that was seen in one position only, or one
    side of a thing. Of all such rows, the share that others are doors by what was seen of them.
    """
    doors = [one for one in changes if one.door is not None]
    rows = [one for one in changes if one.door is None and is_row(one.cells, one.resolution)]
    share = (len(doors) + 1.0) / (len(doors) + len(rows) + 2.0)
    out = np.zeros(len(keys), np.float32)
    for some, p in ((rows, share), (doors, 1.0)):
        for one in some:
            out[_rows(keys, one.cells)] = p
    return out


def pool_states(histories: em.CellHistories, changes: list[Change], state: em.MapState) -> Float32:
    """(E,) `share_there` of each cell, the same in all cells of an object.

    Each cell was observed at times of its own, so that the modal state of an object that was moved
    between two visits differs from cell to cell. An object takes the mean over its cells. Where
    something comes and goes, cells nearby decide together.

    Args:
        histories: of E cells.
        changes: from `detect_changes`.
        state: state of changed places that the map shows.
    """
    keys = cell_keys(histories.cells)
    share = histories.share_there(state)
    weight = np.maximum(histories.p_changing, _MIN_WEIGHT).astype(np.float64)
    out = share.copy()
    recurring = [one.cells for one in changes if one.kind == "comes and goes"]
    if recurring:
        of = _rows(keys, np.concatenate(recurring))
        out[of] = _local_mean(histories.cells[of], share[of], weight[of])
    moved = [one for one in changes if one.kind in ("came", "left")]
    members = [
        _rows(keys, np.concatenate([moved[k].cells for k in one])) for one in group_objects(moved)
    ]
    for of in members:
        out[of] = 0.0
    for of in filter(len, members):  # where two objects stood in turn, the likelier one
        out[of] = np.maximum(out[of], np.average(share[of], weights=weight[of]))
    return out


def _rows(keys: Cells, cells: Cells) -> Index:
    """Rows, rising, of cells (K, 2) among those with the keys (E,)."""
    return np.flatnonzero(np.isin(keys, cell_keys(cells)))


def _local_mean(cells: Cells, share: Float32, weight: Float) -> Float:
    """(K,) weighted mean of the share (K,) of the cells (K, 2) within a radius of each."""
    pairs = neighbor_pairs(cells, _RADIUS)
    one, other = np.concatenate([pairs, pairs[:, ::-1]]).T
    sums = [
        value + np.bincount(one, value[other], minlength=len(cells))
        for value in (weight * share, weight)
    ]
    return np.asarray(sums[0] / sums[1])


def group_objects(changes: list[Change]) -> list[Index]:
    """Indices, rising, of the changes of each object: those of the same place."""
    xy = np.array([(one.x, one.y) for one in changes]).reshape(-1, 2)
    size = np.array([one.size[:2] for one in changes]).reshape(-1, 2)
    near = (np.abs(xy[:, None] - xy) <= size[:, None] + size).all(axis=2)
    pairs = [
        pair
        for pair in np.argwhere(np.triu(near, 1)).tolist()
        if is_same_place(changes[pair[0]], changes[pair[1]])
    ]
    return connected_components(np.array(pairs, np.intp).reshape(-1, 2), len(changes))


def is_same_place(one: Change, other: Change) -> bool:
    """True if the larger of two places holds more than half of the smaller."""
    distance = np.abs([one.x - other.x, one.y - other.y])
    if np.any(distance > np.array(one.size) + np.array(other.size)):
        return False
    smaller, larger = sorted((one.cells, other.cells), key=len)
    return bool(np.mean(np.isin(cell_keys(smaller), cell_keys(larger))) > 0.5)


def cell_keys(cells: Cells) -> Cells:
    """(N,) one key per cell (N, 2); map coordinates stay far below 2 ** 31 cells."""
    return np.asarray((cells[:, 0] << 32) + cells[:, 1], np.int64)
