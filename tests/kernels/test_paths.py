"""Shortest paths through a chain with loops, against those of SciPy."""

import numpy as np
from scipy.sparse.csgraph import csgraph_from_dense, dijkstra

from scanchain.kernels.graph.paths import path_lengths


def test_paths_through_a_chain_with_loops_are_the_shortest():
    rng, count = np.random.default_rng(0), 400
    edges = np.vstack(
        [np.column_stack([np.arange(count - 1), np.arange(1, count)]), rng.integers(0, count, (60, 2))]
    )
    edges = edges[edges[:, 0] != edges[:, 1]]
    lengths = np.where(rng.random(len(edges)) < 0.05, np.inf, rng.uniform(0.1, 2.0, len(edges)))
    matrix = np.full((count, count), np.inf)
    np.minimum.at(matrix, tuple(np.vstack([edges, edges[:, ::-1]]).T), np.tile(lengths, 2))
    for limit in (5.0, 1e9):
        wanted = dijkstra(csgraph_from_dense(matrix, null_value=np.inf), indices=count - 1, limit=limit)
        np.testing.assert_array_equal(path_lengths(edges, lengths, count, count - 1, limit), wanted)
