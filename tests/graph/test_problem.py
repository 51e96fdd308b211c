import numpy as np
import pytest

from scanchain import lie
from scanchain.graph.problem import GraphProblem
from tests.support import naive_graph

ANGLES = [0.0, 1e-9, 1e-5, 1e-3, 0.05, 0.1, 1.0, 2.5, np.pi - 1e-3, np.pi - 1e-5]


def _problem_with_error(dimension, angle, seed=0):
    """Two poses far from the origin and a measurement whose error turns by the given angle."""
    rng = np.random.default_rng(seed)
    k = 3 if dimension == 2 else 6
    poses = lie.exp(
        np.concatenate([rng.uniform(-20, 20, (2, dimension)), rng.uniform(-1.5, 1.5, (2, k - dimension))], 1)
    )
    error = rng.normal(size=k)
    error[dimension:] *= angle / np.linalg.norm(error[dimension:])
    Z = lie.inverse(poses[0]) @ poses[1] @ lie.inverse(lie.exp(error))
    A = rng.normal(size=(k, k))
    problem = GraphProblem(np.array([[0, 1]]), Z[None], (A @ A.T + np.eye(k))[None], np.array([True, False]))
    return problem, poses, error


@pytest.mark.parametrize("angle", ANGLES)
def test_the_error_is_the_logarithm_of_the_mismatch(dimension, angle):
    problem, poses, error = _problem_with_error(dimension, angle)
    found = problem.errors(poses)[0]
    assert np.allclose(found, error, atol=1e-8)
    assert np.allclose(found, naive_graph.error(*poses, problem.measurements[0]), atol=1e-6)


@pytest.mark.parametrize("angle", ANGLES)
def test_jacobians_equal_finite_differences_from_zero_to_nearly_pi(dimension, angle):
    problem, poses, _ = _problem_with_error(dimension, angle)
    J = problem.jacobians(poses, problem.errors(poses))[0]
    step = 1e-6
    for a in range(len(J)):
        for end, sign in ((1, 1.0), (0, -1.0)):
            ahead = naive_graph.moved(poses, 0, 1, end, a, step, problem.measurements[0])
            back = naive_graph.moved(poses, 0, 1, end, a, -step, problem.measurements[0])
            assert np.allclose(sign * J[:, a], (ahead - back) / (2.0 * step), rtol=2e-6, atol=2e-6)


def test_normal_equations_equal_dense_finite_differences(dimension):
    rng = np.random.default_rng(4)
    k, count = (3, 6)[dimension - 2], 5
    poses = lie.exp(rng.normal(size=(count, k)))
    edges = np.array([[0, 1], [1, 2], [3, 2], [3, 4], [0, 4], [4, 0], [0, 4], [1, 3], [2, 4]])  # one pair thrice
    A = rng.normal(size=(len(edges), k, k))
    information = A @ np.swapaxes(A, 1, 2)
    measured = (
        lie.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ lie.exp(0.3 * rng.normal(size=(len(edges), k)))
    )
    fixed = np.array([False, False, True, False, False])
    weights = rng.uniform(0.2, 1.0, len(edges))
    problem = GraphProblem(edges, measured, information, fixed)
    equations = problem.linearize(poses, problem.errors(poses), weights)
    H, g = naive_graph.normal_equations(poses, edges, measured, information, weights, fixed)
    assert np.allclose(
        naive_graph.dense(problem.pattern, equations.values), H, rtol=1e-5, atol=1e-5 * np.abs(H).max()
    )
    assert np.allclose(equations.gradient, g, rtol=1e-5, atol=1e-5 * np.abs(g).max())
    e = problem.errors(poses)
    assert np.allclose(problem.chi2(e), [v @ omega @ v for v, omega in zip(e, information, strict=True)])


@pytest.mark.parametrize("angle", [0.0, 0.1, 3.0])
def test_an_edge_of_position_alone_measures_the_position_whatever_the_rotation(dimension, angle):
    full, poses, _ = _problem_with_error(dimension, angle)
    Z, information = full.measurements, full.information.copy()
    information[:, dimension:], information[:, :, dimension:] = 0.0, 0.0
    problem = GraphProblem(full.edges, Z, information, np.array([True, False]))
    mismatch = lie.inverse(Z[0]) @ lie.inverse(poses[0]) @ poses[1]
    assert np.allclose(problem.errors(poses)[0, :dimension], mismatch[:-1, -1])
    assert not problem.errors(poses)[0, dimension:].any()
    J, step = problem.jacobians(poses, problem.errors(poses))[0], 1e-6
    for axis, twist in enumerate(step * np.eye(len(J))):
        ends = [np.stack([poses[0], lie.exp(sign * twist) @ poses[1]]) for sign in (1.0, -1.0)]
        ahead, back = (problem.errors(pair)[0] for pair in ends)
        assert np.allclose(J[:, axis], (ahead - back) / (2.0 * step), atol=1e-7)
