"""Loop closure in the plane: uncertainty from drift, and revisits after drift."""

import numpy as np
import pytest
from scipy.sparse.csgraph import csgraph_from_dense, dijkstra

from scanchain import lie
from scanchain.data import ClosureVerdict
from scanchain.kernels.graph.paths import path_lengths
from scanchain.logs import open_log
from scanchain.loops import LoopCloser, closer
from scanchain.loops.connectivity import Drift
from scanchain.runs.closures import final_verdicts
from tests.benchmarks.harness import ate_m
from tests.benchmarks.loops import is_true, true_poses
from tests.support.drifting import drifting_slam, stretched
from tests.support.graphs import graph_of
from tests.support.scenes import configured, shared_data


def chain(count, sigma_m=0.01):
    """Keyframes a meter apart on a straight line."""
    poses, edges = [lie.pose_2d(float(k), 0.0, 0.0) for k in range(count)], [(k, k + 1) for k in range(count - 1)]
    information = np.diag([sigma_m**-2.0, sigma_m**-2.0, 1e6])
    return graph_of(poses, edges, [lie.pose_2d(1.0, 0.0, 0.0)] * len(edges), information)


@pytest.mark.parametrize(
    ("count", "more", "is_loop", "newest", "limit_m", "expected"),
    [
        (30, [], False, 29, 2.0, {k: min(0.1 * (29 - k), 2.0) for k in range(30)}),  # up to its limit
        (30, [(5, 25, 20.0)], True, 29, 5.0, {5: 0.4, 8: 0.7}),  # a loop shortens it for all that it connects
        (4, [(1, 3, 3.0), (1, 3, 0.5)], False, 0, 5.0, {0: 0.0, 1: 0.1, 2: 0.2, 3: 0.15}),  # the shorter counts
    ],
)
def test_uncertainty_grows_along_the_shortest_path(count, more, is_loop, newest, limit_m, expected):
    graph = chain(count)
    for i, j, meters in more:
        graph.add_edge(i, j, lie.pose_2d(meters, 0.0, 0.0), 1e6 * np.eye(3), is_loop=is_loop)
    uncertainty_m = Drift(0.1).between(graph, newest, limit_m)
    assert uncertainty_m[list(expected)] == pytest.approx(list(expected.values()), abs=1e-3)


def test_an_edge_counts_by_its_own_uncertainty_where_odometry_was_lost():
    graph = chain(3)
    graph.add_pose(lie.pose_2d(3.0, 0.0, 0.0), 3)
    graph.add_edge(2, 3, lie.pose_2d(1.0, 0.0, 0.0), np.diag([2.0, 2.0, 25.0]))
    assert Drift(0.1).between(graph, 3, 5.0) == pytest.approx([1.2, 1.1, 1.0, 0.0])


def test_paths_through_a_chain_with_loops_are_the_shortest():
    rng, count = np.random.default_rng(0), 400
    edges = np.vstack(
        [np.column_stack([np.arange(count - 1), np.arange(1, count)]), rng.integers(0, count, (60, 2))]
    )
    edges = edges[edges[:, 0] != edges[:, 1]]
    lengths = np.where(rng.random(len(edges)) < 0.05, np.inf, rng.uniform(0.1, 2.0, len(edges)))
    matrix = np.full((count, count), np.inf)
    np.minimum.at(matrix, tuple(np.vstack([edges, edges[:, ::-1]]).T), np.tile(lengths, 2))
    for limit in (5.0, 1e9):
        wanted = dijkstra(csgraph_from_dense(matrix, null_value=np.inf), indices=count - 1, limit=limit)
        np.testing.assert_array_equal(path_lengths(edges, lengths, count, count - 1, limit), wanted)


@pytest.mark.parametrize(
    ("turned", "chosen", "expected"), [(0.3, 0, 4), (0.6, 0, -1), (0.3, 7, 14), (0.3, 20, -1)]
)
def test_the_first_pass_near_a_pose_is_found_where_it_is_nearest(turned, chosen, expected):
    """Two passes of ten poses, 1 m apart each."""
    poses = [lie.pose_2d(k % 10, 0.1 * (k // 10), 0.0) for k in range(20)]
    poses = np.array([*poses, lie.pose_2d(4.2, 0.0, turned)])
    assert closer.on_first_pass(poses, np.arange(20) >= chosen, 2.0) == expected


def test_uncertainty_follows_a_graph_that_grows():
    graph, drift = chain(10), Drift(0.1)
    drift.between(graph, 9, 5.0)
    graph.add_pose(lie.pose_2d(10.0, 0.0, 0.0), 10)
    graph.add_edge(9, 10, lie.pose_2d(1.0, 0.0, 0.0), 1e6 * np.eye(3))
    assert Drift(0.1).between(graph, 10, 5.0) == pytest.approx(drift.between(graph, 10, 5.0))


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
    ("dimension", "target", "closest"),  # in its pass; in the first one; too far along it; none was matched; in 2D
    [(3, 40, 45), (3, 5, 15), (3, 0, 75), (3, -1, 75), (2, 40, 15), (2, -1, 15)],
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
