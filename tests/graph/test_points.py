"""Points in a pose graph of the plane: optimized with the poses, with covariance and certificate."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.problem import GraphProblem
from tests.support.graphs import PLAIN, closed_ring, graph_of
from tests.support.naive_graph import dense


def field(seed=0, noise=0.05, poses=12, points=5):
    """Poses on a circle that see points inside and outside of it; the guess of the points is poor."""
    rng = np.random.default_rng(seed)
    angles = 2.0 * np.pi * np.arange(poses) / poses
    true = np.array([lie.pose_2d(4 * np.cos(a), 4 * np.sin(a), a + np.pi / 2) for a in angles])
    marks = rng.uniform(-6.0, 6.0, (points, 2))
    graph = graph_of([T @ lie.exp(0.05 * rng.normal(size=3)) if index else T for index, T in enumerate(true)])
    for index, mark in enumerate(marks):
        graph.add_point(mark + rng.normal(size=2), 100 + index)
    for i in range(poses - 1):
        Z = lie.inverse(true[i]) @ true[i + 1] @ lie.exp(noise * rng.normal(size=3))
        graph.add_edge(i, i + 1, Z, np.diag([4.0, 9.0, 25.0]) / noise**2 / 9)
    pairs = np.array([(i, poses + p) for i in range(poses) for p in range(points) if (i + p) % 2])
    T_i = lie.inverse(true[pairs[:, 0]])
    seen = (T_i[:, :2, :2] @ marks[pairs[:, 1] - poses][..., None])[..., 0] + T_i[:, :2, 2]
    seen += noise * rng.normal(size=seen.shape)
    for pair, position in zip(pairs.tolist(), seen, strict=True):
        sight(graph, pair, position, [[2.0, 0.5], [0.5, 1.0]] / np.array(noise**2))
    return graph


def sight(graph, pair, position, information):
    """Add a point as seen from a pose."""
    graph.add_edge(*pair, lie.pose_2d(*position, 0.0), np.pad(information, (0, 1)))


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


@pytest.mark.parametrize("turns", [0, 1])
def test_a_ring_with_a_point_is_certified_unless_it_is_wound_up(turns):
    graph = closed_ring(2, 30, turns)
    mark = graph.add_point(np.array([2.0, 1.0]), 99)
    sight(graph, (0, mark), (2.0, 1.1), np.eye(2))
    sight(graph, (1, mark), (2.1, 1.0), np.eye(2))
    assert graph.optimize(PLAIN, initialize="given").converged
    assert graph.certify().certified == (turns == 0)
