"""Evidence that keyframes are at a location: a sequential test of their matches and of free-space agreement."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, Keyframe, Matrix, Pose, Proposal
from scanchain.kernels.free_space import compare_ranges, nearest_ranges
from scanchain.loops.connectivity import Segments
from scanchain.loops.verification import MARGIN_SHARE

_NEAR_M = {2: 5.0, 3: 10.0}  # largest distance of two keyframes whose free space is compared
_MARGIN_M = {2: 0.3, 3: 1.0}  # by which ranges may differ, plus a share of them
_IN_SIGHT = 0.3  # least share of a keyframe's points in view of the map's nearest one for it to be in sight
_RISK = 1e-3  # probability that an accepted pose is wrong
_REJECTED = -3.0  # log-odds at or below which a pose is rejected
_RESERVE = 5.0  # largest log-odds above the bound: a pose that was right for long may turn out wrong
_FINAL = math.log(10.0)  # additional log-odds in the end, when no later observation can withdraw a pose
_TRACKED_M = 50.0  # path since the last match beyond which keyframes do not count and a test ends
LARGEST_RATIO = 2.0  # largest log-likelihood ratio of one keyframe
WEIGHTS = (2.8, -0.4, -4.9)  # of fit, no fit and contradiction in the evidence of a keyframe
_OF_FIND = {2: 4.0, 3: 5.0}  # log-odds of a search result: finds most correct poses, wrong ones in 0.4 %, 0.1 %
SEARCHED_M = {2: 8.0, 3: 20.0}  # path whose points are searched for together, at full scale
_NO_OVERLAP = 0.3  # overlap above which a match is evidence
_IN_SIGHT_OF_BOTH = 0.2  # share of points in view of the other keyframe for which the comparison counts in full
_LATEST = 10  # number of last counted keyframes on which the next one may depend
_INDEPENDENT_M = {2: 1.0, 3: 3.0}  # path beyond which two keyframes are independent, at full scale
AGREE = (1.0, 0.1)  # m at full scale and rad, largest difference between the poses that two closures imply


def compared(
    viewers: Sequence[Keyframe], viewed: Sequence[Keyframe], min_path_m: float = 0.0
) -> NDArray[np.int64]:
    """Numbers of points (2,), of the viewed keyframe nearest to each viewer, that agree and that contradict.

    min_path_m : least path between the two
    """
    d = viewers[0].T_odom_lidar.shape[0] - 1
    ranges_m = np.empty((1 if d == 2 else 180, 360))  # by elevation and azimuth: 1°
    positions = np.array([keyframe.T_odom_lidar[:d, d] for keyframe in viewed])
    traveled_m = np.array([keyframe.traveled_m for keyframe in viewed])
    counts = np.zeros(2, np.int64)
    for viewer in viewers:
        away_m = np.linalg.norm(positions - viewer.T_odom_lidar[:d, d], axis=1)
        away_m[np.abs(traveled_m - viewer.traveled_m) < min_path_m] = np.inf
        nearest = int(away_m.argmin())
        if away_m[nearest] <= _NEAR_M[d]:
            other = viewed[nearest]
            margin_m, points = _MARGIN_M[d] * viewer.scale, lie.lift_points(other.points)
            for T_odom_viewer, seen in viewer.views(viewer.T_odom_lidar):
                nearest_ranges(lie.lift_points(seen), ranges_m)
                T_viewer_viewed = lie.lift(lie.between(T_odom_viewer, other.T_odom_lidar))
                counts += compare_ranges(points, T_viewer_viewed, ranges_m, margin_m, MARGIN_SHARE)
    return counts


def is_in_sight(keyframe: Keyframe, others: Sequence[Keyframe]) -> bool:
    """True if enough points of a keyframe are in view of the nearest one of the others."""
    positions = np.array([each.T_odom_lidar[:-1, -1] for each in others])
    away_m = np.linalg.norm(positions - keyframe.T_odom_lidar[:-1, -1], axis=1)
    seen = compared([others[int(away_m.argmin())]], [keyframe]).sum()
    return bool(seen >= _IN_SIGHT * max(len(keyframe.points), 1))


class SequentialPlaceTest:
    """Sequential test (Wald 1945) of the assumed pose of the newest segment of a log among older keyframes.

    The older keyframes are those of a map or of earlier segments. Each keyframe that was matched with them adds
    its log-likelihood ratio: correct pose against the best wrong one; keyframes too close to be independent count
    in part. The pose is accepted once the sum exceeds the acceptance threshold, which follows from the risk and
    the length of the path searched. It is rejected once the sum is too low, and withdrawn if it was accepted.

    Methods take closures with older keyframes, all keyframes so far, and their poses T_world (K, d+1, d+1).
    """

    def __init__(self, segments: Segments) -> None:
        self.segments = segments
        self.is_given = False  # whether the pose of the first scan in a map was given
        self.searches = 1.0  # number of searches of independent parts of the path so far
        self.log_odds = 0.0  # of the present pose
        self.matches = 0.0  # number of independent keyframes that matched there, to compare two accepted poses
        self.best = math.nan  # largest log-odds of the poses tested so far that were not rejected
        self.matched_m = 0.0  # path up to the last match with older keyframes
        self.waiting: list[Closure] = []  # accepted closures that agree with the first one
        self.counted_m: list[float] = []  # path lengths at the keyframes that counted
        self.tried: dict[int, Closure] = {}  # of each keyframe, the best closure at its pose there

    @property
    def is_testing(self) -> bool:
        """True while a pose is being tested."""
        return bool(self.waiting)

    @property
    def is_accepted(self) -> bool:
        """True if the log-odds of the pose that is being tested are above the acceptance threshold."""
        return self.is_testing and self.log_odds >= self.bound

    @property
    def bound(self) -> float:
        """Log-odds above which a pose is accepted; the longer the path that was searched for, the higher."""
        return math.log(max(self.searches, 1.0) / _RISK)

    def update(
        self,
        closures: Sequence[Closure],
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
        *,
        least_matches: float = 0.0,
    ) -> tuple[Closure, ...]:
        """Add closures of a segment not joined to older ones; returns all that waited once its pose is accepted.

        least_matches : number of matches that it must exceed: that of the pose that it would replace
        """
        if not self.is_testing:
            if all(each.verdict is ClosureVerdict.REJECTED for each in closures):
                return ()
            newest, start = keyframes[-1], keyframes[self.segments.starts[-1]]
            d = newest.T_odom_lidar.shape[0] - 1
            searches = (newest.traveled_m - start.traveled_m) / (SEARCHED_M[d] * newest.scale)
            self.searches = max(searches, self.searches)
            self.log_odds, self.matches, self.counted_m = _OF_FIND[d], 0.0, []
        for each in _best_of_each(closures):
            agrees = not self.waiting or self._agrees(each, keyframes, T_world)
            if each.verdict is ClosureVerdict.ACCEPTED and agrees:
                self.waiting.append(each)
                self.matched_m = max(keyframes[each.source].traveled_m, self.matched_m)
            ratio = self._ratio(each, keyframes, T_world) if agrees else -LARGEST_RATIO
            self._count(each, keyframes, ratio)
        if not self.is_accepted or self.matches <= least_matches:
            return ()
        joining, self.waiting = tuple(self.waiting), []
        return joining

    def accept(self) -> None:
        """Accept a given pose of the first scan in the map, until observations contradict it."""
        self.is_given, self.log_odds = True, self.bound + _RESERVE

    def continue_from(self, other: SequentialPlaceTest) -> None:
        """Continue with the pose that another test accepted, in place of the one that was withdrawn."""
        self.log_odds, self.matches, self.searches = other.log_odds, other.matches, other.searches
        self.matched_m, self.counted_m = other.matched_m, other.counted_m
        self.tried |= other.tried

    def update_joined(self, closures: Sequence[Closure], keyframes: Sequence[Keyframe], T_world: Matrix) -> bool:
        """Add closures of a segment that is joined to older ones; returns False once its pose is rejected.

        Far from the last match nothing counts: odometry may have drifted away from the location.
        """
        for each in _best_of_each([each for each in closures if _is_there(each)]):
            if keyframes[each.source].traveled_m - self.matched_m <= _TRACKED_M * keyframes[each.source].scale:
                self._count(each, keyframes, self._ratio(each, keyframes, T_world))
            if each.verdict is ClosureVerdict.ACCEPTED:
                self.matched_m = keyframes[each.source].traveled_m
        self.log_odds = min(self.log_odds, self.bound + _RESERVE)
        return self.log_odds > _REJECTED

    def record(self, closures: Sequence[Closure]) -> None:
        """Record closures that were tried at the current pose of their keyframes."""
        for each in filter(_is_there, closures):
            known = self.tried.get(each.source)
            if known is None or rank_of(each) > rank_of(known):
                self.tried[each.source] = each

    def is_rejected(self, newest: Keyframe) -> bool:
        """True if the pose that is being tested is to be rejected, or nothing has matched there for a while."""
        since_m = newest.traveled_m - self.matched_m
        return self.is_testing and (self.log_odds <= _REJECTED or since_m > _TRACKED_M * newest.scale)

    def reject(self, start: int) -> None:
        """Reject the pose of the newest segment, which begins at ``start``, and forget what was tried there."""
        self._remember()
        self.tried = {source: each for source, each in self.tried.items() if source < start}
        self.is_given, self.log_odds, self.matches, self.waiting = False, 0.0, 0.0, []

    def passes_at(
        self, placed: range, keyframes: Sequence[Keyframe], T_world: Matrix, *, of_same_log: bool = False
    ) -> bool:
        """True if some keyframes, given by their numbers, pass the test at their final poses.

        of_same_log : whether the older ones are of the same log, and as likely near them as not; for a log in a
            map, the observations alone have to suffice
        """
        prior = _OF_FIND[T_world.shape[-1] - 1] - _FINAL if of_same_log else 0.0
        self.counted_m, self.log_odds = [], self.bound + _RESERVE if self.is_given else prior
        for closure in (self.tried[index] for index in placed if index in self.tried):
            ratio = self._ratio_at(T_world[closure.source], closure, keyframes, T_world)
            self.log_odds += self._weight(keyframes[closure.source]) * ratio
        self._remember()
        return self.log_odds >= self.bound

    def _count(self, closure: Closure, keyframes: Sequence[Keyframe], ratio: float) -> None:
        """Add the log-likelihood ratio of a keyframe, weighted by its independent share."""
        weight = self._weight(keyframes[closure.source])
        self.log_odds += weight * ratio
        self.matches += weight * (ratio > 0.0)

    def _remember(self) -> None:
        """Remember the log-odds of the present pose if it is not rejected and they are the best so far."""
        if self.log_odds > _REJECTED:
            self.best = float(np.fmax(self.best, self.log_odds))

    def _weight(self, keyframe: Keyframe) -> float:
        """Share of a keyframe that is independent of those already counted."""
        apart_m = _INDEPENDENT_M[keyframe.T_odom_lidar.shape[0] - 1] * keyframe.scale
        since_m = min((abs(keyframe.traveled_m - each) for each in self.counted_m[-_LATEST:]), default=apart_m)
        self.counted_m.append(keyframe.traveled_m)
        return min(since_m / apart_m, 1.0)

    def _ratio(self, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> float:
        return self._ratio_at(pose_by(closure, closure.source, keyframes, T_world), closure, keyframes, T_world)

    def _ratio_at(
        self, T_world_source: Pose, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix
    ) -> float:
        """Log-likelihood ratio of a keyframe at a pose: correct pose against a wrong one.

        Free space is compared with the nearest keyframe of the segment that the closure is with.
        """
        first, end = self.segments.span(closure.target, closure.source)
        away_m = np.linalg.norm(T_world[first:end, :-1, -1] - T_world_source[:-1, -1], axis=1)
        nearest = first + int(away_m.argmin())
        placed = replace(keyframes[closure.source], T_odom_lidar=T_world_source)
        neighbor = replace(keyframes[nearest], T_odom_lidar=T_world[nearest])
        agreeing, contradicting = (compared([placed], [neighbor]) + compared([neighbor], [placed])).tolist()
        return log_ratio(closure, agreeing, contradicting, len(placed.points) + len(neighbor.points))

    def _agrees(self, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> bool:
        """True if a closure implies the same pose of its source as the first waiting one."""
        T, T_other = (pose_by(each, closure.source, keyframes, T_world) for each in (self.waiting[0], closure))
        return lie.agree(T, T_other, AGREE[0] * keyframes[closure.source].scale, AGREE[1])


def log_ratio(closure: Closure, agreeing: int, contradicting: int, points: int) -> float:
    """Log-likelihood ratio of a closure with a map: correct pose against the best wrong one.

    The weights of its ``features`` are from a logistic regression over keyframes at correct and wrong poses
    (tests.benchmarks.place_odds).
    """
    shown = features(closure, agreeing, contradicting, points)
    ratio = sum(weight * each for weight, each in zip(WEIGHTS, shown, strict=True))
    return min(max(ratio, -LARGEST_RATIO), LARGEST_RATIO)


def features(closure: Closure, agreeing: int, contradicting: int, points: int) -> tuple[float, float, float]:
    """Features of the place classifier: fit, no fit although in view of the map, and contradicted free space.

    agreeing, contradicting : numbers of points in view of the other keyframe, out of ``points`` of both
    """
    fit = max(closure.overlap - _NO_OVERLAP, 0.0) / (1.0 - _NO_OVERLAP) if closure.match.is_fit else 0.0
    seen = agreeing + contradicting
    in_sight = min(seen / max(_IN_SIGHT_OF_BOTH * points, 1.0), 1.0)
    return fit, in_sight * (1.0 - fit), in_sight * contradicting / max(seen, 1)


def _is_there(closure: Closure) -> bool:
    """True for a closure that was tried at the pose of its keyframe, and for an accepted one of a search."""
    return closure.proposed_by is Proposal.POSITION or closure.verdict is ClosureVerdict.ACCEPTED


def _best_of_each(closures: Sequence[Closure]) -> list[Closure]:
    """The best closure of each keyframe."""
    best: dict[int, Closure] = {}
    for each in closures:
        if each.source not in best or rank_of(each) > rank_of(best[each.source]):
            best[each.source] = each
    return list(best.values())


def rank_of(closure: Closure) -> tuple[bool, float]:
    """Sort key of closures, greatest for the best: accepted ones first, then by overlap."""
    return closure.verdict is ClosureVerdict.ACCEPTED, closure.overlap


def pose_by(closure: Closure, keyframe: int, keyframes: Sequence[Keyframe], T_world: Matrix) -> Pose:
    """T_world_keyframe by a closure with an older keyframe and odometry."""
    T_world_source = T_world[closure.target] @ closure.match.T_target_source
    return T_world_source @ lie.between(keyframes[closure.source].T_odom_lidar, keyframes[keyframe].T_odom_lidar)
