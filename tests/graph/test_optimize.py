from typing import get_args

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import absolute_error, expected_ate, pair
from scanchain.graph.minimizer import Optimizer
from scanchain.graph.odometry_errors import Explanation, InflatedSegment
from scanchain.graph.pose_graph import PoseGraph
from tests.support.graphs import BEST, PLAIN, graph_of, published, ring
from tests.support.naive_graph import normal_equations


@pytest.mark.parametrize("optimizer", ["levenberg-marquardt", "gauss-newton"])
@pytest.mark.parametrize("name", list(BEST))
def test_the_published_graphs_reach_the_best_known_chi2_from_their_files_and_are_certified(name, optimizer):
    graph = published(name)
    answer = graph.optimize(GraphConfig(optimizer=optimizer))
    assert answer.converged, answer.reason
    assert 0.5 * answer.chi2_after == pytest.approx(BEST[name], rel=2e-5)
    certificate = graph.certify()
    assert certificate.certified and certificate.chi2 == pytest.approx(answer.chi2_after, rel=1e-9)
    assert certificate.relative_gap < 1e-6


def test_every_optimizer_ends_in_the_same_minimum_of_a_ring(dimension):
    """Gradient descent too, only that it takes its time."""
    chi2 = {}
    for optimizer in get_args(Optimizer):
        graph, _ = ring(dimension, noise=0.05)
        config = GraphConfig(optimizer=optimizer, max_iterations=20_000, tolerance=1e-10, robust="none")
        answer = graph.optimize(config)
        assert answer.converged, (optimizer, answer.reason)
        chi2[optimizer] = answer.chi2_after
    assert np.allclose(list(chi2.values()), chi2["levenberg-marquardt"], rtol=1e-5)


def test_a_poor_guess_is_replaced_by_the_chordal_one_and_a_good_one_kept():
    assert published("MIT").optimize(PLAIN).initialization == "chordal"
    assert published("intel").optimize(PLAIN).initialization == "given"


@pytest.mark.parametrize("initialize", ["odometry", "spanning-tree", "chordal", "given"])
def test_every_way_to_start_ends_in_the_same_minimum(initialize):
    answer = published("intel").optimize(PLAIN, initialize=initialize)
    assert answer.initialization == initialize
    assert 0.5 * answer.chi2_after == pytest.approx(BEST["intel"], rel=2e-5)


def test_a_hand_made_triangle_shows_that_T_ij_maps_frame_j_into_frame_i(dimension):
    """Pose 1 lies 1 m ahead of pose 0 and looks left; pose 2 lies 1 m ahead of pose 1: at (1, 1), looking left."""
    quarter = lie.exp(np.array([0.0, 0.0, np.pi / 2]))
    ahead = lie.exp(np.array([1.0, 0.0, 0.0]))
    to_2 = lie.pose_2d(1.0, 1.0, np.pi / 2)
    measured = [(0, 1, ahead @ quarter), (1, 2, ahead), (0, 2, to_2)]
    raise_dimension = lie.lift if dimension == 3 else np.asarray
    edges, Z = [(i, j) for i, j, _ in measured], [raise_dimension(T) for *_, T in measured]
    graph = graph_of([lie.identity(dimension)] * 3, edges, Z, np.eye(3 * (dimension - 1)))
    answer = graph.optimize(PLAIN)
    assert answer.chi2_after < 1e-11
    assert np.allclose(graph.poses[1], raise_dimension(ahead @ quarter), atol=1e-6)
    assert np.allclose(graph.poses[2][:dimension, dimension], [1.0, 1.0, 0.0][:dimension], atol=1e-6)
    assert np.allclose(lie.yaw(graph.poses[2]), np.pi / 2, atol=1e-6)


def test_the_answer_moves_with_the_world_frame(dimension):
    """Far from the origin as near it: the same graph, its first pose elsewhere, ends in the same shape."""
    near, _ = ring(dimension, noise=0.02)
    away = np.array([4.1e5, -5.3e6, 0.7] if dimension == 2 else [4.1e5, -5.3e6, 120.0, 0.2, -0.3, 0.7])
    T = lie.exp(away)
    far = graph_of(T @ near.poses, near.edges, near.measurements, near.information, near.is_loop)
    assert near.optimize(PLAIN).converged and far.optimize(PLAIN).converged
    # 1e-9 relative of the distance is all that double precision keeps
    assert np.allclose(lie.inverse(T) @ far.poses, near.poses, atol=1e-7)


def test_meters_or_centimeters_same_shape():
    meters, _ = ring(2, noise=0.05)
    scale, back = np.diag([100.0, 100.0, 1.0]), np.diag([0.01, 0.01, 1.0])
    Z, information = scale @ meters.measurements @ back, back @ meters.information @ back
    centimeters = graph_of(scale @ meters.poses @ back, meters.edges, Z, information, meters.is_loop)
    for robust in ("none", "huber", "cauchy", "geman-mcclure", "truncated"):
        a, b = (graph.optimize(GraphConfig(robust=robust)) for graph in (meters, centimeters))
        assert a.chi2_after == pytest.approx(b.chi2_after, rel=1e-4)
        assert np.allclose(back @ centimeters.poses @ scale, meters.poses, atol=1e-4)


def test_a_fixed_pose_stays_to_the_bit():
    graph, _ = ring(3, noise=0.05)
    graph.fix(4)
    before = graph.poses.copy()
    graph.optimize(PLAIN)
    assert np.array_equal(graph.poses[4], before[4])
    assert not np.array_equal(graph.poses[0], before[0])


@pytest.mark.parametrize("first", [0, 12, 18, 40, 60])
def test_edges_added_are_corrected_as_among_all_others(first):
    graph, _ = ring(2, count=60, noise=0.03)
    graph._explanation = Explanation(
        np.array([0.02, 0.001]), (InflatedSegment(10, 4, False), InflatedSegment(20, 1, True))
    )
    for added, every in zip(graph.added_since(first), (graph.measurements, graph.information), strict=True):
        assert np.allclose(added, every[first:], rtol=1e-12, atol=1e-12)


def test_every_reason_to_stop_is_reported():
    assert published("MIT").optimize(GraphConfig(max_iterations=1, robust="none")).reason == "1 iteration reached"
    assert "χ² change" in published("intel").optimize(PLAIN).reason
    graph, _ = ring(2, noise=0.05)
    graph.optimize(GraphConfig(robust="none", tolerance=1e-10))
    assert "gradient" in graph.optimize(PLAIN).reason
    graph, _ = ring(2)
    assert graph.optimize(PLAIN).reason.split()[0] in {"gradient", "step", "χ²"}


def test_covariances_equal_the_dense_inverse(dimension):
    graph, _ = ring(dimension, count=9, noise=0.02)
    graph.optimize(PLAIN)
    k = graph.freedom
    H, _ = normal_equations(
        graph.poses, graph.edges, graph.measurements, graph.information, np.ones(len(graph.edges)), graph.fixed
    )
    P = np.zeros((9, k, 9, k))
    P[1:, :, 1:] = np.linalg.inv(H).reshape(8, k, 8, k)
    adjoint = lie.adjoint(lie.inverse(graph.poses))
    found = graph.covariances()
    assert not found[0].any()
    for i, j in [*((0, pose) for pose in range(1, 9)), (2, 6)]:
        joint = P[i, :, i] + P[j, :, j] - P[i, :, j] - P[j, :, i]
        expected = adjoint[j] @ joint @ adjoint[j].T
        assert np.allclose(graph.relative_covariance(i, j), expected, rtol=1e-5, atol=1e-9)
        assert i or np.allclose(found[j], expected, rtol=1e-5, atol=1e-9)


def test_errors_drawn_of_positions_have_the_covariances_of_the_poses(dimension):
    graph, _ = ring(dimension, count=9, noise=0.02)
    graph.optimize(PLAIN)
    R = graph.poses[:, :-1, :-1]
    own = graph.covariances()[:, :dimension, :dimension]
    expected = R @ own @ np.swapaxes(R, 1, 2)
    errors = graph.pose_errors(4000)
    drawn = errors[..., :dimension]
    assert not errors[:, 0].any()
    for pose in range(1, 9):
        size = np.trace(expected[pose])
        assert np.abs(np.cov(drawn[:, pose].T) - expected[pose]).max() < 0.08 * size
    assert np.array_equal(errors[:5], graph.pose_errors(5))


def test_displacements_are_those_of_a_graph_that_is_optimized_with_the_changed_measurements(dimension):
    graph, _ = ring(dimension, count=9, noise=0.02)
    graph.optimize(PLAIN)
    change = 1e-4 * np.random.default_rng(1).normal(size=(len(graph.edges), graph.freedom))
    changed = PoseGraph(dimension)
    for T in graph.poses:
        changed.add_pose(T, 0)
    for (i, j), T_ij, information, twist in zip(
        graph.edges.tolist(), graph.measurements, graph.information, change, strict=True
    ):
        changed.add_edge(i, j, T_ij @ lie.exp(twist), information)
    changed.optimize(PLAIN)
    (found,) = graph.displacements(change[None])
    moved = changed.poses[:, :-1, -1] - graph.poses[:, :-1, -1]
    assert np.abs(moved).max() > 1e-5
    np.testing.assert_allclose(found[:, :dimension], moved, atol=0.05 * np.abs(moved).max())


def test_of_results_of_redrawn_measurements_95_of_100_lie_within_the_bounds_of_the_expected_ate(dimension):
    rng = np.random.default_rng(0)
    _, true = ring(dimension, count=24)
    inside = 0
    for _ in range(100):
        graph = redrawn(true, rng)
        bounds = expected_ate(graph)
        poses = Trajectory(graph.stamps_ns, lie.lift(graph.poses))
        ate = absolute_error(pair(poses, Trajectory(graph.stamps_ns, lie.lift(true))))
        inside += bounds.low <= ate.translation_m.rmse <= bounds.high
    assert 90 <= inside <= 99


def redrawn(true, rng):
    """A ring, optimized, whose edges err as their information says."""
    k = 3 if len(true[0]) == 3 else 6
    sigma = rng.uniform(0.005, 0.03, k)
    edges = np.stack([np.arange(len(true)), (np.arange(len(true)) + 1) % len(true)], axis=1)
    measured = lie.between(*true[edges.T]) @ lie.exp(sigma * rng.normal(size=(len(true), k)))
    graph = graph_of(true, edges, measured, np.diag(sigma**-2.0), stamps_ns=1_000_000_000 * np.arange(len(true)))
    graph.optimize(PLAIN)
    return graph


@pytest.mark.parametrize(
    ("i", "j", "information", "words"),
    [
        (0, 7, np.eye(3), "edge 0-7 joins a pose that is not there"),
        (-1, 1, np.eye(3), "edge -1-1 joins a pose that is not there"),
        (1, 1, np.eye(3), "joins a pose to itself"),
        (0, 1, np.diag([1.0, 1.0, -1.0]), "not symmetric positive semidefinite"),
        (0, 1, np.eye(3) + np.eye(3, k=1), "not symmetric positive semidefinite"),
        (0, 1, np.diag([1.0, 1e300, 1.0]), r"edge 0-1: information of 1e\+300, over 1e\+50; give meters"),
        (0, 1, np.full((3, 3), np.nan), "information holds NaN or infinite values"),
    ],
)
def test_an_impossible_edge_is_refused_and_changes_nothing(i, j, information, words):
    graph, _ = ring(2, count=3)
    with pytest.raises(InputError, match=words):
        graph.add_edge(i, j, lie.identity(2), information)
    assert len(graph.edges) == 3


def test_a_graph_without_poses_is_refused_and_one_of_a_pose_alone_is_already_optimal(dimension):
    graph = PoseGraph(dimension)
    with pytest.raises(InputError, match="has no poses"):
        graph.optimize(PLAIN)
    graph.add_pose(lie.identity(dimension), 5)
    answer = graph.optimize(GraphConfig())
    assert answer.converged and answer.chi2_after == 0.0
    assert np.array_equal(graph.poses[0], lie.identity(dimension))
