"""Neighbouring cells and the connected components of graphs."""

import itertools

import numpy as np
from numpy.typing import NDArray

Index = NDArray[np.intp]


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
    one, other = np.ascontiguousarray(pairs.T)
    while True:
        lowest = np.minimum(first[one], first[other])
        before = first.copy()
        np.minimum.at(first, one, lowest)
        np.minimum.at(first, other, lowest)
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
