import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.factors import Position
from tests.support.graphs import BEST, PLAIN, graph_of, published


def test_a_poor_guess_is_replaced_by_the_chordal_one_and_a_good_one_kept():
    assert published("MIT").optimize(PLAIN).initialization == "chordal"
    assert published("intel").optimize(PLAIN).initialization == "given"


@pytest.mark.parametrize("initialize", ["odometry", "spanning-tree", "chordal", "given"])
def test_every_way_to_start_ends_in_the_same_minimum(initialize):
    answer = published("intel").optimize(PLAIN, initialize=initialize)
    assert answer.initialization == initialize
    assert 0.5 * answer.chi2_after == pytest.approx(BEST["intel"], rel=2e-5)


@pytest.mark.parametrize("initialize", ["odometry", "spanning-tree", "chordal"])
@pytest.mark.parametrize("dimension", [2, 3])
def test_initial_poses_come_from_positions_in_the_world_alone(dimension, initialize):
    rng, k = np.random.default_rng(5), lie.twist_size(lie.identity(dimension))
    true = lie.exp(rng.normal(size=(6, k)))
    edges = np.array([(i, i + 1) for i in range(5)])
    graph = graph_of(lie.exp(rng.normal(size=(6, k))), edges, lie.between(*true[edges.T]), np.eye(k))
    for j in (0, 2, 3, 5):
        graph.add_factor(Position(), j, np.eye(dimension), true[j])
    done = graph.optimize(GraphConfig(robust="none"), initialize=initialize)
    assert done.chi2_before > 1.0 and done.iterations <= 1
    assert np.allclose(graph.poses, true, atol=1e-6)
