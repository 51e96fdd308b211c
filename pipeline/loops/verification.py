"""A supposed revisit, measured: local map against local map, from coarse to fine."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Match, Points, Pose
from scanchain.kernels.registration.association import associate
from scanchain.loops.agreement import free_space_agreement
from scanchain.loops.local_map import LocalMap
from scanchain.preprocess import downsample
from scanchain.registration import PointToShapeMatcher, VoxelMap

_COARSE = 2.0  # times the usual voxels, for the first alignment


@dataclass(frozen=True, slots=True)
class Measurement:
    """How two local maps lie, and how well they fit there.

    Attributes
    ----------
    match : of the source's points to the target's surfaces, T_target_source between the two anchors
    overlap : share of the source's points within a voxel of the target's surfaces
    agreement : share of the points in sight of the other's lidar that lie on what it saw, the worse of both ways,
        divided by the share that either map has with itself
    """

    match: Match
    overlap: float
    agreement: float


class Verifier:
    """Aligns local maps with the matcher of odometry."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.matcher = PointToShapeMatcher(config.matching)

    def measure(self, source: LocalMap, target: LocalMap, T_first: Pose) -> Measurement:
        """Where the source lies in the target, near the first guess."""
        scale = source.anchor.scale
        fine_m = scale * self.config.preprocess.match_voxel_m
        surfaces, dense = target.points(), source.points()
        rough = self._align(downsample(dense, _COARSE * fine_m), surfaces, T_first, _COARSE * scale)
        voxels = self._voxels(surfaces, scale)
        points, others = downsample(dense, fine_m), downsample(surfaces, fine_m)
        match = self.matcher.align(points, voxels, rough.T_target_source)
        T, margin_m = match.T_target_source, voxels.voxels.size_m
        both_ways = min(
            free_space_agreement(target, points, T, margin_m),
            free_space_agreement(source, others, lie.inverse(T), margin_m),
        )
        alone = min(
            free_space_agreement(source, points, lie.identity(3), margin_m),
            free_space_agreement(target, others, lie.identity(3), margin_m),
        )
        return Measurement(match, overlap(points, T, voxels), both_ways / max(alone, 1e-9))

    def _align(self, points: Points, surfaces: Points, T_first: Pose, scale: float) -> Match:
        return self.matcher.align(points, self._voxels(surfaces, scale), T_first, wide=True)

    def _voxels(self, points: Points, scale: float) -> VoxelMap:
        result = VoxelMap(3, self.config.local_map, scale)
        result.insert(points, lie.identity(3))
        return result


def overlap(points: Points, T: Pose, surfaces: VoxelMap) -> float:
    """Share of the points (N, d) that, moved by T, lie within a voxel of the surfaces."""
    partner = np.empty(len(points), np.int32)
    size_m = surfaces.voxels.size_m
    return associate(surfaces.voxels, points, T, 1, size_m, partner) / max(len(points), 1)
