import numpy as np
import pytest

from scanchain import lie
from scanchain.errors import InputError
from scanchain.graph.covariance import (
    chosen_poses,
    difference_covariances,
    edge_covariances,
    inverse_blocks,
    responses,
    write_covariances,
)
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.problem import GraphProblem
from tests.support.graphs import PLAIN, field, ring
from tests.support.naive_graph import dense, normal_equations


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


def test_covariances_of_points_equal_the_dense_inverse():
    graph = field()
    graph.optimize(PLAIN)
    problem = GraphProblem(graph.edges, graph.measurements, graph.information, graph.fixed, graph.is_point)
    equations = problem.linearize(graph.poses, problem.errors(graph.poses), np.ones(len(graph.edges)))
    P = np.linalg.inv(dense(problem.pattern, equations.values))
    found = graph.covariances()
    for point in range(5):
        at = 33 + 2 * point
        assert np.allclose(found[12 + point][:2, :2], P[at : at + 2, at : at + 2], rtol=1e-8)
        assert not found[12 + point][2].any()
    adjoint = lie.adjoint(lie.inverse(graph.poses[7]))
    assert np.allclose(found[7], adjoint @ P[18:21, 18:21] @ adjoint.T, rtol=1e-8, atol=1e-12)


def covariance_of_all(problem, equations):
    """Cov(ξ) (K, k, K, k) of the left twists of all poses by the dense inverse, zero for fixed poses."""
    k, count = problem.freedom, len(problem.variable)
    at = [
        k * pose + axis
        for pose, size in zip(problem.free, problem.pattern.sizes, strict=True)
        for axis in range(size)
    ]
    P = np.zeros((k * count, k * count))
    P[np.ix_(at, at)] = np.linalg.inv(dense(problem.pattern, equations.values))
    return P.reshape(count, k, count, k)


@pytest.mark.parametrize("graph", [ring(2, 9)[0], ring(3, 7)[0], field()], ids=["plane", "space", "points"])
def test_covariances_of_differences_equal_those_of_the_dense_inverse(graph):
    fixed = np.isin(np.arange(len(graph)), (0, 4))
    problem = GraphProblem(graph.edges, graph.measurements, graph.information, fixed, graph.is_point)
    equations = problem.linearize(graph.poses, problem.errors(graph.poses), np.ones(len(graph.edges)))
    problem.cholesky.factorize(equations.values)
    P = covariance_of_all(problem, equations)

    def expected(pair, other):
        (i, j), (a, b) = pair, other
        return P[j, :, b] - P[j, :, a] - P[i, :, b] + P[i, :, a]

    pairs = np.array([(0, 3), (2, 6), (6, 2), (4, 5), (0, 4)])
    joint = difference_covariances(problem, pairs)
    for first, pair in enumerate(pairs):
        for second, other in enumerate(pairs):
            np.testing.assert_allclose(joint[second, first], expected(pair, other), rtol=1e-8, atol=1e-12)
    of_edges = edge_covariances(problem, inverse_blocks(problem))
    for found, edge in zip(of_edges, graph.edges, strict=True):
        np.testing.assert_allclose(found, expected(edge, edge), rtol=1e-8, atol=1e-12)
    for i, j in pairs:
        np.testing.assert_allclose(responses(problem, i, j), P[:, :, j] - P[:, :, i], rtol=1e-8, atol=1e-12)


def test_the_table_has_the_bits_of_the_upper_triangle_of_each_chosen_pose(dimension, tmp_path):
    ids, k = np.array([7, 3, 12]), 3 * dimension - 3
    chosen = chosen_poses("12,7", ids)
    assert chosen.tolist() == [2, 0] and chosen_poses(" all", ids).tolist() == [0, 1, 2]
    covariances = np.random.default_rng(0).normal(size=(3, k, k))
    write_covariances(tmp_path / "x.csv", ids[chosen], covariances[chosen])
    header, *rows = [line.split(",") for line in (tmp_path / "x.csv").read_text().splitlines()]
    assert (
        header[:3] == ["id", "x_x", "x_y"] and header[-1] == "yaw_yaw" and [row[0] for row in rows] == ["12", "7"]
    )
    for row, pose in zip(rows, chosen, strict=True):
        assert [float(value) for value in row[1:]] == covariances[pose][np.triu_indices(k)].tolist()


@pytest.mark.parametrize(
    ("text", "words"), [("3,x", "give all, or vertex ids"), ("3,9,5", "5: no such vertex; .* 3 to 12")]
)
def test_poses_that_are_none_are_refused(text, words):
    with pytest.raises(InputError, match=words):
        chosen_poses(text, np.array([7, 3, 12]))
