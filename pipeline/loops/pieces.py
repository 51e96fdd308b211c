"""The pieces of a log between which nobody knows how the lidar moved, until a loop joins them."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from scanchain.graph.pose_graph import PoseGraph

_CLOSED = 0.5  # weight that the robust loss leaves to a loop edge, from which on it joins two pieces


class Pieces:
    """Keyframes from one beginning up to the next are one piece."""

    def __init__(self) -> None:
        self.beginnings = [0]

    def begin(self, keyframe: int) -> None:
        """Let a new piece begin at this keyframe."""
        self.beginnings.append(keyframe)

    def of(self, keyframes: NDArray[np.int64]) -> NDArray[np.int64]:
        """Number of the piece of each keyframe."""
        return np.searchsorted(self.beginnings, keyframes, side="right") - 1

    def span(self, keyframe: int, count: int) -> tuple[int, int]:
        """First keyframe and end of a keyframe's piece, of so many keyframes in all."""
        number = int(self.of(np.array(keyframe)))
        return self.beginnings[number], [*self.beginnings[1:], count][number]

    def groups(self, graph: PoseGraph) -> NDArray[np.int64]:
        """Number of the group of each keyframe (K,) of the graph: of pieces that loops join to each other."""
        piece = self.of(np.arange(len(graph)))
        ends = piece[graph.edges[graph.is_loop & (graph.weight > _CLOSED)]]
        count = len(self.beginnings)
        if count == 1:
            return piece
        links = coo_matrix((np.ones(len(ends)), (ends[:, 0], ends[:, 1])), shape=(count, count))
        return connected_components(links, directed=False)[1].astype(np.int64)[piece]
