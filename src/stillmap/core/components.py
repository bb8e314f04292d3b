"""Neighbouring cells and the connected components of graphs."""

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

Index = NDArray[np.intp]


def neighbor_pairs(cells: NDArray[np.int64], max_distance: float) -> Index:
    """(P, 2) pairs of cells (K, D) within a distance of each other, in cells."""
    if not len(cells):
        return np.empty((0, 2), np.intp)
    return np.asarray(
        scipy.spatial.cKDTree(cells).query_pairs(max_distance, output_type="ndarray"), np.intp
    )


def component_labels(pairs: Index, n: int) -> Index:
    """(n,) number of the connected component of each of n nodes, given edges (P, 2)."""
    if n == 0:
        return np.empty(0, np.intp)
    graph = scipy.sparse.coo_array((np.ones(len(pairs), bool), pairs.T), shape=(n, n))
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    return np.asarray(label, np.intp)


def connected_components(pairs: Index, n: int) -> list[Index]:
    """Members, rising, of each connected component of a graph of n nodes with edges (P, 2)."""
    return group_indices(component_labels(pairs, n))


def group_indices(label: Index) -> list[Index]:
    """Indices, rising, of each group of equal labels; groups in the order of labels."""
    if not len(label):
        return []
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
