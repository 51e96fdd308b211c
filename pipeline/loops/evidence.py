"""Evidence that keyframes belong to a map: closures from several of them, and free space that agrees."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, Keyframe, Pose, Proposal
from scanchain.kernels.raycast.free_space import compare_ranges, nearest_ranges
from scanchain.loops.connectivity import Segments

MIN_SHARE = 0.3  # least share of the keyframes in force among those that closures were tried from
_MIN_KEYFRAMES = 3  # least number of keyframes with a closure in force that join a map
_MAX_CONTRADICTION = 0.1  # largest share of points in sight that lie in the free space of the other
_NEAR_M = {2: 5.0, 3: 10.0}  # largest distance of two keyframes that are compared for it, by dimension
_BINS = 360  # of azimuth, 1°; as fine in elevation
_MARGIN_M, _MARGIN_SHARE = {2: 0.3, 3: 1.0}, 0.05  # by which ranges may differ, beside that share of them
_IN_SIGHT = 0.3  # share of the points of a keyframe, from which on those in view of the map's nearest one show it
_MOST = 200  # largest number of keyframes of a log that are compared, evenly spread over them
_PATIENCE = 10  # number of new keyframes from which on a pose in the map that was not confirmed is given up
_TESTED = 5  # number of tested ones from which on it is if too few of these agree
_AGREE_M, _AGREE_RAD = 1.0, 0.1  # largest difference between the poses that two closures imply


def are_enough(in_force: int, tried: int) -> bool:
    """True if so many keyframes with a closure in force, of those that were tried, join a map."""
    return in_force >= max(_MIN_KEYFRAMES, MIN_SHARE * tried)


def is_contradicted(keyframes: Sequence[Keyframe], others: Sequence[Keyframe]) -> bool:
    """True if more points of keyframes in one frame than of another day lie in the free space of the others."""
    return contradiction(keyframes, others) > _MAX_CONTRADICTION


def contradiction(some: Sequence[Keyframe], others: Sequence[Keyframe]) -> float:
    """Share, of the points of keyframes in view of the nearest one of the others, that lie in its free space."""
    agreeing, contradicting = compared(some, others) + compared(others, some)
    return float(contradicting / max(agreeing + contradicting, 1))


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


def are_in_sight(keyframes: Sequence[Keyframe], others: Sequence[Keyframe]) -> NDArray[np.bool_]:
    """True for keyframes (N,) that show what the nearest one of the others shows, or what it sees through."""
    pairs = zip(nearest(keyframes, others), keyframes, strict=True)
    return np.array([compared([a], [b]).sum() >= _IN_SIGHT * max(len(b.points), 1) for a, b in pairs], np.bool_)


def nearest(keyframes: Sequence[Keyframe], others: Sequence[Keyframe]) -> list[Keyframe]:
    """Of each of some keyframes, the nearest one of the others."""
    positions, targets = (np.array([each.T_odom_lidar[:-1, -1] for each in part]) for part in (others, keyframes))
    return [others[index] for index in np.atleast_1d(KDTree(positions).query(targets)[1]).tolist()]


class MapEvidence:
    """Closures of the newest segment of a log with a map, which wait until enough keyframes agree on a pose."""

    def __init__(self, segments: Segments, of_map: int) -> None:
        """of_map : number of the keyframes of the map, which come first."""
        self.segments = segments
        self.of_map = of_map
        self.is_given = False  # whether the pose of the first scan in the map is
        self.tried: set[int] = set()  # keyframes of the whole log that were tried where they lie in the map
        self.waiting: list[Closure] = []
        self.begun = 0  # number of keyframes when the first of these came
        self.tested: set[int] = set()  # keyframes that were tried since
        self.is_hopeless = False  # whether too few of them agree

    @property
    def is_gathering(self) -> bool:
        """True while a pose in the map is being tested."""
        return self.segments.is_assumed

    def collect(self, closures: Sequence[Closure], keyframes: Sequence[Keyframe]) -> tuple[Closure, ...]:
        """Take closures with the map of a segment that is not joined to it; all that waited, once they join it."""
        accepted = [each for each in closures if each.verdict is ClosureVerdict.ACCEPTED]
        if not self.waiting and not accepted:
            return ()
        self.begun = self.begun if self.waiting else len(keyframes)
        self.segments.is_assumed = True
        self.waiting += accepted
        self.tested |= {each.source for each in closures}
        agreeing = [each for each in self.waiting if self._agrees(each, keyframes)]
        sources, count = {each.source for each in agreeing}, len(self.tested)
        self.is_hopeless = count >= _TESTED and len(sources) < MIN_SHARE * count
        if not are_enough(len(sources), count):
            return ()
        placed = [replace(keyframes[c.source], T_odom_lidar=pose_in_map(c, c.source, keyframes)) for c in agreeing]
        if self._is_contradicted(placed, keyframes):
            return ()
        self.reset()
        return tuple(agreeing)

    def note(self, closures: Sequence[Closure]) -> None:
        """Note from which keyframes closures with the map were tried at the pose where these lie in it."""
        self.tried |= {each.source for each in closures if each.proposed_by is Proposal.POSITION}

    def is_in_vain(self, keyframes: Sequence[Keyframe]) -> bool:
        """True if enough keyframes passed without confirming the pose that is being tested."""
        return self.is_gathering and (self.is_hopeless or len(keyframes) - self.begun > _PATIENCE)

    def reset(self) -> None:
        """Nothing waits, and no pose is being tested."""
        self.segments.is_assumed = False
        self.waiting, self.tested, self.is_hopeless = [], set(), False

    def joins(self, placed: Sequence[Keyframe], in_force: set[int], keyframes: Sequence[Keyframe]) -> bool:
        """True if closures in force join the keyframes of a segment, at their final poses, to the map.

        Keyframes that were tried where the map shows nothing do not count.
        """
        begun, of_map = min(in_force), keyframes[: self.of_map]
        tried = [each for each in placed if each.index >= begun and each.index in self.tried | in_force]
        tried = tried[:: -(-len(tried) // _MOST)]
        is_matched = np.isin([each.index for each in tried], list(in_force))
        known = int((is_matched | are_in_sight(tried, of_map)).sum())
        is_enough = len(in_force) >= _MIN_KEYFRAMES and is_matched.sum() >= MIN_SHARE * known
        if self.is_given and known < _PATIENCE:
            is_enough = True
        return bool(is_enough) and not self._is_contradicted(placed[:: -(-len(placed) // _MOST)], keyframes)

    def _is_contradicted(self, placed: Sequence[Keyframe], keyframes: Sequence[Keyframe]) -> bool:
        """True if free space around keyframes at their poses in the map contradicts it, or they it."""
        around = {each.index: each for each in nearest(placed, keyframes[: self.of_map])}
        return is_contradicted(placed, list(around.values()))

    def _agrees(self, closure: Closure, keyframes: Sequence[Keyframe]) -> bool:
        """True if a closure implies the pose of its source that the first one does."""
        poses = (pose_in_map(each, closure.source, keyframes) for each in (self.waiting[0], closure))
        off_m, off_rad = lie.apart(*poses)
        return off_m < _AGREE_M * keyframes[closure.source].scale and off_rad < _AGREE_RAD


def pose_in_map(closure: Closure, keyframe: int, keyframes: Sequence[Keyframe]) -> Pose:
    """T_map_keyframe by a closure with the map and odometry."""
    T_map_source = keyframes[closure.target].T_odom_lidar @ closure.match.T_target_source
    return T_map_source @ lie.between(keyframes[closure.source].T_odom_lidar, keyframes[keyframe].T_odom_lidar)
