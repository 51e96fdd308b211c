"""Submaps: the scans around a keyframe in its frame, as points or as voxels, and the vertical direction in it."""

from __future__ import annotations

from bisect import bisect_left
from collections import OrderedDict
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.config import LocalMapConfig
from scanchain.data import Keyframe, Points, Pose
from scanchain.kernels.voxels import PLANE, Cell
from scanchain.loops.connectivity import Segments
from scanchain.registration import VoxelMap

RADII_BEHIND = 2.0  # radii of the trajectory before its anchor that a submap takes in: a lidar looks ahead
_MAX_POINTS = 80_000  # largest number of points of a submap, from keyframes evenly spread over it
_OF_MAP = 2  # factor on the number of keyframes in a submap of a map, which was seen from several sides
_CONES = (0.85, 0.97)  # cosines: normals nearer to the axis than this are the ground's, roughly and finally
_MIN_GROUND_VOXELS = 10  # least number of voxels with such a normal; with fewer the lidar is assumed upright


@dataclass(frozen=True, slots=True)
class Submap:
    """The keyframes around an ``anchor``, in the order of the log, cropped to a radius around it.

    Their relative poses are from odometry, which over such a short path is as good as any later estimate.
    """

    anchor: Keyframe
    members: Sequence[Keyframe]
    radius_m: float

    def views(self, count: int) -> Iterator[tuple[Pose, Points]]:
        """T_anchor_lidar and points (N, d) in the lidar's frame of ``count`` members at most, evenly spread."""
        T_anchor_odom = lie.inverse(self.anchor.T_odom_lidar)
        for member in self.members[:: max(-(-len(self.members) // count), 1)]:
            yield from member.views(T_anchor_odom @ member.T_odom_lidar)

    def points(self) -> Points:
        """(M, d) meters within the radius, anchor's frame."""
        total = sum(len(member.points) for member in self.members)
        count = max(len(self.members) * _MAX_POINTS // max(total, _MAX_POINTS), 1)
        moved = np.vstack([lie.transform(T, points) for T, points in self.views(count)])
        return moved[np.einsum("ij,ij->i", moved, moved) < self.radius_m**2]


def seen_together(keyframes: Sequence[Keyframe], T_frame_odom: Pose) -> Points:
    """Combined points (N, d) of keyframes in one frame, by odometry: a single scan may fit at many poses."""
    return np.vstack([lie.transform(T_frame_odom @ each.T_odom_lidar, each.points) for each in keyframes])


def submap_around(keyframes: Sequence[Keyframe], anchor: int, radius_m: float, segments: Segments) -> Submap:
    """The submap of a keyframe out of the keyframes of its segment so far."""
    here_m = keyframes[anchor].traveled_m
    begin, end = segments.span(anchor, len(keyframes))
    first = bisect_left(keyframes, here_m - RADII_BEHIND * radius_m, begin, end, key=_traveled_m)
    last = bisect_left(keyframes, here_m + radius_m, begin, end, key=_traveled_m)
    return Submap(keyframes[anchor], keyframes[first:last], radius_m)


def _traveled_m(keyframe: Keyframe) -> float:
    return keyframe.traveled_m


class VoxelSubmaps:
    """Voxel maps of 2n + 1 keyframes around every n-th one, built when first used.

    They lie in that keyframe's frame, with voxels of the size that odometry used there; keyframes of another
    segment are left out. In a map, whose poses are known, the keyframes nearest to it are used, of any pass.
    """

    def __init__(self, dimension: int, half_width: int, config: LocalMapConfig, segments: Segments) -> None:
        self.segments = segments
        self.dimension = dimension
        self.half_width = half_width
        self.config = config
        self.of_map = KDTree(np.empty((0, dimension)))
        self.cached: OrderedDict[tuple[int, int], VoxelMap] = OrderedDict()

    def add_map(self, keyframes: Sequence[Keyframe]) -> None:
        """Add the keyframes of a map."""
        self.of_map = KDTree(np.array([keyframe.T_odom_lidar[:-1, -1] for keyframe in keyframes]))

    def anchor_of(self, keyframe: int) -> int:
        """The last keyframe of its segment, up to this one, that has a submap around it."""
        return max(keyframe // self.half_width * self.half_width, self.segments.span(keyframe, keyframe + 1)[0])

    def around(self, anchor: int, keyframes: Sequence[Keyframe], newest: int) -> VoxelMap:
        """The submap of an anchor out of the keyframes up to ``newest``."""
        begin, end = self.segments.span(anchor, len(keyframes))
        first, last = max(anchor - self.half_width, begin), min(anchor + self.half_width, newest, end - 1)
        is_of_map = anchor < self.of_map.n
        if is_of_map:
            last = -1
        submap = self.cached.pop((anchor, last), None)
        if submap is None:
            chosen: Sequence[int] = range(first, last + 1)
            if is_of_map:
                count = min(_OF_MAP * (2 * self.half_width + 1), self.of_map.n)
                nearest = self.of_map.query(keyframes[anchor].T_odom_lidar[:-1, -1], count)[1]
                chosen = sorted(np.atleast_1d(nearest).tolist())
            submap = self._build(keyframes[anchor], [keyframes[index] for index in chosen], is_of_map)
            submap.compact()
        self.cached[anchor, last] = submap
        if len(self.cached) > 64:
            self.cached.popitem(last=False)  # the least recently used one
        return submap

    def _build(self, anchor: Keyframe, members: Sequence[Keyframe], is_of_map: bool) -> VoxelMap:
        """The submap; of a 3D map, of all points together: every voxel is fitted once, and all are equally old."""
        submap = VoxelMap(self.dimension, self.config, anchor.scale, anchor.noise_m)
        T_anchor_odom = lie.inverse(anchor.T_odom_lidar)
        if is_of_map and self.dimension == 3:
            submap.insert(seen_together(members[::_OF_MAP], T_anchor_odom), lie.identity(3))
            return submap
        for keyframe in members:
            submap.insert(keyframe.points, T_anchor_odom @ keyframe.T_odom_lidar)
        return submap


def level_frame(keyframe: Keyframe, config: LocalMapConfig) -> Pose:
    """T_keyframe_level (4, 4), the frame with the same origin whose z axis is normal to the ground.

    The ground is what is planar and inclined by less than 32° to the lidar's xy plane; where there is too little
    of it, the lidar is assumed upright. The x axis is as close to the lidar's as possible.
    """
    voxels = VoxelMap(3, config, keyframe.scale, keyframe.noise_m)
    voxels.insert(keyframe.points, lie.identity(3))
    cells = voxels.voxels.cells[: len(voxels)]
    normals = cells[cells[:, Cell.SHAPE] == PLANE, Cell.DIRECTION : Cell.DIRECTION + 3]
    up = np.array([0.0, 0.0, 1.0])
    for cosine in _CONES:
        along = normals @ up
        chosen = np.abs(along) > cosine
        if chosen.sum() < _MIN_GROUND_VOXELS:
            break
        up = _unit((normals[chosen] * np.sign(along[chosen])[:, None]).sum(axis=0))
    return upright_frame(up)


def upright_frame(up: NDArray[np.float64], ahead: NDArray[np.float64] | None = None) -> Pose:
    """The frame (4, 4) at the origin with its z axis along the unit vector ``up``, x near ``ahead``, or x."""
    T = lie.identity(3)
    ahead = np.array([1.0, 0.0, 0.0]) if ahead is None else ahead
    forward = _unit(ahead - (ahead @ up) * up)
    T[:3, 0], T[:3, 1], T[:3, 2] = forward, np.cross(up, forward), up
    return T


def _unit(v: NDArray[np.float64]) -> NDArray[np.float64]:
    return v / np.linalg.norm(v)
