"""Verification of a proposed loop closure: alignment from the initial pose, and tests of the result.

A scan is aligned to a voxel submap or, in 3D, a submap to a submap, whose free space is then compared, too.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Closure, ClosureVerdict, Keyframe, Match, Points, Pose, Problem, Proposal
from scanchain.errors import below
from scanchain.kernels.free_space import compare_ranges, nearest_ranges
from scanchain.kernels.registration.association import associate
from scanchain.loops.submaps import Submap
from scanchain.preprocess import downsample
from scanchain.registration import PointToShapeMatcher, VoxelMap

_MIN_OVERLAP_ALONE = 0.8  # least overlap of a match that no expected pose supports
_MIN_PLACE_OVERLAP, _MIN_PLACE_INFORMATION = 0.4, 0.005  # for recognized places, instead of loops.min_…
_MIN_AGREEMENT = 0.87  # least agreement about free space, relative to that of each submap with itself
_COARSE = 2.0  # voxel size of the first alignment of two submaps, in usual voxel sizes
_VIEWS = 8  # number of views of each submap that are compared with the other
_VERIFIED = "verified by matching"
MARGIN_SHARE = 0.05  # least difference of two ranges that contradict each other, as a share of the range


@dataclass(frozen=True, slots=True)
class Verification:
    """The alignment of a proposed loop closure.

    match : of the source's points to the target's surfaces, T_target_source between the two anchors
    overlap : share of the source's points within a voxel of the target's surfaces
    problem : why it is rejected, None if it is accepted
    agreement : share of the points in view of the other's lidar that lie on surfaces it saw, the smaller one
        of both directions, divided by that of the submaps with themselves; 1 where not compared
    """

    match: Match
    overlap: float
    problem: Problem | None
    agreement: float = 1.0

    def closure(
        self,
        target: int,
        source: int,
        proposed_by: Proposal = Proposal.POSITION,
        *,
        problem: Problem | None = None,
    ) -> Closure:
        """The closure of two keyframes; a ``problem`` in addition to those of the alignment rejects it."""
        problem = self.problem or problem
        verdict = ClosureVerdict.REJECTED if problem else ClosureVerdict.ACCEPTED
        cause, reason = problem or (_VERIFIED, _VERIFIED)
        return Closure(target, source, self.match, self.overlap, verdict, reason, proposed_by, cause=cause)


class Verifier:
    """Aligns a scan to a voxel submap or, in 3D, a submap to a submap, and tests the result."""

    def __init__(self, config: Config) -> None:
        self.config = config
        self.matcher = PointToShapeMatcher(config.matching)

    def scan(
        self, source: Keyframe, target: VoxelMap, T_first: Pose, *, alone: bool = False, in_map: bool = False
    ) -> Verification:
        """A keyframe's scan in a submap, from an initial pose.

        alone : whether only the match supports the closure, which then needs more overlap
        in_map : whether the source is tracked in a map, where a match that is not degenerate is informative enough
        """
        limits = self.config.loops
        points = downsample(source.points, target.scale * self.config.preprocess.match_voxel_m)
        match = self.matcher.align(points, target, T_first, wide=True)
        overlap = overlap_of(points, match.T_target_source, target)
        min_overlap = _MIN_OVERLAP_ALONE if alone else limits.min_overlap
        min_information = 0.0 if in_map and match.observability >= 1.0 else limits.min_information
        problem = (
            _unfit(match)
            or _below("overlap", below(overlap), overlap, min_overlap, "loops.min_overlap")
            or _too_uncertain(match, min_information, "loops.min_information")
            or self._too_far(lie.apart(T_first, match.T_target_source)[0])
        )
        return Verification(match, overlap, problem)

    def submap(
        self, source: Submap, target: Submap, T_first: Pose, *, min_agreement: float = _MIN_AGREEMENT
    ) -> Verification:
        """A submap in another, from an initial pose: aligned from coarse to fine, free space compared.

        min_agreement : least agreement about free space; lower where the surroundings may have changed
        """
        scale = source.anchor.scale
        fine_m = scale * self.config.preprocess.match_voxel_m
        surfaces, dense = target.points(), source.points()
        coarse = downsample(dense, _COARSE * fine_m)
        rough = self.matcher.align(coarse, self._voxels(surfaces, _COARSE * scale), T_first, wide=True)
        voxels = self._voxels(surfaces, scale)
        points, others = downsample(dense, fine_m), downsample(surfaces, fine_m)
        match = self.matcher.align(points, voxels, rough.T_target_source)
        T, margin_m = match.T_target_source, voxels.voxels.size_m
        both_ways = min(
            free_space_agreement(target, points, T, margin_m),
            free_space_agreement(source, others, lie.inverse(T), margin_m),
        )
        with_itself = min(
            free_space_agreement(source, points, lie.identity(3), margin_m),
            free_space_agreement(target, others, lie.identity(3), margin_m),
        )
        overlap, agreement = overlap_of(points, T, voxels), both_ways / max(with_itself, 1e-9)
        problem = (
            _unfit(match)
            or _below("overlap", below(overlap), overlap, _MIN_PLACE_OVERLAP)
            or _too_uncertain(match, _MIN_PLACE_INFORMATION)
            or _below("free-space agreement", below(agreement), agreement, min_agreement)
        )
        return Verification(match, overlap, problem, agreement)

    def _voxels(self, points: Points, scale: float) -> VoxelMap:
        result = VoxelMap(3, self.config.local_map, scale)
        result.insert(points, lie.identity(3))
        return result

    def _too_far(self, moved_m: float) -> Problem | None:
        most_m, cause = self.config.loops.max_radius_m, "distance from the prediction > loops.max_radius_m"
        if moved_m <= most_m:
            return None
        return Problem(cause, f"{moved_m:.1f} m from the prediction > loops.max_radius_m ({most_m:g})")


def _unfit(match: Match) -> Problem | None:
    return None if match.is_fit else Problem(match.cause, match.reason)


def _too_uncertain(match: Match, least: float, key: str = "") -> Problem | None:
    information = match.degeneracy_eigenvalue
    return _below("information", f"{information:.1e}", information, least, key)


def _below(name: str, figure: str, value: float, least: float, key: str = "") -> Problem | None:
    """The problem of a value below the limit of this key, or for recognized places; None if it is not below."""
    if value >= least:
        return None
    limit = f"{key or 'the limit for a recognized place'} ({least:g})"
    return Problem(f"{name} < {key or limit}", f"{name} {figure} < {limit}")


def free_space_agreement(submap: Submap, points: Points, T_target_source: Pose, margin_m: float) -> float:
    """Share, of the source's points in view of the target's lidar, that lie where it saw a surface.

    points : (N, 3) meters, source's frame; margin_m : by which ranges may differ. 1 if no point is in view.
    """
    ranges_m, points = np.empty((90, 180)), np.ascontiguousarray(points)  # by elevation and azimuth: 2°
    agreeing = contradicting = 0
    for T_target_lidar, seen in submap.views(_VIEWS):
        nearest_ranges(np.ascontiguousarray(seen), ranges_m)
        T_lidar_source = lie.between(T_target_lidar, T_target_source)
        yes, no = compare_ranges(points, T_lidar_source, ranges_m, margin_m, MARGIN_SHARE)
        agreeing, contradicting = agreeing + yes, contradicting + no
    return agreeing / max(agreeing + contradicting, 1) if agreeing + contradicting else 1.0


def overlap_of(points: Points, T: Pose, surfaces: VoxelMap) -> float:
    """Share of the points (N, d) that, moved by T, lie within a voxel of the surfaces."""
    correspondence = np.empty(len(points), np.int32)
    size_m = surfaces.voxels.size_m
    return associate(surfaces.voxels, points, T, 1, size_m, correspondence) / max(len(points), 1)
