"""Loop closures to older keyframes that may be near by position and drift, verified by matching."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Closure, Keyframe, Match, Pose, Proposal, Verdict
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.doubt import Doubt
from scanchain.loops.pieces import Pieces
from scanchain.loops.planar_search import PlanarSearch
from scanchain.loops.submaps import Submaps
from scanchain.loops.verification import overlap as overlap_of
from scanchain.preprocess import downsample
from scanchain.registration import PointToShapeMatcher

_SURE_OVERLAP = 0.8  # asked of a match for which nothing else speaks


class NearCloser:
    """Looks from each new keyframe for an older place and measures where it lies."""

    def __init__(self, config: Config, dimension: int, pieces: Pieces) -> None:
        self.config = config.loops
        self.match_voxel_m = config.preprocess.match_voxel_m
        self.matcher = PointToShapeMatcher(config.matching)
        self.submaps = Submaps(dimension, config.loops.submap_keyframes, config.local_map, pieces)
        self.doubt = Doubt(config.loops.drift)
        self.search = PlanarSearch(self.submaps) if dimension == 2 else None

    def close(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, joined: NDArray[np.bool_]
    ) -> tuple[Closure, ...]:
        """Closures of the newest keyframe to older places, accepted or not.

        keyframes : all so far; graph : their best known poses, and how they are joined
        joined : (K,) those whose place is known from here
        """
        old = self._old(keyframes)
        if not old:
            return ()
        T_world, config = graph.poses, self.config
        doubts_m = self.doubt.between(graph, len(keyframes) - 1, config.max_radius_m)[:old]
        away_m = np.linalg.norm(T_world[:old, :-1, -1] - T_world[-1, :-1, -1], axis=1)
        near = np.flatnonzero(joined[:old] & (away_m <= np.maximum(doubts_m, config.min_radius_m)))
        if not len(near):
            return ()
        target = self.submaps.anchor_of(int(near[np.argmin(away_m[near])]))
        closure = self.measured(keyframes, old - 1, target, lie.between(T_world[target], T_world[-1]))
        if closure.verdict is Verdict.ACCEPTED or self.search is None:
            return (closure,)
        found = self.search.find(keyframes, T_world, near, doubts_m)
        if found is None:
            return (closure,)
        searched = self.measured(keyframes, old - 1, found.anchor, found.T_anchor_source)
        return closure, replace(searched, proposed_by=Proposal.PLACE)

    def _old(self, keyframes: Sequence[Keyframe]) -> int:
        """How many of the first keyframes lie far enough back along the way to count as revisited."""
        limit_m = keyframes[-1].traveled_m - self.config.min_travel_m
        old = len(keyframes)
        while old > 0 and keyframes[old - 1].traveled_m > limit_m:
            old -= 1
        return old

    def measured(
        self, keyframes: Sequence[Keyframe], newest: int, target: int, T_first: Pose, *, surely: bool = False
    ) -> Closure:
        """The closure of the newest keyframe to the submap of an anchor, from a first guess of where it lies.

        newest : keyframe that may be in the submap
        surely : whether nothing but the match speaks for it, of which more is asked then
        """
        submap = self.submaps.around(target, keyframes, newest)
        points = downsample(keyframes[-1].points, submap.scale * self.match_voxel_m)
        match = self.matcher.align(points, submap, T_first, wide=True)
        overlap = overlap_of(points, match.T_target_source, submap)
        moved_m = lie.apart(T_first, match.T_target_source)[0]
        problem = self._problem(match, overlap, moved_m, _SURE_OVERLAP if surely else self.config.min_overlap)
        verdict = Verdict.REJECTED if problem else Verdict.ACCEPTED
        return Closure(target, keyframes[-1].index, match, overlap, verdict, problem or "verified by matching")

    def _problem(self, match: Match, overlap: float, moved_m: float, min_overlap: float) -> str:
        """Why the match is no closure, empty if it is one."""
        limits, information = self.config, match.degeneracy_eigenvalue
        if not match.is_fit:
            return match.reason
        if overlap < min_overlap:
            return f"overlap {overlap:.2f} < loops.min_overlap ({min_overlap:g})"
        if information < limits.min_information:
            return f"information {information:.1e} < loops.min_information ({limits.min_information:g})"
        if moved_m > limits.max_radius_m:
            return f"{moved_m:.1f} m from the prediction > loops.max_radius_m ({limits.max_radius_m:g})"
        return ""
