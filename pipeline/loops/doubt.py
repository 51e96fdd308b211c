"""How far the pose graph may be off between two keyframes: the drift of the shortest way that joins them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.graph.growing_array import GrowingArray
from scanchain.graph.pose_graph import PoseGraph
from scanchain.kernels.graph.shortest_paths import shortest_ways

_CLOSED = 0.5  # weight that the robust loss leaves to a loop edge, from which on it joins two places
_LOOP_M = 1e-3  # length of such an edge


class Doubt:
    """The way of odometry that lies between keyframes, by loops where these are shorter.

    An edge is as long as it leads or, where odometry was unsure, as a way on which it would have drifted as far.
    """

    def __init__(self, drift: float) -> None:
        """By how much odometry drifts, meters a meter."""
        self.drift = drift
        self.lengths = GrowingArray((), np.float64)

    def between(self, graph: PoseGraph, keyframe: int, limit_m: float) -> NDArray[np.float64]:
        """Meters (K,) that each keyframe of the graph may be off as seen from one of them, at most the limit."""
        self._learn(graph)
        is_open = ~graph.is_loop | (graph.weight > _CLOSED)
        lengths = np.where(is_open, self.lengths.rows, np.inf)
        meters = shortest_ways(graph.edges, lengths, len(graph), keyframe, limit_m / self.drift)
        return np.minimum(self.drift * meters, limit_m)

    def _learn(self, graph: PoseGraph) -> None:
        """Measure the edges that are new."""
        new = slice(len(self.lengths), len(graph.edges))
        d = graph.dimension
        ways_m = np.linalg.norm(graph.measurements[new][:, :d, d], axis=1)
        covariances = np.linalg.inv(graph.information[new])
        sigmas_m = np.sqrt(np.trace(covariances[:, :d, :d], axis1=1, axis2=2))
        lengths = np.where(graph.is_loop[new], _LOOP_M, np.maximum(ways_m, sigmas_m / self.drift))
        self.lengths.extend(lengths)
