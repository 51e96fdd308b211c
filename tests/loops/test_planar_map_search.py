"""Search of a whole planar map: two rooms that a wall in one of them tells apart."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Keyframe
from scanchain.loops import LoopCloser
from scanchain.loops.place_search import completed
from scanchain.loops.planar_map_search import Hypothesis, PlanarMapSearch
from scanchain.registration import search
from tests.support.scenes import configured, square, stored

CENTERS = (lie.pose_2d(0.0, 0.0, 0.0), lie.pose_2d(30.0, 0.0, 0.0))
T_ROOM_LIDAR = lie.pose_2d(0.7, -0.4, 1.1)


def room(with_pillar):
    """Returns of a lidar in a room of 8 m x 6 m, with or without a pillar ahead."""
    angles = np.linspace(-np.pi, np.pi, 720, endpoint=False)
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    x, y = np.maximum(np.abs(directions), 1e-9).T
    ranges = np.minimum(
        np.where(directions[:, 0] > 0.0, 5.0, 3.0) / x, np.where(directions[:, 1] > 0.0, 2.0, 4.0) / y
    )
    ranges[np.abs(angles - 2.2) < 0.4] = 1.5  # a rectangle alone looks the same turned around
    if with_pillar:
        ranges[np.abs(angles + 0.6) < 0.4] = 2.0
    return ranges[:, None] * directions


def keyframes_in(pillars):
    """A room with and one without a pillar, each seen twice: once may be by mistake."""
    poses = np.repeat(CENTERS, 2, axis=0)
    clouds = [stored(room(pillar)) for pillar in np.repeat(pillars, 2)]
    return [Keyframe(k, k, k, cloud, poses[k], 30.0 * k) for k, cloud in enumerate(clouds)]


def rooms(pillars):
    """The search in a map of two rooms."""
    return PlanarMapSearch(keyframes_in(pillars), 0.1)


def seen(with_pillar):
    return lie.transform(lie.inverse(T_ROOM_LIDAR), room(with_pillar))


@pytest.mark.parametrize("which", [0, 1])
def test_free_space_tells_rooms_apart_that_have_the_same_walls(which):
    best = completed(rooms([True, False]).searched(seen(with_pillar=which == 0)))
    off_m, off_rad = lie.apart(CENTERS[which] @ T_ROOM_LIDAR, best.T_map_lidar)
    assert off_m < 0.1 and off_rad < 0.03
    assert best.share > 0.9
    assert best.rival < 0.95 * best.share


def test_two_identical_rooms_rival_each_other():
    best = completed(rooms([True, True]).searched(seen(with_pillar=True)))
    assert best.rival > 0.95 * best.share


def test_a_search_in_slices_finds_what_one_at_once_does(monkeypatch):
    target, points = rooms([True, False]), seen(with_pillar=True)
    slices, found = [], []
    for additions, steps in ((10**12, 10**9), (2_000_000, 100)):
        monkeypatch.setattr(search, "_ADDITIONS", additions)
        monkeypatch.setattr(search, "_STEPS", steps)
        slices.append(sum(1 for _ in target.searched(points)) + 1)
        found.append(completed(target.searched(points)))
    assert slices[0] == 2 and slices[1] > 3
    one, other = found
    assert (one.T_map_lidar == other.T_map_lidar).all()
    assert (one.share, one.rival, one.points) == (other.share, other.rival, other.points)


def test_a_room_of_another_shape_is_nowhere():
    circle = np.stack([np.cos(a := np.linspace(-np.pi, np.pi, 720)), np.sin(a)], axis=1)
    assert completed(rooms([True, False]).searched(1.7 * circle)) is None


def test_a_place_that_looked_like_another_is_believed_after_more_of_the_path_alone():
    closer = LoopCloser(configured(2), 2)
    closer.start_segment(4)

    def found(old, traveled_m):
        newest = Keyframe(4, 4, 4, stored(seen(with_pillar=True)), np.eye(3), traveled_m)
        closer.search.underway = closer.search.finder.find([*two, newest], 4, PlanarMapSearch(old, 0.1))
        return closer.search.finish()

    two = keyframes_in([True, True])
    assert found(two[:2], 200.0)
    assert not found(two, 201.0)
    assert not found(two[:2], 202.0)
    (closure,) = found(two[:2], 203.5)
    off_m, off_rad = lie.apart(closure.match.T_target_source, T_ROOM_LIDAR)
    assert closure.target == 0 and off_m < 0.1 and off_rad < 0.03


def test_in_the_middle_of_a_square_room_the_heading_is_ambiguous():
    middle = [Keyframe(k, k, k, stored(square(4.0)), lie.identity(2), 0.0) for k in range(2)]
    best = completed(PlanarMapSearch(middle, 0.1).searched(square(4.0)))
    assert lie.apart(best.T_map_lidar, lie.identity(2))[0] < 0.1 and best.is_certain and best.is_ambiguous


def test_a_lidar_is_nowhere_that_the_map_does_not_know():
    x_m = np.arange(-6.0, 6.0, 0.02)
    wall = np.column_stack([x_m, np.random.default_rng(0).uniform(0.0, 2.0, 12)[(x_m + 6.0).astype(int)]])
    wall = np.vstack([wall, np.tile([[7.0, 9.0]], (9, 1))])  # seen past its end: the map reaches that far
    before, behind = lie.pose_2d(0.0, -3.0, 1.0), lie.pose_2d(0.0, 5.0, -2.0)
    seen_from = [lie.transform(lie.inverse(T), wall) for T in (before, behind)]
    known = PlanarMapSearch([Keyframe(k, k, k, stored(seen_from[0]), before, 0.0) for k in range(2)], 0.1)
    found = [completed(known.searched(points)) for points in seen_from]
    assert lie.apart(found[0].T_map_lidar, before)[0] < 0.1
    assert found[1] is None or lie.apart(found[1].T_map_lidar, behind)[0] > 1.0


class Answering:
    """A map in which a pose is found whatever is searched for; it keeps the number of points."""

    def __init__(self, share, points, keyframes):
        self.hypothesis, self.keyframes, self.sizes = Hypothesis(T_ROOM_LIDAR, share, 0.0, points), keyframes, []

    def searched(self, points):
        self.sizes.append(len(points))
        return self.hypothesis
        yield


@pytest.mark.parametrize(
    ("share", "points", "is_found"),
    [(0.6, 100, False), (0.62, 100, True), (0.42, 10_000, False), (0.44, 10_000, True)],
)
def test_a_pose_is_found_where_it_fits_far_better_than_so_few_points_do_by_chance(share, points, is_found):
    log = [Keyframe(k, k, k, stored(seen(with_pillar=True)), np.eye(3), 1.0 * k) for k in range(2, 30)]
    target = Answering(share, points, keyframes_in([True]))
    found = completed(LoopCloser(configured(2), 2).search.finder.find([*target.keyframes, *log], 2, target))
    assert bool(found) is is_found
    assert target.sizes == [9 * 720]  # of the last 8 m of the path


def newest_in(keyframes):
    """The next keyframe, in the first room, where odometry has it anywhere."""
    count = len(keyframes)
    return Keyframe(count, count, count, stored(seen(with_pillar=True)), lie.pose_2d(9.0, 9.0, 1.0), 500.0)


@pytest.mark.parametrize(
    ("rooms", "expected", "radius_m", "is_found"),
    [
        (1, lie.pose_2d(4.0, -2.4, 1.8), 5.0, True),  # where the position is uncertain, so is the heading
        (1, lie.pose_2d(15.0, 0.0, 1.1), 17.0, True),
        (2, lie.pose_2d(15.0, 0.0, 1.1), 17.0, False),  # it fits in both
    ],
)
def test_within_the_drift_a_keyframe_is_closed_to_the_one_place_that_it_fits(rooms, expected, radius_m, is_found):
    finder, old = LoopCloser(configured(2), 2).search.finder, keyframes_in([True, True])
    T_world = np.array([*(each.T_odom_lidar for each in old), expected])
    near = np.arange(2 * rooms)
    closure = finder.within_drift([newest_in(old)], old, T_world, near=near, radius_m=radius_m)
    assert (closure is not None) is is_found
    if closure is not None:
        off_m, off_rad = lie.apart(closure.match.T_target_source, T_ROOM_LIDAR)
        assert closure.verdict.value == "accepted" and off_m < 0.05 and off_rad < 0.02


@pytest.mark.parametrize(
    ("off_m", "cause"), [(0.3, "verified by matching"), (0.7, "far from where the path was found")]
)
def test_scans_of_a_path_that_was_found_are_aligned_close_to_it_alone(off_m, cause):
    finder, old = LoopCloser(configured(2), 2).search.finder, keyframes_in([True])
    source = newest_in(old)
    closure = finder.aligned(source, lie.pose_2d(off_m, 0.0, 0.0) @ T_ROOM_LIDAR, old[:1], [*old, source])
    assert closure.cause == cause
    assert lie.apart(closure.match.T_target_source, T_ROOM_LIDAR)[0] < 0.05
    assert finder.aligned(source, lie.pose_2d(9.0, 0.0, 0.0), old[:1], [*old, source]) is None
