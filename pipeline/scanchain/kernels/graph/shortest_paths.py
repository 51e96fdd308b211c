"""Shortest paths through a graph from one of its nodes (Dijkstra 1959)."""

import heapq

import numpy as np

from scanchain.kernels.compiling import njit


@njit(nogil=True)
def shortest_paths(edges, lengths, count: int, source: int, limit: float):
    """Length (count,) of the shortest path from the source to every node, infinite beyond the limit.

    edges : (E, 2) int64 node pairs, traversed in both directions
    lengths : (E,) ≥ 0, infinite for a closed edge
    """
    first, neighbors, distances = _neighbors(edges, lengths, count)
    result = np.full(count, np.inf)
    result[source] = 0.0
    heap = [(0.0, source)]
    while len(heap):
        length, node = heapq.heappop(heap)
        if length > result[node]:
            continue
        for k in range(first[node], first[node + 1]):
            there = length + distances[k]
            if there <= limit and there < result[neighbors[k]]:
                result[neighbors[k]] = there
                heapq.heappush(heap, (there, neighbors[k]))
    return result


@njit(nogil=True)
def _neighbors(edges, lengths, count: int):
    """The neighbors of node n and the lengths to them: rows first[n] to first[n + 1]."""
    first = np.zeros(count + 2, np.int64)
    for e in range(edges.shape[0]):
        first[edges[e, 0] + 2] += 1
        first[edges[e, 1] + 2] += 1
    for node in range(1, count + 2):
        first[node] += first[node - 1]
    neighbors = np.empty(2 * edges.shape[0], np.int64)
    distances = np.empty(2 * edges.shape[0])
    for e in range(edges.shape[0]):
        for end in range(2):
            row = first[edges[e, end] + 1]
            first[edges[e, end] + 1] += 1
            neighbors[row], distances[row] = edges[e, 1 - end], lengths[e]
    return first, neighbors, distances
