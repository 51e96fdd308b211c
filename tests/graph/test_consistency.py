import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.consistency import Consistency
from scanchain.graph.problem import GraphProblem
from tests.support.graphs import graph_of


def test_a_contradiction_is_what_chi2_falls_by_without_the_edge_and_rises_by_with_it(dimension):
    rng = np.random.default_rng(3)
    k, count = (3, 6)[dimension - 2], 10
    true = lie.exp(0.5 * rng.normal(size=(count, k)))
    pairs = np.array([*((i, i + 1) for i in range(count - 1)), (0, 4), (2, 7), (1, 9), (3, 8)])
    noise = 0.01 * rng.normal(size=(len(pairs), k))
    measured = lie.inverse(true[pairs[:, 0]]) @ true[pairs[:, 1]] @ lie.exp(noise)

    def optimized(chosen):
        graph = graph_of(true, pairs[chosen], measured[chosen], 1e4 * np.eye(k))
        answer = graph.optimize(GraphConfig(robust="none", tolerance=1e-14))
        return graph, answer.chi2_after

    everything = np.ones(len(pairs), bool)
    whole, with_all = optimized(everything)
    problem = GraphProblem(pairs, measured, whole.information, whole.fixed)
    for edge in range(count - 1, len(pairs)):
        others = everything.copy()
        others[edge] = False
        without, chi2 = optimized(others)
        falls = Consistency(problem, whole.poses, everything).of_each(np.inf)[edge]
        rises = Consistency(problem, without.poses, others).of_each(np.inf)[edge]
        assert falls == pytest.approx(with_all - chi2, rel=0.05, abs=1e-3)
        assert rises == pytest.approx(with_all - chi2, rel=0.05, abs=1e-3)
        bound = Consistency(problem, without.poses, others).of_each(0.0)[edge]
        assert bound <= rises * (1.0 + 1e-9)
