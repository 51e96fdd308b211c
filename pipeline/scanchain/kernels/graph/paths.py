"""Shortest paths through a graph that is mostly a chain; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit


@njit(nogil=True)
def path_lengths(
    edges: NDArray[np.int64], lengths: NDArray[np.float64], count: int, source: int, limit: float
) -> NDArray[np.float64]:
    """Length (count,) of the shortest path from one node to every node, infinite beyond the limit (Bellman 1958).

    All edges are relaxed back and forth until nothing changes: for a chain, one pass is enough.

    edges : (E, 2) pairs of nodes, passed in both directions; lengths : (E,) ≥ 0, infinite for a closed one
    """
    result = np.full(count, np.inf)
    result[source] = 0.0
    is_backward, is_shorter = True, True
    while is_shorter:
        is_shorter = False
        for k in range(len(edges)):
            edge = len(edges) - 1 - k if is_backward else k
            i, j = edges[edge]
            if result[i] > result[j]:
                i, j = j, i
            there = result[i] + lengths[edge]
            if there < result[j] and there <= limit:
                result[j], is_shorter = there, True
        is_backward = not is_backward
    return result
