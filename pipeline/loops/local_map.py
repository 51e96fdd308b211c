"""The surroundings of a keyframe, put together from the scans taken on the way there and on from there."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from scanchain import lie
from scanchain.data import Keyframe, Points, Pose
from scanchain.loops.pieces import Pieces

FUTURE = 1.0  # radii of the way after the anchor
PAST = 2.0  # and before it: a lidar that looks ahead sees a place from far off
_POINTS = 80_000  # gathered at most, of keyframes evenly spread over the way


@dataclass(frozen=True, slots=True)
class LocalMap:
    """The keyframes around an ``anchor``, in the order they were taken, and how far from it they are looked at.

    Odometry places them; over so short a way it is as good as any pose known later.
    """

    anchor: Keyframe
    members: Sequence[Keyframe]
    radius_m: float

    def views(self, count: int) -> Iterator[tuple[Pose, Points]]:
        """T_anchor_lidar and points (N, 3) in the lidar's frame of so many members at most, evenly spread."""
        T_anchor_odom = lie.inverse(self.anchor.T_odom_lidar)
        for member in self.members[:: max(-(-len(self.members) // count), 1)]:
            yield T_anchor_odom @ member.T_odom_lidar, member.points

    def points(self) -> Points:
        """(M, 3) meters within the radius, anchor's frame."""
        total = sum(len(member.points) for member in self.members)
        count = max(len(self.members) * _POINTS // max(total, _POINTS), 1)
        moved = np.vstack([lie.transform(T, points) for T, points in self.views(count)])
        return moved[np.einsum("ij,ij->i", moved, moved) < self.radius_m**2]


def local_map(keyframes: Sequence[Keyframe], anchor: int, radius_m: float, pieces: Pieces) -> LocalMap:
    """The surroundings of a keyframe, as far as they are known."""
    here_m = keyframes[anchor].traveled_m
    begin, end = pieces.span(anchor, len(keyframes))
    first = bisect_left(keyframes, here_m - PAST * radius_m, begin, end, key=_traveled_m)
    last = bisect_left(keyframes, here_m + FUTURE * radius_m, begin, end, key=_traveled_m)
    return LocalMap(keyframes[anchor], keyframes[first:last], radius_m)


def _traveled_m(keyframe: Keyframe) -> float:
    return keyframe.traveled_m
