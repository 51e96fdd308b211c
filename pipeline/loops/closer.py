"""Loop closures: places seen before, nearby by position and drift, verified by matching."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from pipeline import lie
from pipeline.config import Config
from pipeline.data import Closure, Keyframe, Match, Matrix, Points, Pose, Verdict
from pipeline.loops.place_closer import PlaceCloser
from pipeline.loops.submaps import Submaps
from pipeline.loops.verification import overlap as overlap_of
from pipeline.matching import PointToShapeMatcher, VoxelMap
from pipeline.preprocess import downsample


class LoopCloser:
    """Looks from each new keyframe for an older place and measures where it lies."""

    def __init__(self, config: Config, dimension: int) -> None:
        self.config = config.loops
        self.match_voxel_m = config.preprocess.match_voxel_m
        self.matcher = PointToShapeMatcher(config.matching)
        self.submaps = Submaps(dimension, config.loops.submap_keyframes, config.local_map)
        self.places = PlaceCloser(config) if dimension == 3 and config.loops.recognise_places else None

    def close(self, keyframes: Sequence[Keyframe], T_world_keyframes: Matrix) -> tuple[Closure, ...]:
        """Closures of the newest keyframe to the nearest older place, and of places recognised; accepted or not.

        keyframes : all so far; T_world_keyframes : (K, d+1, d+1) their best known poses
        """
        places = () if self.places is None else self.places.close(keyframes, T_world_keyframes)
        return self._close_near(keyframes, T_world_keyframes) + places

    def finish(self, keyframes: Sequence[Keyframe], T_world_keyframes: Matrix) -> tuple[Closure, ...]:
        """Closures of the places that waited for more of their surroundings to be seen."""
        return () if self.places is None else self.places.close(keyframes, T_world_keyframes, finish=True)

    def _close_near(self, keyframes: Sequence[Keyframe], T_world_keyframes: Matrix) -> tuple[Closure, ...]:
        """The closure of the newest keyframe to the nearest older place."""
        source = keyframes[-1]
        target = self._nearest(keyframes, T_world_keyframes)
        if target < 0:
            return ()
        T_predicted = lie.inverse(T_world_keyframes[target]) @ T_world_keyframes[source.index]
        submap = self.submaps.around(target, keyframes, self._newest_old(keyframes))
        points = downsample(source.points, submap.scale * self.match_voxel_m)
        match = self.matcher.align(points, submap, T_predicted, wide=True)
        return (self._judge(target, source.index, match, points, submap, T_predicted),)

    def _newest_old(self, keyframes: Sequence[Keyframe]) -> int:
        """Last keyframe far enough back along the way to count as a revisit, −1 if there is none."""
        limit_m = keyframes[-1].travelled_m - self.config.min_travel_m
        old = len(keyframes) - 1
        while old >= 0 and keyframes[old].travelled_m > limit_m:
            old -= 1
        return old

    def _nearest(self, keyframes: Sequence[Keyframe], T_world_keyframes: Matrix) -> int:
        """Anchor of the nearest old keyframe within what odometry may have drifted, −1 if there is none."""
        old = self._newest_old(keyframes)
        if old < 0:
            return -1
        positions = T_world_keyframes[:, :-1, -1]
        distance_m = np.linalg.norm(positions[: old + 1] - positions[-1], axis=1)
        nearest = int(np.argmin(distance_m))
        travelled_m = keyframes[-1].travelled_m - keyframes[nearest].travelled_m
        return self.submaps.anchor_of(nearest) if distance_m[nearest] <= self._radius_m(travelled_m) else -1

    def _radius_m(self, travelled_m: float) -> float:
        return float(np.clip(self.config.drift * travelled_m, self.config.min_radius_m, self.config.max_radius_m))

    def _judge(
        self, target: int, source: int, match: Match, points: Points, submap: VoxelMap, T_predicted: Pose
    ) -> Closure:
        overlap = overlap_of(points, match.T_target_source, submap)
        moved_m = float(np.linalg.norm((lie.inverse(T_predicted) @ match.T_target_source)[:-1, -1]))
        problem = self._problem(match, overlap, moved_m)
        verdict = Verdict.REJECTED if problem else Verdict.ACCEPTED
        return Closure(target, source, match, overlap, verdict, problem or "verified by matching")

    def _problem(self, match: Match, overlap: float, moved_m: float) -> str:
        """Why the match is no closure, empty if it is one."""
        limits, information = self.config, match.degeneracy_eigenvalue
        if not match.converged:
            return match.reason
        if overlap < limits.min_overlap:
            return f"overlap {overlap:.2f} < loops.min_overlap ({limits.min_overlap:g})"
        if information < limits.min_information:
            return f"information {information:.1e} < loops.min_information ({limits.min_information:g})"
        if moved_m > limits.max_radius_m:
            return f"{moved_m:.1f} m from the prediction > loops.max_radius_m ({limits.max_radius_m:g})"
        return ""
