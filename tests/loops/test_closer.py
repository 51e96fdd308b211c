"""Loop closure: which older keyframe is the target, revisits after drift, a lidar that was carried."""

from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import ClosureVerdict, Keyframe
from scanchain.logs import open_log
from scanchain.loops import LoopCloser, closer
from scanchain.runs.closures import final_verdicts
from scanchain.slam import Slam
from tests.benchmarks.harness import ate_m
from tests.benchmarks.loops import is_true, true_poses
from tests.support.drifting import drifting_slam, stretched
from tests.support.graphs import chained, graph_of
from tests.support.matching import Assumed
from tests.support.scenes import configured, shared_data, square, stored


@pytest.mark.parametrize(
    ("turned", "chosen", "expected"), [(0.3, 0, 4), (0.6, 0, -1), (0.3, 7, 14), (0.3, 20, -1)]
)
def test_the_first_pass_near_a_pose_is_found_where_it_is_nearest(turned, chosen, expected):
    """Two passes of ten poses, 1 m apart each."""
    poses = [lie.pose_2d(k % 10, 0.1 * (k // 10), 0.0) for k in range(20)]
    poses = np.array([*poses, lie.pose_2d(4.2, 0.0, turned)])
    assert closer.on_first_pass(poses, np.arange(20) >= chosen, 2.0) == expected


ALONG = [(0.0, 0.0), (0.5, 3.0), (1.0, 6.0), (1.5, 9.0), (1.0, 12.0), (0.5, 15.0), (0.1, 18.0)]  # x, path traveled


def keyframes_along(places):
    """Keyframes in a room of 8 m at these places, m, after these paths, m."""
    return [
        Keyframe(k, k, k, stored(square(4.0) - [x_m, 0.0]), lie.pose_2d(x_m, 0.0, 0.0), traveled_m)
        for k, (x_m, traveled_m) in enumerate(places)
    ]


@pytest.mark.parametrize(
    ("off_m", "is_connected", "changes", "is_closed"),
    [
        (0.3, True, {}, True),
        (0.3, False, {}, False),
        (0.3, True, {"loops.min_travel_m": 18.5}, False),  # nothing lies so far back
        (1.2, True, {}, False),  # farther than odometry drifts
        (1.2, True, {"loops.min_radius_m": 2.0}, True),
    ],
)
def test_a_keyframe_is_closed_to_the_nearest_of_those_far_enough_back(off_m, is_connected, changes, is_closed):
    keyframes, near = keyframes_along(ALONG), LoopCloser(configured(2, changes), 2).near
    poses, edges = np.array([each.T_odom_lidar for each in keyframes]), [*pairwise(range(len(keyframes)))]
    measured = lie.between(poses[:-1], poses[1:])
    poses[-1, 0, 2] -= off_m
    graph = graph_of(poses, edges, measured, 1e6 * np.eye(3))
    closures = near.close(keyframes, graph, np.full(len(poses), is_connected))
    assert len(closures) == is_closed
    for closure in closures:
        assert (closure.target, closure.source, closure.verdict) == (0, 6, ClosureVerdict.ACCEPTED)
        assert lie.apart(closure.match.T_target_source, lie.pose_2d(0.1, 0.0, 0.0))[0] < 0.01


def test_at_a_pose_in_a_map_the_newest_keyframe_is_closed_to_it_and_away_from_it_to_nothing():
    keyframes = keyframes_along([*((0.5 * k - 2.5, 0.5 * k) for k in range(11)), (2.3, 90.0)])
    closer_ = LoopCloser(configured(2), 2)
    closer_.add_map(keyframes[:11])
    (closure,) = closer_.near.in_map_at(lie.pose_2d(2.45, 0.1, 0.05), keyframes)
    assert (closure.target, closure.verdict) == (10, ClosureVerdict.ACCEPTED)
    assert lie.apart(closure.match.T_target_source, lie.pose_2d(-0.2, 0.0, 0.0))[0] < 0.01
    assert closer_.near.in_map_at(lie.pose_2d(3.6, 0.0, 0.0), keyframes) == ()


def closed(near, keyframes, sigma_m=1e-3):
    """Closures of the newest keyframe."""
    return near.close(keyframes, chained(keyframes, sigma_m), np.ones(len(keyframes), bool))


def test_a_keyframe_is_aligned_to_what_was_seen_long_before_it_alone():
    keyframes = keyframes_along(ALONG)
    keyframes[3] = replace(keyframes[3], stored=stored(square(9.0)))  # 9 m before, but in the window of the submap
    near = LoopCloser(configured(2), 2).near
    near.verifier = Assumed(is_accepted=True)
    closed(near, keyframes)
    (submap,) = near.verifier.submaps
    assert np.ptp(submap.points(), axis=0) == pytest.approx([8.0, 8.0], abs=0.1)


class Searching:
    """A finder that keeps what is searched for within the drift, and finds nothing."""

    def __init__(self):
        self.found = []

    def within_drift(self, path, old, T_world, *, near, radius_m):
        self.found.append(([each.index for each in path], radius_m))


def test_in_a_map_the_path_of_the_log_is_searched_for_within_all_of_the_drift_and_again_after_a_fifth_of_it():
    keyframes = keyframes_along([*((0.5 * k, 0.5 * k) for k in range(11)), *((5.0, 90.0 + k) for k in range(9))])
    near, counts = LoopCloser(configured(2), 2).near, []
    near.of_map, near.verifier, near.finder = 11, Assumed(is_accepted=False), Searching()
    for count in range(12, 21):
        before = len(near.finder.found)
        closed(near, keyframes[:count], 1.0)
        counts += [count] * (len(near.finder.found) - before)
    paths, radii_m = zip(*near.finder.found, strict=True)
    assert counts == [12, 16, 20] and paths == ([11], [*range(11, 16)], [*range(15, 20)])
    assert radii_m == pytest.approx(
        [11.0 * np.sqrt(2.0), 20.0, 20.0], abs=0.01
    )  # to the first keyframe, and at most


def test_a_log_in_a_map_is_closed_to_the_map_even_where_its_own_path_is_nearer():
    keyframes = keyframes_along([*((0.5 * k, 0.5 * k) for k in range(10)), (2.8, 80.0), (4.0, 95.0), (2.8, 110.0)])
    near = LoopCloser(configured(2), 2).near
    near.of_map = 10
    (closure,) = closed(near, keyframes)
    assert (closure.target, closure.verdict) == (5, ClosureVerdict.ACCEPTED)


@pytest.mark.parametrize(("scale", "targets"), [(1.0, [15, 15, 10]), (0.5, [15, 10, 10])])
def test_in_space_the_submap_of_a_map_stays_the_target_for_ten_meters_unless_it_is_searched_again(scale, targets):
    """Submaps of a map lie 10 m apart; a log goes back along it."""
    cloud = stored(np.random.default_rng(0).normal(size=(50, 3)))
    mapped = [
        Keyframe(k, k, k, cloud, lie.lift(lie.pose_2d(2.0 * k, 0.0, 0.0)), 2.0 * k, scale) for k in range(31)
    ]
    closer_ = LoopCloser(configured(3, {"loops.enabled": False}), 3)
    closer_.add_map(mapped)
    closer_.near.verifier = Assumed(is_accepted=True)

    def target(x_m):
        newest = Keyframe(31, 31, 31, cloud, lie.lift(lie.pose_2d(x_m, 0.0, 0.0)), 200.0, scale)
        (closure,) = closed(closer_.near, [*mapped, newest], 10.0)
        return closure.target

    assert [target(x_m) for x_m in (31.0, 22.0, 19.5)] == targets
    assert target(31.0) == 15
    closer_.search_again()
    assert target(22.0) == 10


def run(longer, turn_rad_m):
    log = open_log(shared_data("2d/mit_csail.mcap"))
    slam = drifting_slam(configured(2), log.T_base_lidar, stretched(longer, turn_rad_m))
    for scan in log.scans():
        slam.process(scan)
    return slam.finish()


@pytest.fixture(scope="module")
def undrifted():
    return run(0.0, 0.0)


@pytest.mark.parametrize(
    ("longer", "turn_rad_m"), [(0.01, 0.002), pytest.param(0.01, -0.005, marks=pytest.mark.slow)]
)
def test_drift_is_closed_to_a_fifth_and_no_loop_is_wrong(undrifted, longer, turn_rad_m):
    truth = undrifted.trajectory
    drifted = run(longer, turn_rad_m)
    before, after = (ate_m(trajectory, truth) for trajectory in (drifted.odometry, drifted.trajectory))
    assert before > 2.0
    assert after < before / 5.0
    judged = final_verdicts(drifted.closures, drifted.state)
    accepted = [item for item in judged if item.verdict is ClosureVerdict.ACCEPTED]
    assert len(accepted) > 50
    true = true_poses(2, truth, drifted.keyframes)
    assert all(is_true(closure, true) for closure in accepted)


@pytest.mark.parametrize(
    # in its pass, ahead or behind; in the first one; too far ahead, or behind; none was matched; in 2D
    ("dimension", "target", "closest"),
    [(3, 40, 45), (3, 55, 45), (3, 5, 15), (3, 0, 75), (3, 58, 75), (3, -1, 75), (2, 40, 15), (2, -1, 15)],
)
def test_a_revisit_stays_with_the_pass_that_was_matched_last_and_in_the_plane_with_the_first(
    monkeypatch, dimension, target, closest
):
    """Three passes of 30 keyframes, 2 m apart each; the newest keyframe lies in the third."""
    monkeypatch.setattr(closer, "_LARGE", 90)
    near = LoopCloser(configured(dimension), dimension).near
    T_world = np.tile(lie.identity(dimension), (91, 1, 1))
    T_world[:90, :2, -1] = [(2.0 * (k % 30), 0.1 * (k // 30)) for k in range(90)]
    T_world[90, :2, -1] = 30.0, 0.2
    near.target = target
    assert near._next(T_world, 90, np.ones(91, bool))[0] == closest
    assert near._next(T_world[1:], 89, np.ones(90, bool))[0] == 74


def carried(slam, scans, first, last):
    """The result of a log of which some scans were not recorded, and the scans that start a segment."""
    starts = [
        scan.index
        for index, scan in enumerate(scans)
        if not first <= index < last and slam.process(replace(scan, T_odom_base=None)).starts_segment
    ]
    return slam.finish(), starts


@pytest.mark.slow
def test_a_robot_that_was_carried_elsewhere_is_found_again():
    log = open_log(shared_data("2d/intel.mcap"))
    scans = list(islice(log.scans(), 5600))
    whole, none = carried(Slam(configured(2), log.T_base_lidar), scans, 0, 0)
    slam = Slam(configured(2), log.T_base_lidar)
    holed, starts = carried(slam, scans, 4000, 4600)
    before, after = (ate_m(trajectory, whole.trajectory) for trajectory in (holed.odometry, holed.trajectory))
    assert len(slam.back_end.closer.segments.starts) == 2
    assert none == [] and starts == [4600]
    assert before > 3.0
    assert after < 0.1
    across = [
        item.proposed_by
        for item in final_verdicts(holed.closures, holed.state)
        if item.verdict is ClosureVerdict.ACCEPTED
        and item.target < slam.back_end.closer.segments.starts[1] <= item.source
    ]
    assert len(across) > 10


@pytest.mark.slow
def test_a_robot_that_was_carried_to_another_corridor_like_one_before_stays_apart():
    log = open_log(shared_data("2d/intel.mcap"))
    scans = list(islice(log.scans(), 3485, 10087))
    slam = Slam(configured(2), log.T_base_lidar)
    result, starts = carried(slam, scans, 3743, 4901)
    assert len(starts) == 1 and result.components[0] != result.components[-1]
