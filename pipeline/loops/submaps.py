"""Small maps around a keyframe, built when a loop closure first asks for them."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.data import Keyframe
from scanchain.loops.pieces import Pieces
from scanchain.registration import VoxelMap

_HELD = 64  # submaps in memory; the one unused for longest goes first


class Submaps:
    """Maps of 2n + 1 keyframes around every n-th one, in that keyframe's frame, its voxels of the size used there.

    Neighboring keyframes are placed by odometry, which over so short a way is as good as any pose known later;
    those of another piece are left out.
    """

    def __init__(self, dimension: int, half_width: int, config: LocalMapConfig, pieces: Pieces) -> None:
        self.pieces = pieces
        self.dimension = dimension
        self.half_width = half_width
        self.config = config
        self.held: OrderedDict[tuple[int, int], VoxelMap] = OrderedDict()

    def anchor_of(self, keyframe: int) -> int:
        """The last keyframe up to this one that has a submap around it."""
        return keyframe // self.half_width * self.half_width

    def around(self, anchor: int, keyframes: Sequence[Keyframe], newest: int) -> VoxelMap:
        """The submap of an anchor out of the keyframes up to ``newest``."""
        begin, end = self.pieces.span(anchor, len(keyframes))
        first, last = max(anchor - self.half_width, begin), min(anchor + self.half_width, newest, end - 1)
        submap = self.held.pop((anchor, last), None)
        if submap is None:
            submap = self._build(keyframes[anchor], keyframes[first : last + 1])
        self.held[anchor, last] = submap
        if len(self.held) > _HELD:
            self.held.popitem(last=False)
        return submap

    def _build(self, anchor: Keyframe, members: Sequence[Keyframe]) -> VoxelMap:
        submap = VoxelMap(self.dimension, self.config, anchor.scale)
        T_anchor_odom = lie.inverse(anchor.T_odom_lidar)
        for keyframe in members:
            submap.insert(keyframe.points, T_anchor_odom @ keyframe.T_odom_lidar)
        return submap
