"""Poses along a spanning tree of the graph; compiled."""

import numpy as np
from numpy.typing import NDArray

from scanchain.kernels.compiling import njit

_Array = NDArray[np.float64]
_Index = NDArray[np.int64]


@njit(nogil=True)
def follow_tree(start: _Index, incident: _Index, edges: _Index, Z: _Array, poses: _Array, reached: _Index) -> None:
    """Chain measurements breadth first from the poses that are already reached.

    start (K + 1,), incident : edges at every pose; edges (E, 2), Z (E, d+1, d+1) mapping frame j to frame i
    poses (K, d+1, d+1), reached (K,) 0 or 1 : updated
    """
    n, d = poses.shape[0], poses.shape[1] - 1
    queue, tail = np.empty(n, np.int64), 0
    for v in range(n):
        if reached[v] == 1:
            queue[tail] = v
            tail += 1
    head = 0
    while head < tail:
        v = queue[head]
        head += 1
        for q in range(start[v], start[v + 1]):
            e = incident[q]
            forward = edges[e, 0] == v
            other = edges[e, 1] if forward else edges[e, 0]
            if reached[other] == 1:
                continue
            reached[other] = 1
            queue[tail] = other
            tail += 1
            _step(poses[v], Z[e], forward, poses[other], d)


@njit(nogil=True)
def _step(T: _Array, Z: _Array, forward: bool, result: _Array, d: int) -> None:
    """Write T Z, or T Z⁻¹ where the edge is followed against its direction."""
    result[:] = 0.0
    result[d, d] = 1.0
    for a in range(d):
        result[a, d] = T[a, d]
        for b in range(d):
            for c in range(d):
                result[a, b] += T[a, c] * (Z[c, b] if forward else Z[b, c])
        if forward:
            for c in range(d):
                result[a, d] += T[a, c] * Z[c, d]
    if not forward:
        for a in range(d):
            for c in range(d):
                result[a, d] -= result[a, c] * Z[c, d]
