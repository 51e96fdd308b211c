"""Where a planar lidar is that was carried elsewhere: sought in the whole map, believed when two finds agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Closure, Keyframe, Matrix, Pose, Proposal, Verdict
from scanchain.graph.pose_graph import PoseGraph
from scanchain.loops.near_closer import NearCloser
from scanchain.loops.pieces import Pieces

_FIRST_M = 3.0  # of the way in a new piece, before it is sought
_PATIENCE = 0.2  # of the way since then, between two searches: one in a place that is new costs less and less
_APART_M = 1.0  # of the way between two finds that may vouch for each other
_SAME_M, _SAME_RAD = 0.5, 0.1  # by which these may differ


class AnywhereCloser:
    """Looks for older pieces from a new one, as long as none is joined to it."""

    def __init__(self, near: NearCloser, pieces: Pieces) -> None:
        self.near = near
        self.pieces = pieces
        self.next_m = 0.0
        self.turn = 0
        self.found: list[Closure] = []

    def close(
        self, keyframes: Sequence[Keyframe], graph: PoseGraph, groups: NDArray[np.int64]
    ) -> tuple[Closure, ...]:
        """Closures that say where the newest keyframe lies in older pieces; the first that agree are accepted.

        groups : (K,) numbers of ``Pieces.groups``
        """
        begun = self.pieces.beginnings[-1]
        way_m = keyframes[-1].traveled_m - keyframes[begun].traveled_m
        unknown = np.flatnonzero(groups != groups[-1])
        is_time = way_m >= _FIRST_M and keyframes[-1].traveled_m >= self.next_m
        if not len(unknown) or not is_time or self.near.search is None:
            return ()
        self.next_m = keyframes[-1].traveled_m + max(_PATIENCE * way_m, _APART_M)
        found = self.near.search.find_anywhere(
            keyframes, graph.poses, self._sought(unknown, groups), len(keyframes) - begun
        )
        if found is None:
            return ()
        closure = self.near.measured(
            keyframes, len(keyframes) - 1, found.anchor, found.T_anchor_source, surely=True
        )
        closure = replace(closure, proposed_by=Proposal.PLACE)
        if closure.verdict is Verdict.REJECTED:
            return (closure,)
        return self._vouched(closure, keyframes, graph.poses)

    def _sought(self, unknown: NDArray[np.int64], groups: NDArray[np.int64]) -> NDArray[np.int64]:
        """Those of one group, each in its turn: two groups may show the same place."""
        numbers = np.unique(groups[unknown])
        self.turn += 1
        return unknown[groups[unknown] == numbers[self.turn % len(numbers)]]

    def _vouched(self, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> tuple[Closure, ...]:
        """The closure and the older ones that agree with it; rejected where there are none, until others come."""
        old = [other for other in self.found if other.source >= self.pieces.beginnings[-1]]
        agreeing = [other for other in old if _agree(closure, other, keyframes, T_world)]
        if agreeing:
            self.found = []
            return (*agreeing, closure)
        self.found = [*old, closure]
        return (replace(closure, verdict=Verdict.REJECTED, reason="found anywhere, and no other find agrees yet"),)


def _agree(a: Closure, b: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> bool:
    """Whether two closures put the newest keyframe in one place."""
    off_m, off_rad = lie.apart(_place(a, a.source, keyframes, T_world), _place(b, a.source, keyframes, T_world))
    return off_m < _SAME_M and off_rad < _SAME_RAD


def _place(closure: Closure, keyframe: int, keyframes: Sequence[Keyframe], T_world: Matrix) -> Pose:
    """Where a closure and odometry put a keyframe in the world of the closure's target."""
    T_source_keyframe = lie.between(keyframes[closure.source].T_odom_lidar, keyframes[keyframe].T_odom_lidar)
    return T_world[closure.target] @ closure.match.T_target_source @ T_source_keyframe
