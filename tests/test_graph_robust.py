import numpy as np
import pytest
from scenes import shared_data

from pipeline import lie
from pipeline.config import GraphConfig
from pipeline.graph.g2o import read_g2o


def with_false_loops(name, share, seed=0):
    """A published graph, its loops under suspicion, with random ones added, and the poses it should end with."""
    path = shared_data(f"graphs/{name}.g2o")
    true = read_g2o(path).graph
    true.optimise(GraphConfig())
    graph = read_g2o(path, loops="suspect").graph
    rng = np.random.default_rng(seed)
    count = int(share * graph.is_loop.sum())
    pairs = rng.integers(0, len(graph), (count, 2))
    pairs = pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 1]
    span = np.ptp(true.poses[:, :2, 2], axis=0)
    twists = rng.uniform(-0.5, 0.5, (len(pairs), 3)) * [*span, 2.0 * np.pi]
    omega = np.median(graph.information[graph.is_loop], axis=0)
    real = len(graph.edges)
    graph.add_edges(pairs, lie.exp(twists), np.tile(omega, (len(pairs), 1, 1)), np.ones(len(pairs), bool))
    return graph, true, np.arange(len(graph.edges)) >= real


def in_order_of_addition(graph, values):
    result = np.empty(len(values), values.dtype)
    result[np.argsort(graph.is_loop, kind="stable")] = values
    return result


def position_error_m(graph, true):
    return float(np.sqrt(((graph.poses[:, :2, 2] - true.poses[:, :2, 2]) ** 2).sum(axis=1).mean()))


@pytest.mark.parametrize(
    ("robust", "true_lost", "error_m"), [("truncated", 0.01, 0.2), ("geman-mcclure", 0.04, 2.0)]
)
@pytest.mark.parametrize("name", ["intel", "manhattan"])
def test_false_loops_are_rejected_and_true_ones_kept(name, robust, true_lost, error_m):
    graph, true, false = with_false_loops(name, 0.03)
    answer = graph.optimise(GraphConfig(robust=robust))
    rejected = in_order_of_addition(graph, answer.rejected)
    assert rejected[false].mean() >= 0.99
    assert rejected[graph.is_loop & ~false].mean() <= true_lost
    assert position_error_m(graph, true) < error_m
    weight = in_order_of_addition(graph, answer.state.weight)
    assert weight[false].max() < 0.1 and np.all(weight[~graph.is_loop] == 1.0)
    assert not rejected[~graph.is_loop].any()


def test_without_robust_weights_the_same_false_loops_ruin_the_map():
    graph, true, _ = with_false_loops("intel", 0.03)
    graph.optimise(GraphConfig(robust="none"), initialise="given")
    assert position_error_m(graph, true) > 2.0


def test_truncated_weights_are_verdicts():
    graph, _, _ = with_false_loops("intel", 0.03)
    weight = graph.optimise(GraphConfig(robust="truncated")).state.weight
    assert np.all((weight == 0.0) | (weight == 1.0))


@pytest.mark.parametrize("robust", ["huber", "cauchy", "geman-mcclure", "truncated"])
def test_a_robust_loss_hardly_moves_a_graph_whose_loops_are_true(robust):
    graph, true, _ = with_false_loops("intel", 0.0)
    answer = graph.optimise(GraphConfig(robust=robust))
    assert not answer.rejected.any()
    assert position_error_m(graph, true) < 0.02


@pytest.mark.parametrize("robust", ["huber", "cauchy"])
def test_a_minimum_of_the_robust_loss_is_flat(robust):
    """The weights belong to the loss: at the answer Σ w JᵀΩe vanishes."""
    graph, _, _ = with_false_loops("intel", 0.01)
    graph.optimise(GraphConfig(robust=robust, tolerance=1e-12, max_iterations=300))
    problem = graph._prepared()
    equations = problem.linearise(graph.poses, problem.errors(graph.poses), graph.weight)
    diagonal = equations.values[problem.pattern.diagonal]
    assert np.abs(equations.gradient / np.sqrt(diagonal)).max() < 1e-3
