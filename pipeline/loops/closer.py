"""Loop closures: where a keyframe may be by position and drift and, in 3D, places recognised by their looks."""

from __future__ import annotations

from collections.abc import Sequence

from pipeline.config import Config
from pipeline.data import Closure, Keyframe, Matrix
from pipeline.graph.pose_graph import PoseGraph
from pipeline.loops.near_closer import NearCloser
from pipeline.loops.place_closer import PlaceCloser


class LoopCloser:
    """Looks from each new keyframe for an older place and measures where it lies."""

    def __init__(self, config: Config, dimension: int) -> None:
        self.near = NearCloser(config, dimension)
        self.places = PlaceCloser(config) if dimension == 3 and config.loops.recognise_places else None

    def close(self, keyframes: Sequence[Keyframe], graph: PoseGraph) -> tuple[Closure, ...]:
        """Closures of the newest keyframe to an older place near it, and of places recognised; accepted or not.

        keyframes : all so far; graph : their best known poses, and how they are joined
        """
        places = () if self.places is None else self.places.close(keyframes, graph.poses)
        return self.near.close(keyframes, graph) + places

    def finish(self, keyframes: Sequence[Keyframe], T_world_keyframes: Matrix) -> tuple[Closure, ...]:
        """Closures of the places that waited for more of their surroundings to be seen."""
        return () if self.places is None else self.places.close(keyframes, T_world_keyframes, finish=True)
