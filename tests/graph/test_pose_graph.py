import numpy as np
import pytest
from scipy.optimize import least_squares

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.errors import InputError
from scanchain.graph.odometry_errors import Explanation, InflatedSegment
from scanchain.graph.pose_graph import PoseGraph
from tests.support.graphs import PLAIN, field, graph_of, ring


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


def test_a_fixed_pose_stays_to_the_bit():
    graph, _ = ring(3, noise=0.05)
    graph.fix(4)
    before = graph.poses.copy()
    graph.optimize(PLAIN)
    assert np.array_equal(graph.poses[4], before[4])
    assert not np.array_equal(graph.poses[0], before[0])


def test_a_rejected_edge_is_not_in_force_and_has_no_degrees_of_freedom(dimension):
    graph, _ = ring(dimension, noise=0.01)
    before = graph.state().degrees_of_freedom
    T_wrong = lie.exp(np.full(lie.twist_size(lie.identity(dimension)), 2.0))
    graph.add_edge(0, 7, T_wrong, 1e4 * np.eye(len(graph.information[0])), is_loop=True)
    graph.optimize(GraphConfig(robust="truncated"))
    assert graph.is_rejected.tolist() == [False] * (len(graph.edges) - 1) + [True]
    assert graph.state().degrees_of_freedom == before
    assert np.array_equal(graph.in_force(0, len(graph)).edges, graph.edges[:-1])


def test_poses_added_to_named_ones_have_the_numbers_after_the_largest_name():
    graph = PoseGraph(2, np.array([7, 40, 3]))
    for k in range(5):
        graph.add_pose(lie.identity(2), k)
    assert graph.names.tolist() == [7, 40, 3, 41, 42]


@pytest.mark.parametrize("first", [0, 12, 18, 40, 60])
def test_edges_added_are_corrected_as_among_all_others(first):
    graph, _ = ring(2, count=60, noise=0.03)
    graph._explanation = Explanation(
        np.array([0.02, 0.001]), (InflatedSegment(10, 4, False), InflatedSegment(20, 1, True))
    )
    for added, every in zip(graph.added_since(first), (graph.measurements, graph.information), strict=True):
        assert np.allclose(added, every[first:], rtol=1e-12, atol=1e-12)


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


def whitened_residuals(values, graph):
    """All of them, from coordinates (x, y, θ) of the poses but the first and (x, y) of the points."""
    count = int((~graph.is_point).sum())
    poses = np.array([graph.poses[0], *(lie.pose_2d(*row) for row in values[: 3 * count - 3].reshape(-1, 3))])
    points = values[3 * count - 3 :].reshape(-1, 2)
    result = []
    for (i, j), Z, omega in zip(graph.edges, graph.measurements, graph.information, strict=True):
        if j >= count:
            e = (lie.inverse(poses[i]) @ [*points[j - count], 1.0])[:2] - Z[:2, 2]
            result.append(np.linalg.cholesky(omega[:2, :2]).T @ e)
        else:
            e = lie.log(lie.inverse(Z) @ lie.inverse(poses[i]) @ poses[j])
            result.append(np.linalg.cholesky(omega).T @ e)
    return np.concatenate(result)


def test_poses_and_points_reach_the_minimum_that_a_dense_solver_finds():
    graph = field()
    start = [[*T[:2, 2], float(lie.yaw(T))] for T in graph.poses[1:12]]
    marks = [T[:2, 2] for T in graph.poses[12:]]
    expected = least_squares(
        whitened_residuals, np.concatenate([np.ravel(start), np.ravel(marks)]), args=(graph,), xtol=1e-14
    )
    answer = graph.optimize(GraphConfig(robust="none", tolerance=1e-12))
    assert answer.chi2_after == pytest.approx(2.0 * expected.cost, rel=1e-7)
    assert np.allclose(graph.poses[12:, :2, 2].ravel(), expected.x[33:], atol=1e-5)
    assert np.allclose(graph.poses[12:, :2, :2], np.eye(2))
