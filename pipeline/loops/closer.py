"""Loop closures: where a keyframe may be by position and drift and, in 3D, places recognized by their looks."""

from __future__ import annotations

from collections.abc import Sequence

from scanchain.config import Config
from scanchain.data import Closure, Keyframe
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.anywhere_closer import AnywhereCloser
from scanchain.loops.near_closer import NearCloser
from scanchain.loops.pieces import Pieces
from scanchain.loops.place_closer import PlaceCloser


class LoopCloser:
    """Looks from each new keyframe for an older place and measures where it lies."""

    def __init__(self, config: Config, dimension: int) -> None:
        self.pieces = Pieces()
        self.near = NearCloser(config, dimension, self.pieces)
        self.anywhere = AnywhereCloser(self.near, self.pieces) if dimension == 2 else None
        self.places = (
            PlaceCloser(config, self.pieces) if dimension == 3 and config.loops.recognize_places else None
        )

    def begin_piece(self, keyframe: int) -> None:
        """Say that nobody knows how the lidar came to this keyframe from the one before."""
        self.pieces.begin(keyframe)

    def close(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures of the newest keyframe to an older place near it, and of places recognized; accepted or not.

        keyframes : all so far; graph : their best known poses, and how they are joined
        """
        groups = self.pieces.groups(graph)
        joined = groups == groups[-1]
        near = self.near.close(keyframes, graph, joined)
        if self.anywhere is not None:
            return near + self.anywhere.close(keyframes, graph, groups)
        return near if self.places is None else near + self.places.close(keyframes, graph.poses, joined)

    def finish(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures of the places that waited for more of their surroundings to be seen."""
        if self.places is None:
            return ()
        groups = self.pieces.groups(graph)
        return self.places.close(keyframes, graph.poses, groups == groups[-1], finish=True)
