"""A lidar carried elsewhere while nothing is recorded: a segment of its own, until it is relocalized."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Closure, ClosureVerdict, Keyframe, Proposal
from scanchain.graph.factors import edge_information
from scanchain.graph.pose_graph import PoseGraph
from scanchain.logs import open_log
from scanchain.loops.connectivity import Segments
from scanchain.loops.evidence import _OF_FIND as FOUND
from scanchain.loops.evidence import SequentialPlaceTest
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.odometry import Odometry
from scanchain.odometry.odometry import first_match
from scanchain.runs.closures import final_verdicts
from scanchain.slam import Slam
from tests.benchmarks.harness import ate_m
from tests.support.graphs import graph_of
from tests.support.scenes import configured, shared_data, stored


def joined(count, loops=()):
    """So many keyframes, and loops between some of them."""
    one = [lie.identity(2)]
    return graph_of(one * count, loops, one * len(loops), np.eye(3), [True] * len(loops))


def connected(segments, graph):
    """Which keyframes loops or odometry connect to the newest."""
    components = segments.components(graph)
    return components == components[-1]


def test_a_new_segment_is_connected_to_nothing_until_a_loop_does_it():
    segments = Segments()
    assert connected(segments, joined(5)).all()
    segments.start(3)
    segments.start(6)
    assert connected(segments, joined(9)).tolist() == [False] * 6 + [True] * 3
    assert connected(segments, joined(9, [(1, 4)])).tolist() == [False] * 6 + [True] * 3
    assert connected(segments, joined(9, [(1, 7)])).tolist() == [True] * 3 + [False] * 3 + [True] * 3
    assert connected(segments, joined(9, [(4, 7), (1, 4)])).all()


def test_a_submap_holds_keyframes_of_its_own_segment_alone():
    points = np.array([[1.0, 0.0], [1.0, 0.05], [1.0, 0.1]])
    keyframes = [Keyframe(k, k, k, stored(points), lie.pose_2d(10.0 * k, 0.0, 0.0), 1.0 * k) for k in range(8)]
    segments = Segments()
    whole = VoxelSubmaps(2, 5, configured(2).local_map, segments).around(5, keyframes, 7)
    segments.start(4)
    part = VoxelSubmaps(2, 5, configured(2).local_map, segments).around(5, keyframes, 7)
    assert np.ptp(whole.points()[:, 0]) == pytest.approx(70.0)
    assert np.ptp(part.points()[:, 0]) == pytest.approx(30.0)


def test_a_span_ends_where_the_next_segment_starts_in_which_a_submap_is_anchored():
    segments = Segments()
    segments.start(7)
    assert [segments.span(k, 12) for k in (0, 6, 7, 11)] == [(0, 7), (0, 7), (7, 12), (7, 12)]
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
    graph.optimize(configured(2).graph, initialize="given")
    assert np.allclose(graph.poses[1:3, :2, 2], graph.poses[399:401, :2, 2], atol=1e-6)


def square(half_m):
    """A room around the lidar."""
    along = np.linspace(-half_m, half_m, 200)
    sides = [np.column_stack([along, np.full(200, side)]) for side in (-half_m, half_m)]
    return np.vstack([*sides, *(side[:, ::-1] for side in sides)])


def keyframes_in(rooms, away_m=()):
    """Three keyframes of a map in a room of 8 m, and a log's, a meter apart, in rooms of these half widths."""
    sizes = [4.0] * 3 + list(rooms)
    at_m = [0.0] * 3 + (list(away_m) or [0.0] * len(rooms))
    return [
        Keyframe(k, k, k, stored(square(size)), lie.pose_2d(x_m, 0.0, 0.0), 1.0 * k)
        for k, (size, x_m) in enumerate(zip(sizes, at_m, strict=True))
    ]


def begun():
    segments = Segments()
    segments.start(3)
    return SequentialPlaceTest(segments), segments


def up_to(index, keyframes):
    """The keyframes up to one of them, and their poses."""
    known = keyframes[: index + 1]
    return known, np.array([each.T_odom_lidar for each in known])


def tried(*sources, y_m=0.0, overlap=0.95, verdict=ClosureVerdict.ACCEPTED):
    match = first_match(lie.pose_2d(0.0, y_m, 0.0), np.empty((0, 2)), configured(2).matching)
    return [Closure(0, source, match, overlap, verdict, "") for source in sources]


def test_keyframes_that_fit_one_place_join_a_log_to_a_map_once_they_are_enough():
    keyframes = keyframes_in([4.0] * 8)
    evidence, segments = begun()
    graph = joined(11)
    assert not evidence.update(tried(3, overlap=0.61), *up_to(3, keyframes))
    assert evidence.is_testing and not evidence.is_accepted
    assert not evidence.update(tried(4, overlap=0.61), *up_to(4, keyframes))
    assert not evidence.update(tried(5, y_m=3.0), *up_to(5, keyframes)), "it is at another pose"
    joining = [evidence.update(tried(source, overlap=0.61), *up_to(source, keyframes)) for source in range(6, 9)]
    assert [[each.source for each in closures] for closures in joining] == [[], [], [3, 4, 6, 7, 8]]
    assert not evidence.is_testing and evidence.bound == pytest.approx(np.log(1e3))
    assert connected(segments, graph).tolist() == [False] * 3 + [True] * 8


def test_a_place_that_was_seen_through_is_dropped_however_well_the_scans_fit():
    keyframes = keyframes_in([9.0] * 8)
    evidence, _ = begun()
    for source in range(3, 9):
        assert not evidence.update(tried(source), *up_to(source, keyframes))
    assert evidence.is_rejected(keyframes[-1])
    evidence.reject(3)
    assert not evidence.is_testing and np.isnan(evidence.best)


def test_keyframes_closer_than_a_meter_count_for_the_path_between_them():
    apart, close = keyframes_in([4.0] * 8), keyframes_in([4.0] * 8)
    close = [replace(each, traveled_m=3.0 + 0.25 * each.index) for each in close]
    odds = []
    for keyframes in (apart, close):
        evidence, _ = begun()
        evidence.update(tried(3), *up_to(3, keyframes))
        evidence.update(tried(4), *up_to(4, keyframes))
        odds.append(evidence.log_odds)
    assert [each - FOUND[2] for each in odds] == pytest.approx([4.0, 2.5])


def test_the_longer_the_path_that_was_sought_the_more_a_place_has_to_show():
    keyframes = [replace(each, traveled_m=20.0 * each.index) for each in keyframes_in([4.0] * 8)]
    evidence, _ = begun()
    evidence.update(tried(3, overlap=0.61), *up_to(3, keyframes))
    assert evidence.bound == pytest.approx(np.log(1e3))
    log_odds = evidence.log_odds
    evidence.reject(3)
    assert evidence.best == log_odds, "that was cut short, and so is not certain"
    evidence.update(tried(7, overlap=0.61), *up_to(7, keyframes))
    assert evidence.bound == pytest.approx(np.log(1e3 * 80.0 / 8.0))


def test_what_is_joined_is_withdrawn_once_the_place_is_seen_through_and_not_before():
    keyframes = keyframes_in([4.0] * 6 + [9.0] * 12)
    evidence, _ = begun()
    for source in range(3, 7):
        evidence.update(tried(source), *up_to(source, keyframes))
    assert not evidence.is_testing
    holds = [evidence.update_joined(tried(source), *up_to(source, keyframes)) for source in range(9, 21)]
    assert holds[0] and holds[3] and not holds[-1]


def test_another_pose_is_taken_once_more_keyframes_match_there_than_at_the_first():
    keyframes = keyframes_in([4.0] * 20)
    evidence, rival = begun()[0], begun()[0]
    evidence.update(tried(3, 4, 5), *up_to(5, keyframes))
    evidence.update_joined(tried(6, 7, 8, 9, 10), *up_to(10, keyframes))
    assert evidence.matches == 8.0
    joining = [
        rival.update(tried(source), *up_to(source, keyframes), least_matches=evidence.matches)
        for source in range(11, 20)
    ]
    assert not any(joining[:5]) and any(joining), "it needs about as many keyframes as the first had"
    evidence.reject(3)
    assert evidence.matches == 0.0
    evidence.continue_from(rival)
    assert evidence.matches == rival.matches and not evidence.is_testing


def test_a_place_that_was_given_is_believed_until_it_is_seen_through():
    keyframes = keyframes_in([4.0] * 2 + [9.0] * 12)
    evidence, _ = begun()
    evidence.accept()
    assert evidence.passes_at(range(3, len(keyframes)), *up_to(len(keyframes), keyframes)), "nothing was tried"
    holds = [evidence.update_joined(tried(source), *up_to(source, keyframes)) for source in range(3, 17)]
    assert all(holds[:6]) and not holds[-1]
    evidence.record(tried(*range(3, 17)))
    assert not evidence.passes_at(range(3, len(keyframes)), *up_to(len(keyframes), keyframes))


def test_places_proposed_elsewhere_say_nothing_about_a_place_that_is_joined():
    keyframes = keyframes_in([4.0] * 6)
    evidence, _ = begun()
    for source in range(3, 7):
        evidence.update(tried(source), *up_to(source, keyframes))
    before = evidence.log_odds
    elsewhere = [
        replace(each, proposed_by=Proposal.PLACE)
        for each in tried(8, y_m=9.0, overlap=0.1, verdict=ClosureVerdict.REJECTED)
    ]
    assert evidence.update_joined(elsewhere, *up_to(8, keyframes)) and evidence.log_odds == before


@pytest.mark.parametrize(("away_m", "holds"), [(0.0, False), (30.0, True)])
def test_what_does_not_match_counts_against_a_log_only_where_the_map_shows_it(away_m, holds):
    keyframes = keyframes_in([4.0] * 6 + [9.0] * 20, [0.0] * 6 + [away_m] * 20)
    evidence, _ = begun()
    evidence.record(tried(*range(3, 9)))
    at_wrong = tried(*range(9, 29), overlap=0.2, verdict=ClosureVerdict.REJECTED)
    evidence.record(at_wrong)
    assert evidence.passes_at(range(3, len(keyframes)), *up_to(len(keyframes), keyframes)) is holds
    assert np.isfinite(evidence.best) is np.bool_(holds)


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
    scans = list(islice(log.scans(), 8000))
    whole, none = carried(Slam(configured(2), log.T_base_lidar), scans, 0, 0)
    slam = Slam(configured(2), log.T_base_lidar)
    holed, starts = carried(slam, scans, 4000, 4600)
    before, after = (ate_m(trajectory, whole.trajectory) for trajectory in (holed.odometry, holed.trajectory))
    assert len(slam.back_end.closer.segments.starts) == 2
    assert none == [] and starts == [4600]
    assert before > 5.0
    assert after < 0.5
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


def test_poses_beyond_a_motion_that_nothing_measured_are_still_optimized():
    information = np.tile(1e5 * np.eye(3), (199, 1, 1))
    information[[0, 120]] = edge_information(np.zeros((3, 3)), 19.0, 3.8)
    chain, poses = [(k, k + 1) for k in range(199)], [lie.pose_2d(float(k), 0.0, 0.0) for k in range(200)]
    graph = graph_of(poses, chain, [lie.pose_2d(1.0, 0.0, 0.0)] * 199, information)
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
