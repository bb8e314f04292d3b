"""Which cells belong together."""

import numpy as np
import scipy  # its parts load when they are first used
from numpy.typing import NDArray

Index = NDArray[np.intp]


def pairs_near(cells: NDArray[np.int64], distance: float) -> Index:
    """(P, 2) which of the cells (K, D) lie within a distance of each other, in cells."""
    if not len(cells):
        return np.empty((0, 2), np.intp)
    return np.asarray(
        scipy.spatial.cKDTree(cells).query_pairs(distance, output_type="ndarray"), np.intp
    )


def components(pairs: Index, n: int) -> list[Index]:
    """The members, rising, of every set of 0 to n - 1 that the pairs (P, 2) connect."""
    if n == 0:
        return []
    graph = scipy.sparse.coo_array(
        (np.ones(len(pairs), bool), (pairs[:, 0], pairs[:, 1])), shape=(n, n)
    )
    _, label = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(label, kind="stable")
    return np.split(order, np.flatnonzero(np.diff(label[order])) + 1)
