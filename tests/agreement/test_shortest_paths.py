"""Shortest paths through a graph: kernel against scipy, by hand, and its errors."""

import numpy as np
import pytest
from scipy.sparse import csgraph, csr_array

from stillmap import _core


def chain(n, rng, ties):
    """A chain of n nodes with ties between some of them, each pair tied once."""
    pairs = np.array([(a, b) for a in range(n) for b in range(a + 2, n)])
    tied = pairs[rng.choice(len(pairs), ties, replace=False)]
    edges = np.concatenate([np.stack([np.arange(n - 1), np.arange(1, n)], axis=1), tied])
    return np.ascontiguousarray(edges), rng.uniform(0.1, 3.0, len(edges))


@pytest.mark.parametrize("ties", [1, 7, 60])
def test_lengths_are_those_of_scipy_to_the_bit(ties):
    edges, lengths = chain(50, np.random.default_rng(ties), ties)
    graph = csr_array((lengths, edges.T), shape=(50, 50))
    expected = csgraph.dijkstra(graph, directed=False, indices=[30])[0]
    np.testing.assert_array_equal(_core.shortest_paths(edges, lengths, 50, 30), expected)


def test_of_edges_between_the_same_nodes_the_shortest_counts():
    edges = np.array([[0, 1], [1, 0], [1, 2]])
    found = _core.shortest_paths(edges, np.array([5.0, 2.0, 0.0]), 4, 0)
    assert found.tolist() == [0.0, 2.0, 2.0, np.inf]
