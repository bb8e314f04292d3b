"""Boxes for dense arrays of squares: around everything seen, or around most of it.

One pose that is kilometres off makes the box around all squares nearly empty, and too large for
memory and disk. So a box that is much larger than what was seen shrinks: to the place where most
was seen, whole if it is connected, and to what lies near it.
"""

import functools
import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from stillmap.core.array_types import Index

# up to so many cells or nodes NumPy alone is faster than loading SciPy, which takes 0.3 s
_FEW_CELLS, _FEW_NODES = 300, 10_000


def neighbor_pairs(cells: NDArray[np.int64], max_distance: float) -> Index:
    """(P, 2) pairs of cells (K, D) within a distance of each other, in cells."""
    if len(cells) <= _FEW_CELLS:
        squared = ((cells[:, None] - cells) ** 2).sum(axis=2)
        return np.argwhere(np.triu(squared <= max_distance**2, 1))
    from scipy.spatial import cKDTree

    return np.asarray(cKDTree(cells).query_pairs(max_distance, output_type="ndarray"), np.intp)


def adjacent_pairs(cells: NDArray[np.int64]) -> Index:
    """(P, 2) pairs of cells (K, D) that touch, if only in a corner; no cell may come twice."""
    if not len(cells):
        return np.empty((0, 2), np.intp)
    D, shifted = cells.shape[1], cells - cells.min(axis=0)
    # a layer at the end of each axis stays empty: rows do not touch
    stride = np.append(np.cumprod((shifted.max(axis=0) + 2)[:0:-1])[::-1], 1)
    key = shifted @ stride
    order = np.argsort(key)
    key = key[order]
    pairs = []
    for offset in itertools.product((-1, 0, 1), repeat=D):
        if offset <= (0,) * D:
            continue
        step = int(stride @ offset)
        at = np.minimum(np.searchsorted(key, key + step), len(key) - 1)
        is_cell = key[at] == key + step
        pairs.append(np.column_stack([order[is_cell], order[at[is_cell]]]))
    return np.concatenate(pairs)


def component_labels(pairs: Index, n: int) -> Index:
    """(n,) number of the connected component of each of n nodes, given edges (P, 2)."""
    if not len(pairs):
        return np.arange(n)
    if n <= _FEW_NODES:
        return _label_few(pairs, n)
    from scipy.sparse import coo_array, csgraph

    graph = coo_array((np.ones(len(pairs), bool), pairs.T), shape=(n, n))
    _, label = csgraph.connected_components(graph, directed=False)
    return np.asarray(label, np.intp)


def _label_few(pairs: Index, n: int) -> Index:
    """Components numbered by their first nodes: each node takes the lowest of its neighbours."""
    first = np.arange(n)
    node, neighbor = np.ascontiguousarray(pairs.T)
    while True:
        lowest = np.minimum(first[node], first[neighbor])
        before = first.copy()
        np.minimum.at(first, node, lowest)
        np.minimum.at(first, neighbor, lowest)
        first = first[first]
        if np.array_equal(first, before):
            return np.asarray(np.unique(first, return_inverse=True)[1], np.intp)


def connected_components(pairs: Index, n: int) -> list[Index]:
    """Members, rising, of each connected component of a graph of n nodes with edges (P, 2)."""
    return group_indices(component_labels(pairs, n))


def group_indices(label: Index) -> list[Index]:
    """Indices, rising, of each group of equal labels; groups in the order of labels."""
    if not len(label):
        return []
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)


Squares = NDArray[np.int64]

_MOST_PER_SEEN = 64  # squares of a box for each that was seen
_GAP = 16  # squares, about, between parts of one place, which stays whole


class SquareBox(NamedTuple):
    """A box of squares, bounds included.

    Attributes:
        low, high: (2,) lowest and highest column and row.
    """

    low: Squares
    high: Squares

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns."""
        width, height = (self.high - self.low + 1).tolist()
        return height, width

    @property
    def area(self) -> int:
        """Number of squares."""
        return math.prod(self.shape)

    def contains(self, squares: NDArray[Any]) -> NDArray[np.bool_]:
        """(N,) whether squares (N, 2) lie in the box."""
        return np.asarray(((squares >= self.low) & (squares <= self.high)).all(axis=1))


def bound_box(
    squares: Squares,
    least: int,
    most: int,
    *,
    places: NDArray[np.int64] | None = None,
    around: SquareBox | None = None,
) -> SquareBox:
    """The box around squares; of a box nearly empty, the part around where most of them are.

    Args:
        squares: (N, 2) columns and rows, at least one; they may repeat.
        least: area up to which every box is whole.
        most: area that no box exceeds.
        places: (K, 2) squares of which the part has to hold most; None: `squares`.
        around: a larger box, to be returned if it is not nearly empty; None: none.
    """
    whole = SquareBox(squares.min(axis=0), squares.max(axis=0)) if around is None else around
    if whole.area <= least:
        return whole
    limit = min(max(least, _MOST_PER_SEEN * len(np.unique(cell_keys(squares)))), most)
    if whole.area <= limit:
        return whole
    center = find_busiest(squares if places is None else places, math.isqrt(limit) // 2)
    distance = np.abs(squares - center).max(axis=1)
    joined = _find_joined(squares, distance)
    order = np.lexsort((distance, ~joined))
    low = np.minimum.accumulate(squares[order], axis=0)
    high = np.maximum.accumulate(squares[order], axis=0)
    areas = (high - low + 1).astype(np.float64).prod(axis=1)  # of the boxes around the first
    limit = min(max(limit, int(areas[np.count_nonzero(joined) - 1])), most)
    last = int(np.searchsorted(areas, float(limit), side="right")) - 1
    return SquareBox(low[last], high[last])


def _find_joined(squares: Squares, distance: Squares) -> NDArray[np.bool_]:
    """(N,) squares that others without larger gaps join to the one at the least distance (N,)."""
    large, of = np.unique(squares // _GAP, axis=0, return_inverse=True)
    part = component_labels(adjacent_pairs(large), len(large))[of.reshape(-1)]
    return np.asarray(part == part[np.argmin(distance)])


def find_busiest(places: Squares, edge: int) -> Squares:
    """(2,) median of the places (K, 2) in the square of `edge` places that holds most of them."""
    keys = cell_keys(places // max(edge, 1))
    number, count = np.unique(keys, return_counts=True)
    chosen = places[keys == number[np.argmax(count)]]
    return np.asarray(np.sort(chosen, axis=0)[len(chosen) // 2])


def cell_keys(cells: NDArray[np.integer]) -> Squares:
    """(...) a number for each cell (..., D), in their order: column by column.

    Columns of other than the first lie within 2 ** 31, in 3D all within 2 ** 20 of zero.
    """
    columns = np.moveaxis(cells, -1, 0).astype(np.int64, copy=False)
    bits = 64 // len(columns)
    return functools.reduce(lambda key, column: (key << bits) + column, columns)
