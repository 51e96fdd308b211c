"""Evidence that keyframes are at a place: a sequential test of their fits, and of free space that agrees."""

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

_NEAR_M = {2: 5.0, 3: 10.0}  # largest distance of two keyframes that are compared for it, by dimension
_BINS = 360  # of azimuth, 1°; as fine in elevation
_MARGIN_M, _MARGIN_SHARE = {2: 0.3, 3: 1.0}, 0.05  # by which ranges may differ, beside that share of them
_IN_SIGHT = 0.3  # share of the points of a keyframe, from which on those in view of the map's nearest one show it
_RISK = 1e-3  # that a pose is taken up which is wrong
_DROPPED = -3.0  # log-odds down to which a pose is tested
_RESERVE = 5.0  # log-odds above that bound that are kept: what was right for long may turn out wrong
_FINAL = math.log(10.0)  # log-odds more in the end, when nothing that is seen later can withdraw a pose
_FOLLOWED_M = 50.0  # path since the last match, up to which keyframes contradict a location, or it is tested
LARGEST_RATIO = 2.0  # of one keyframe, as a logarithm
WEIGHTS = (2.8, -0.4, -4.9)  # of fit, no fit and contradiction in the evidence of a keyframe
_OF_FIND = {2: 4.0, 3: 5.0}  # log-odds of a find by a search: of most right places, of others in 0.004 and 0.001
_SEARCHED_M = {2: 8.0, 3: 20.0}  # path whose points are sought together, at full scale
_NO_OVERLAP = 0.3  # overlap from which on a fit is evidence
_IN_SIGHT_OF_BOTH = 0.2  # share of the points in view of the other side, from which on that knows the place
_LATEST = 10  # number of the last keyframes that counted, from which the next one may not be independent
_INDEPENDENT_M = {2: 1.0, 3: 3.0}  # path from which on two keyframes are independent, at full scale
_AGREE_M, _AGREE_RAD = 1.0, 0.1  # largest difference between the poses that two closures imply


def compared(
    viewers: Sequence[Keyframe], viewed: Sequence[Keyframe], min_path_m: float = 0.0
) -> NDArray[np.int64]:
    """Numbers of points (2,), of the viewed keyframe nearest to each viewer, that agree and that contradict.

    min_path_m : least path between the two
    """
    d = viewers[0].T_odom_lidar.shape[0] - 1
    ranges_m = np.empty((1 if d == 2 else _BINS // 2, _BINS))
    positions = np.array([keyframe.T_odom_lidar[:d, d] for keyframe in viewed])
    traveled_m = np.array([keyframe.traveled_m for keyframe in viewed])
    counts = np.zeros(2, np.int64)
    for viewer in viewers:
        away_m = np.linalg.norm(positions - viewer.T_odom_lidar[:d, d], axis=1)
        away_m[np.abs(traveled_m - viewer.traveled_m) < min_path_m] = np.inf
        nearest = int(away_m.argmin())
        if away_m[nearest] <= _NEAR_M[d]:
            other = viewed[nearest]
            nearest_ranges(lie.lift_points(viewer.points), ranges_m)
            T_viewer_viewed = lie.lift(lie.between(viewer.T_odom_lidar, other.T_odom_lidar))
            margin_m = _MARGIN_M[d] * viewer.scale
            counts += compare_ranges(
                lie.lift_points(other.points), T_viewer_viewed, ranges_m, margin_m, _MARGIN_SHARE
            )
    return counts


def is_in_sight(keyframe: Keyframe, others: Sequence[Keyframe]) -> bool:
    """True if a keyframe shows what the nearest one of the others shows, or what it sees through."""
    positions = np.array([each.T_odom_lidar[:-1, -1] for each in others])
    away_m = np.linalg.norm(positions - keyframe.T_odom_lidar[:-1, -1], axis=1)
    seen = compared([others[int(away_m.argmin())]], [keyframe]).sum()
    return bool(seen >= _IN_SIGHT * max(len(keyframe.points), 1))


class PlaceTest:
    """Sequential test (Wald 1945) of the pose where the newest segment of a log is taken to be.

    Older keyframes, of a map or of segments before, are the place. Each keyframe that was tried against them there
    adds the logarithm of how much likelier what it shows is at a right pose than at the best of wrong ones;
    keyframes closer than they are independent count in part. The pose is taken up where the sum passes what the
    risk asks for, over all the path sought. It is dropped where the sum says that it is wrong: withdrawn, if it
    had been taken up.

    Methods take closures with older keyframes, all keyframes so far, and their poses T_world (K, d+1, d+1).
    """

    def __init__(self, segments: Segments) -> None:
        self.segments = segments
        self.is_given = False  # whether the pose of the first scan in a map is
        self.searches = 1.0  # for independent parts of the path so far
        self.log_odds = 0.0  # of the present one
        self.matches = 0.0  # independent keyframes that matched there, by which two accepted poses compare
        self.best = math.nan  # of those that the log ended with, or a segment
        self.matched_m = 0.0  # path up to the last match with older keyframes
        self.waiting: list[Closure] = []  # accepted and agreeing with the first
        self.counted_m: list[float] = []  # places along the path of the keyframes that counted
        self.tried: dict[int, Closure] = {}  # of each keyframe, the best closure at its pose there

    @property
    def is_gathering(self) -> bool:
        """True while a pose is being tested."""
        return bool(self.waiting)

    @property
    def is_accepted(self) -> bool:
        """True if the log-odds of the pose that is being tested are above the acceptance threshold."""
        return self.is_gathering and self.log_odds >= self.bound

    @property
    def bound(self) -> float:
        """Log-odds from which on a pose is taken up: the longer the path that was sought, the higher."""
        return math.log(max(self.searches, 1.0) / _RISK)

    def collect(
        self,
        closures: Sequence[Closure],
        keyframes: Sequence[Keyframe],
        T_world: Matrix,
        *,
        least_matches: float = 0.0,
    ) -> tuple[Closure, ...]:
        """Take closures of a segment that none joins to older ones; all that waited, once they join it.

        least_matches : number of matches that it needs more than, that of the pose which it would replace
        """
        if not self.is_gathering:
            if all(each.verdict is ClosureVerdict.REJECTED for each in closures):
                return ()
            newest, start = keyframes[-1], keyframes[self.segments.starts[-1]]
            d = newest.T_odom_lidar.shape[0] - 1
            searches = (newest.traveled_m - start.traveled_m) / (_SEARCHED_M[d] * newest.scale)
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

    def give(self) -> None:
        """The pose of the first scan in the map is given: it is believed until what is seen contradicts it."""
        self.is_given, self.log_odds = True, self.bound + _RESERVE

    def replace_by(self, other: PlaceTest) -> None:
        """Go on with the pose that another test accepted, in place of the one that was withdrawn."""
        self.log_odds, self.matches, self.searches = other.log_odds, other.matches, other.searches
        self.matched_m, self.counted_m = other.matched_m, other.counted_m
        self.tried |= other.tried

    def follow(self, closures: Sequence[Closure], keyframes: Sequence[Keyframe], T_world: Matrix) -> bool:
        """Take closures of a segment that is joined to older ones; False once they say that it is not there.

        Far from the last match nothing counts: drift may have led away from the place.
        """
        for each in _best_of_each([each for each in closures if _is_there(each)]):
            if keyframes[each.source].traveled_m - self.matched_m <= _FOLLOWED_M * keyframes[each.source].scale:
                self._count(each, keyframes, self._ratio(each, keyframes, T_world))
            if each.verdict is ClosureVerdict.ACCEPTED:
                self.matched_m = keyframes[each.source].traveled_m
        self.log_odds = min(self.log_odds, self.bound + _RESERVE)
        return self.log_odds > _DROPPED

    def note(self, closures: Sequence[Closure]) -> None:
        """Note closures that were tried at the pose where their keyframes lie."""
        for each in filter(_is_there, closures):
            known = self.tried.get(each.source)
            if known is None or rank_of(each) > rank_of(known):
                self.tried[each.source] = each

    def is_in_vain(self, newest: Keyframe) -> bool:
        """True if the pose that is being tested is wrong, or nothing has matched there for a while."""
        since_m = newest.traveled_m - self.matched_m
        return self.is_gathering and (self.log_odds <= _DROPPED or since_m > _FOLLOWED_M * newest.scale)

    def drop(self, start: int) -> None:
        """The newest segment, from a keyframe on, is not where it was tested; forget what was tried."""
        self._remember()
        self.tried = {source: each for source, each in self.tried.items() if source < start}
        self.is_given, self.log_odds, self.matches, self.waiting = False, 0.0, 0.0, []

    def holds(
        self, placed: range, keyframes: Sequence[Keyframe], T_world: Matrix, *, of_same_log: bool = False
    ) -> bool:
        """True if some keyframes, by their numbers, stand at their final poses where they are tried.

        of_same_log : whether the older ones are of one log with them, and as likely near them as not; of a log in
            a map what is seen has to speak for itself
        """
        prior = _OF_FIND[T_world.shape[-1] - 1] - _FINAL if of_same_log else 0.0
        self.counted_m, self.log_odds = [], self.bound + _RESERVE if self.is_given else prior
        for closure in (self.tried[index] for index in placed if index in self.tried):
            ratio = self._ratio_at(T_world[closure.source], closure, keyframes, T_world)
            self.log_odds += self._weight(keyframes[closure.source]) * ratio
        self._remember()
        return self.log_odds >= self.bound

    def _count(self, closure: Closure, keyframes: Sequence[Keyframe], ratio: float) -> None:
        """Count a keyframe, whose logarithm of the likelihood ratio this is, by its share that is independent."""
        weight = self._weight(keyframes[closure.source])
        self.log_odds += weight * ratio
        self.matches += weight * (ratio > 0.0)

    def _remember(self) -> None:
        """Keep the log-odds of the present pose, if they are the best so far of those not known to be wrong."""
        if self.log_odds > _DROPPED:
            self.best = float(np.fmax(self.best, self.log_odds))

    def _weight(self, keyframe: Keyframe) -> float:
        """Share of an independent observation that a keyframe is, after those that counted."""
        apart_m = _INDEPENDENT_M[keyframe.T_odom_lidar.shape[0] - 1] * keyframe.scale
        since_m = min((abs(keyframe.traveled_m - each) for each in self.counted_m[-_LATEST:]), default=apart_m)
        self.counted_m.append(keyframe.traveled_m)
        return min(since_m / apart_m, 1.0)

    def _ratio(self, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> float:
        return self._ratio_at(pose_by(closure, closure.source, keyframes, T_world), closure, keyframes, T_world)

    def _ratio_at(
        self, T_world_source: Pose, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix
    ) -> float:
        """Logarithm of the likelihood ratio of what a keyframe at a pose shows, of a right pose to a wrong one.

        Free space is that of the nearest keyframe of the segment which the closure is with.
        """
        first, end = self.segments.span(closure.target, closure.source)
        away_m = np.linalg.norm(T_world[first:end, :-1, -1] - T_world_source[:-1, -1], axis=1)
        nearest = first + int(away_m.argmin())
        placed = replace(keyframes[closure.source], T_odom_lidar=T_world_source)
        beside = replace(keyframes[nearest], T_odom_lidar=T_world[nearest])
        agreeing, contradicting = (compared([placed], [beside]) + compared([beside], [placed])).tolist()
        return log_ratio(closure, agreeing, contradicting, len(placed.points) + len(beside.points))

    def _agrees(self, closure: Closure, keyframes: Sequence[Keyframe], T_world: Matrix) -> bool:
        """True if a closure implies the pose of its source that the first one does."""
        poses = (pose_by(each, closure.source, keyframes, T_world) for each in (self.waiting[0], closure))
        off_m, off_rad = lie.apart(*poses)
        return off_m < _AGREE_M * keyframes[closure.source].scale and off_rad < _AGREE_RAD


def log_ratio(closure: Closure, agreeing: int, contradicting: int, points: int) -> float:
    """Logarithm of how much likelier a closure with a map is at a right pose than at the best of wrong ones.

    The weights of its ``features`` are a logistic regression over keyframes at right and at wrong poses
    (tests.benchmarks.place_odds).
    """
    shown = features(closure, agreeing, contradicting, points)
    ratio = sum(weight * each for weight, each in zip(WEIGHTS, shown, strict=True))
    return min(max(ratio, -LARGEST_RATIO), LARGEST_RATIO)


def features(closure: Closure, agreeing: int, contradicting: int, points: int) -> tuple[float, float, float]:
    """What speaks for and against a pose: a fit, none where the map shows what the scan does, free space.

    agreeing, contradicting : numbers of points in view of the other side, of so many points of both
    """
    fit = max(closure.overlap - _NO_OVERLAP, 0.0) / (1.0 - _NO_OVERLAP) if closure.match.is_fit else 0.0
    seen = agreeing + contradicting
    in_sight = min(seen / max(_IN_SIGHT_OF_BOTH * points, 1.0), 1.0)
    return fit, in_sight * (1.0 - fit), in_sight * contradicting / max(seen, 1)


def _is_there(closure: Closure) -> bool:
    """True for a closure that was tried where its keyframe lies, and for one that a search found."""
    return closure.proposed_by is Proposal.POSITION or closure.verdict is ClosureVerdict.ACCEPTED


def _best_of_each(closures: Sequence[Closure]) -> list[Closure]:
    """Of the closures of each keyframe, the best."""
    best: dict[int, Closure] = {}
    for each in closures:
        if each.source not in best or rank_of(each) > rank_of(best[each.source]):
            best[each.source] = each
    return list(best.values())


def rank_of(closure: Closure) -> tuple[bool, float]:
    """By which the best of several closures is the greatest: accepted ones first, then by overlap."""
    return closure.verdict is ClosureVerdict.ACCEPTED, closure.overlap


def pose_by(closure: Closure, keyframe: int, keyframes: Sequence[Keyframe], T_world: Matrix) -> Pose:
    """T_world_keyframe by a closure with an older keyframe and odometry."""
    T_world_source = T_world[closure.target] @ closure.match.T_target_source
    return T_world_source @ lie.between(keyframes[closure.source].T_odom_lidar, keyframes[keyframe].T_odom_lidar)
