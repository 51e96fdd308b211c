"""The relaxation: its dual bounds every X, its minimum is below every other one, and leads back to poses."""

import numpy as np
import pytest

from scanchain.graph.certificate import dual_matrix, minorize
from scanchain.graph.problem import GraphProblem
from scanchain.graph.relaxation import Relaxation
from tests.support.graphs import PLAIN, closed_ring, tangled


def relaxation_of(graph, poses):
    problem = GraphProblem(graph.edges, graph.measurements, graph.information, np.arange(len(graph)) == 0)
    weights = np.ones(len(graph.edges))
    minorants = minorize(problem, poses, weights, touching=False)
    S, residual = dual_matrix(problem, minorants, np.ones(len(weights), bool))
    chi2 = float(problem.chi2(problem.errors(poses)).sum())
    return Relaxation(problem, S, residual, poses[problem.free, :-1, -1], chi2), minorants, chi2


@pytest.mark.parametrize("seed", range(5))
def test_the_dual_is_below_every_point_of_the_relaxation(dimension, seed):
    graph, rng = tangled(dimension, seed), np.random.default_rng(seed)
    graph.optimize(PLAIN)
    relaxation, _, _ = relaxation_of(graph, graph.poses)
    bound = relaxation.dual(relaxation.estimate)
    X, best = relaxation.minimize(relaxation.estimate, bound)
    assert bound.value <= best.value <= relaxation.value(X) + 1e-9 * abs(relaxation.value(X))
    count = len(graph) - 1
    for columns in (dimension, dimension + 3):
        for size in (0.01, 1.0, 10.0):
            rows = rng.normal(size=(count, dimension + 1, columns))
            axes, _, more = np.linalg.svd(rows[:, :dimension], full_matrices=False)
            rows[:, :dimension] = axes @ more
            rows[:, dimension] *= size
            assert best.value <= relaxation.value(rows.reshape(-1, columns))


def test_the_minimum_of_a_ring_wound_up_is_the_ring_unwound(dimension):
    graph = closed_ring(dimension, 40, 1)
    relaxation, minorants, chi2 = relaxation_of(graph, graph.poses)
    start = relaxation.value(relaxation.estimate)
    assert minorants.value.sum() == pytest.approx(chi2, rel=0.01)
    X, best = relaxation.minimize(relaxation.estimate, relaxation.dual(relaxation.estimate))
    assert best.is_minimum
    assert minorants.value.sum() + relaxation.value(X) - start == pytest.approx(0.0, abs=0.02 * chi2)
    G, positions = relaxation.rounded(X)
    turned = G @ graph.poses[1:, :-1, :-1]
    assert np.allclose(turned, np.eye(dimension), atol=0.05) and np.allclose(positions, 0.0, atol=0.05)
    assert np.allclose(np.linalg.det(G), 1.0)
