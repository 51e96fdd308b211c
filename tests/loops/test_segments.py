"""A lidar carried elsewhere while nothing is recorded: a segment of its own, until it is relocalized."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, Keyframe
from scanchain.evaluation import absolute_error, pair
from scanchain.graph.pose_graph import PoseGraph
from scanchain.logs import open_log
from scanchain.loops.connectivity import Segments
from scanchain.loops.evidence import MapEvidence
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.odometry import Odometry
from scanchain.odometry.tracked import first_match
from scanchain.runs.closures import final_verdicts
from scanchain.slam import Slam, edge_information
from tests.support.scenes import configured, shared_data, stored


def graph_of(count, loops=()):
    graph = PoseGraph(2)
    for index in range(count):
        graph.add_pose(lie.identity(2), index)
    for i, j in loops:
        graph.add_edge(i, j, lie.identity(2), np.eye(3), is_loop=True)
    return graph


def connected(segments, graph):
    """Which keyframes loops or odometry connect to the newest."""
    components = segments.components(graph)
    return components == components[-1]


def test_without_a_gap_everything_is_one_segment():
    assert connected(Segments(), graph_of(5)).all()


def test_a_new_segment_is_connected_to_nothing_until_a_loop_does_it():
    segments = Segments()
    segments.start(3)
    segments.start(6)
    assert connected(segments, graph_of(9)).tolist() == [False] * 6 + [True] * 3
    assert connected(segments, graph_of(9, [(1, 4)])).tolist() == [False] * 6 + [True] * 3
    assert connected(segments, graph_of(9, [(1, 7)])).tolist() == [True] * 3 + [False] * 3 + [True] * 3
    assert connected(segments, graph_of(9, [(4, 7), (1, 4)])).all()


def test_a_span_ends_where_the_next_segment_starts():
    segments = Segments()
    segments.start(3)
    assert [segments.span(k, 8) for k in (0, 2, 3, 7)] == [(0, 3), (0, 3), (3, 8), (3, 8)]


def test_a_submap_holds_keyframes_of_its_own_segment_alone():
    points = np.array([[1.0, 0.0], [1.0, 0.05], [1.0, 0.1]])
    keyframes = [Keyframe(k, k, k, stored(points), lie.pose_2d(10.0 * k, 0.0, 0.0), 1.0 * k) for k in range(8)]
    segments = Segments()
    whole = VoxelSubmaps(2, 5, configured(2).local_map, segments).around(5, keyframes, 7)
    segments.start(4)
    part = VoxelSubmaps(2, 5, configured(2).local_map, segments).around(5, keyframes, 7)
    assert np.ptp(whole.points()[:, 0]) == pytest.approx(70.0)
    assert np.ptp(part.points()[:, 0]) == pytest.approx(30.0)


def test_a_submap_is_anchored_in_the_segment_of_its_keyframe():
    segments = Segments()
    segments.start(7)
    submaps = VoxelSubmaps(2, 5, configured(2).local_map, segments)
    assert [submaps.anchor_of(k) for k in (0, 4, 6, 7, 9, 10, 14)] == [0, 0, 5, 7, 7, 10, 10]


def test_a_long_log_that_hangs_on_a_map_by_next_to_no_information_is_optimized():
    graph, k = PoseGraph(2), 3
    graph.fix(graph.add_pose(lie.identity(2), 0))
    anywhere = edge_information(np.zeros((k, k)), 1e4, np.pi)
    close = edge_information(1e6 * np.eye(k), 0.01, 0.003)
    for index in range(1, 401):
        before = index - 1
        graph.add_pose(lie.pose_2d(0.5 * (before % 2), 0.0, 0.0), index)
        Z = lie.between(graph.poses[before], graph.poses[index])
        graph.add_edge(before, index, Z, anywhere if index == 1 else close)
        if index > 2:
            graph.add_edge(1 + before % 2, index, lie.identity(2), close, is_loop=True)
    graph.optimize(configured(2).graph, initialize="given", rejection="refined")
    assert np.allclose(graph.poses[1:3, :2, 2], graph.poses[399:401, :2, 2], atol=1e-6)


def match_of(T):
    return replace(first_match(T, np.empty((0, 2)), configured(2).matching), T_target_source=T)


def square(half_m):
    """A room around the lidar."""
    along = np.linspace(-half_m, half_m, 200)
    sides = [np.column_stack([along, np.full(200, side)]) for side in (-half_m, half_m)]
    return np.vstack([*sides, *(side[:, ::-1] for side in sides)])


@pytest.mark.parametrize(("half_m", "joins"), [(4.0, True), (9.0, False)])
def test_three_keyframes_that_agree_join_a_log_to_a_map_unless_it_was_seen_through(half_m, joins):
    points = [stored(square(4.0))] * 3 + [stored(square(half_m))] * 6
    keyframes = [Keyframe(k, k, k, points[k], lie.pose_2d(0.5 * (k % 3), 0.0, 0.0), 1.0 * k) for k in range(9)]
    segments = Segments()
    segments.start(3)
    evidence = MapEvidence(segments, 3)

    def closures(*sources, y_m=0.0):
        return [
            Closure(k % 3, k, match_of(lie.pose_2d(0.0, y_m, 0.0)), 0.9, ClosureVerdict.ACCEPTED, "")
            for k in sources
        ]

    graph = graph_of(9)
    assert not evidence.collect(closures(3), keyframes[:4]) and connected(segments, graph).all()
    assert not evidence.collect(closures(4), keyframes[:5])
    assert not evidence.collect(closures(5, y_m=3.0), keyframes[:6]), "it is at another pose"
    assert [each.source for each in evidence.collect(closures(6), keyframes[:7])] == ([3, 4, 6] if joins else [])
    assert evidence.is_gathering is not joins
    assert connected(segments, graph).tolist() == [not joins] * 3 + [True] * 6


def test_a_pose_in_a_map_that_further_keyframes_do_not_confirm_is_given_up():
    segments = Segments()
    segments.start(3)
    evidence = MapEvidence(segments, 3)
    keyframes = [Keyframe(k, k, k, stored(square(4.0)), lie.identity(2), 1.0 * k) for k in range(20)]
    closure = Closure(0, 3, match_of(lie.identity(2)), 0.9, ClosureVerdict.ACCEPTED, "")
    evidence.collect([closure, replace(closure, source=4)], keyframes[:5])
    for source in range(5, 9):
        evidence.collect(
            [replace(closure, source=source, verdict=ClosureVerdict.REJECTED)], keyframes[: source + 1]
        )
    assert evidence.is_gathering and not evidence.is_in_vain(keyframes[:15])
    assert evidence.is_in_vain(keyframes[:16])
    evidence.reset()
    assert not evidence.is_gathering and not connected(segments, graph_of(16))[:3].any()


@pytest.mark.parametrize(("away_m", "joins"), [(0.0, False), (30.0, True)])
def test_keyframes_that_do_not_match_count_against_a_log_only_where_the_map_shows_them(away_m, joins):
    at_m = [*[0.0] * 3, *[0.0] * 4, *[away_m] * 20]
    keyframes = [
        Keyframe(k, k, k, stored(square(4.0)), lie.pose_2d(x_m, 0.0, 0.0), 1.0) for k, x_m in enumerate(at_m)
    ]
    evidence = MapEvidence(Segments(), 3)
    closure = Closure(0, 3, match_of(lie.identity(2)), 0.9, ClosureVerdict.REJECTED, "")
    evidence.note([replace(closure, source=source) for source in range(3, 27)])
    assert evidence.joins(keyframes[3:], {3, 4, 5, 6}, keyframes) is joins
    assert not evidence.joins(keyframes[3:], {3, 4}, keyframes), "two are too few"


def carried(slam, scans, first, last):
    """The result of a log of which some scans were not recorded, and the scans that start a segment."""
    starts = [
        scan.index
        for index, scan in enumerate(scans)
        if not first <= index < last and slam.process(replace(scan, T_odom_base=None)).starts_segment
    ]
    return slam.finish(), starts


def test_a_robot_that_was_carried_elsewhere_is_found_again():
    log = open_log(shared_data("2d/intel.mcap"))
    scans = list(islice(log.scans(), 8000))
    whole, none = carried(Slam(configured(2), log.T_base_lidar), scans, 0, 0)
    slam = Slam(configured(2), log.T_base_lidar)
    holed, starts = carried(slam, scans, 4000, 4600)
    before, after = (
        absolute_error(pair(trajectory, whole.trajectory)).translation_m.rmse
        for trajectory in (holed.odometry, holed.trajectory)
    )
    assert len(slam.closer.segments.starts) == 2
    assert none == [] and starts == [4600]
    assert before > 5.0
    assert after < 0.5
    across = [
        item.closure.proposed_by
        for item in final_verdicts(holed.closures, holed.state)
        if item.verdict is ClosureVerdict.ACCEPTED
        and item.closure.target < slam.closer.segments.starts[1] <= item.closure.source
    ]
    assert len(across) > 10


def test_poses_beyond_a_motion_that_nothing_measured_are_still_optimized():
    graph, step = PoseGraph(2), lie.pose_2d(1.0, 0.0, 0.0)
    nothing = np.zeros((3, 3))
    for index in range(200):
        graph.add_pose(lie.pose_2d(float(index), 0.0, 0.0), index)
    for index in range(199):
        lost = 19 if index in (0, 120) else 0
        information = edge_information(nothing, 1.0 * lost, 0.2 * lost) if lost else 1e5 * np.eye(3)
        graph.add_edge(index, index + 1, step, information)
    for index in range(150, 160):
        graph.add_edge(index, index + 30, lie.pose_2d(30.0, 0.0, 0.0), 1e5 * np.eye(3), is_loop=True)
    assert graph.optimize(configured(2).graph, initialize="given").converged


def test_a_short_silence_begins_no_new_map():
    log = open_log(shared_data("2d/intel.mcap"))
    odometry = Odometry(configured(2), log.T_base_lidar)
    tracked = [
        odometry.process(replace(scan, T_odom_base=None))
        for index, scan in enumerate(islice(log.scans(), 400))
        if not 200 <= index < 205
    ]
    assert not any(each.elsewhere_m for each in tracked)
