"""A lidar carried elsewhere while nothing is recorded: a segment of its own, until it is relocalized."""

from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import ClosureVerdict, Keyframe
from scanchain.evaluation import absolute_error, pair
from scanchain.graph.pose_graph import PoseGraph
from scanchain.logs import open_log
from scanchain.loops.connectivity import Segments
from scanchain.loops.submaps import VoxelSubmaps
from scanchain.odometry import Odometry
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
