"""Connectivity of keyframes in the pose graph: segments that no loop joins yet, and drift along shortest paths."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from scanchain.data import DOWNWEIGHTED
from scanchain.graph.pose_graph import PoseGraph
from scanchain.growing_array import GrowingArray
from scanchain.kernels.graph.paths import path_lengths


class Segments:
    """The segments of a trajectory; each ends where the motion to the next keyframe is unknown."""

    def __init__(self) -> None:
        self.starts = [0]
        self.assumed = -1  # number of the segment that the newest one is assumed to be joined to, while tested

    def start(self, keyframe: int) -> None:
        """Start a new segment at this keyframe."""
        self.starts.append(keyframe)

    @property
    def is_assumed(self) -> bool:
        """True while the pose of the newest segment is being tested."""
        return self.assumed >= 0

    def assume(self, target: int) -> None:
        """Count the newest segment as joined to that of a keyframe; to none for −1."""
        self.assumed = int(self.of(np.array(target)))

    def of(self, keyframes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Number of the segment of each keyframe."""
        return np.searchsorted(self.starts, keyframes, side="right") - 1

    def span(self, keyframe: int, count: int) -> tuple[int, int]:
        """First keyframe and end of a keyframe's segment, out of ``count`` keyframes."""
        number = int(self.of(np.array(keyframe)))
        return self.starts[number], [*self.starts[1:], count][number]

    def components(self, graph: PoseGraph, *, with_assumed: bool = True) -> NDArray[np.int64]:
        """Number of the connected component of each keyframe (K,): segments that loops join have the same one.

        with_assumed : whether the newest segment counts as joined to the one where it is being tested
        """
        count = len(self.starts)
        segment = np.repeat(np.arange(count), np.diff([*self.starts, len(graph)]))
        if count == 1:
            return segment
        ends = segment[graph.edges[graph.is_loop & (graph.weight > DOWNWEIGHTED)]]
        number = np.arange(count)
        for pair in np.unique(ends[:, 0] * count + ends[:, 1]).tolist():
            i, j = divmod(pair, count)
            number[number == number[j]] = number[i]
        if with_assumed and self.is_assumed:
            number[number == number[-1]] = number[self.assumed]
        return np.unique(number, return_inverse=True)[1].astype(np.int64)[segment]


class Drift:
    """Position uncertainty between keyframes: the drift of odometry along the shortest path that connects them.

    The length of an edge is that of its translation or, where odometry was more uncertain, that of a path with a
    drift equal to the edge's standard deviation; loops have none, as they add next to no drift.
    """

    def __init__(self, drift: float) -> None:
        """Drift : of odometry, meters per meter."""
        self.drift = drift
        self.lengths = GrowingArray((), np.float64)

    def measure(self, graph: PoseGraph) -> None:
        """Add the lengths of the edges that are new since the last call, with odometry as corrected now.

        Edges that are neither odometry nor loops are not part of any path.
        """
        if len(self.lengths) == len(graph.edges):
            return
        new = slice(len(self.lengths), len(graph.edges))
        d = graph.dimension
        measurements, information = graph.added_since(len(self.lengths))
        lengths, is_odometry = np.where(graph.is_loop[new], 0.0, np.inf), graph.is_odometry[new]
        covariances = np.linalg.inv(information[is_odometry])
        sigmas_m = np.sqrt(np.trace(covariances[:, :d, :d], axis1=1, axis2=2))
        translations_m = np.linalg.norm(measurements[is_odometry, :d, d], axis=1)
        lengths[is_odometry] = np.maximum(translations_m, sigmas_m / self.drift)
        self.lengths.extend(lengths)

    def between(self, graph: PoseGraph, keyframe: int, limit_m: float) -> NDArray[np.float64]:
        """Uncertainty (K,) of each keyframe of the graph relative to one of them, meters, at most the limit."""
        self.measure(graph)
        is_open = ~graph.is_loop | (graph.weight > DOWNWEIGHTED)
        lengths = np.where(is_open, self.lengths.rows, np.inf)
        meters = path_lengths(graph.edges, lengths, len(graph), keyframe, limit_m / self.drift)
        meters[graph.held] = meters[graph.held].min(initial=np.inf)  # they do not drift relative to each other
        return np.minimum(self.drift * meters, limit_m)
