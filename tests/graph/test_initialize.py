import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.factors import Position
from scanchain.graph.initialize import (
    _nearest_rotation as nearest_rotation,
)
from scanchain.graph.initialize import first_guess, follow_odometry, follow_spanning_tree, relax_chordally
from scanchain.graph.problem import GraphProblem
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


def test_the_nearest_rotation_is_none_that_reflects():
    turned = lie.exp(np.array([0.0, 0.0, 0.0, 0.3, -0.2, 0.9]))[:3, :3]
    found = nearest_rotation(np.stack([0.5 * turned, turned @ np.diag([2.0, 1.0, -0.1])]))
    np.testing.assert_allclose(found, [turned, turned], atol=1e-12)


EDGES = np.array([(0, 1), (2, 1), (2, 3), (4, 3), (4, 5), (5, 6), (0, 4), (6, 1), (2, 5)])


@pytest.mark.parametrize("method", ["odometry", "spanning-tree", "chordal"])
def test_measurements_without_error_give_the_true_poses_from_any_others_and_keep_the_fixed_one(dimension, method):
    rng, k = np.random.default_rng(6), 3 * dimension - 3
    true, given = lie.exp(rng.normal(size=(2, 7, k)))
    given[3] = true[3]
    problem = GraphProblem(EDGES, lie.between(*true[EDGES.T]), np.tile(np.eye(k), (9, 1, 1)), np.arange(7) == 3)
    found, source = first_guess(problem, given, method, outlier_free=True)
    assert source == method and np.array_equal(found[3], true[3])
    np.testing.assert_allclose(found, true, atol=1e-9)


def test_a_spanning_tree_follows_the_fewest_edges_and_odometry_successive_poses(dimension):
    rng, k = np.random.default_rng(7), 3 * dimension - 3
    edges = np.array([(1, 0), (1, 2), (0, 2), (3, 2)])
    poses, Z = lie.exp(rng.normal(size=(5, k))), lie.exp(rng.normal(size=(4, k)))
    to_1 = poses[0] @ lie.inverse(Z[0])
    for follow, to_2 in ((follow_spanning_tree, poses[0] @ Z[2]), (follow_odometry, to_1 @ Z[1])):
        expected = [poses[0], to_1, to_2, to_2 @ lie.inverse(Z[3]), poses[4]]
        np.testing.assert_allclose(follow(poses, np.arange(5) == 0, edges, Z), expected, atol=1e-12)


def least_squares(count, edges, weight, A, c, known):
    """X (K, b, m), Σ w ‖X_j − A X_i − c‖² least, by a dense solver; X[2] as known."""
    b = A.shape[1]
    rows, right = np.zeros((len(edges), b, count, b)), np.zeros((len(edges), b, known.shape[1]))
    for e, (i, j) in enumerate(edges):
        rows[e, :, j] += np.sqrt(weight[e]) * np.eye(b)
        rows[e, :, i] -= np.sqrt(weight[e]) * A[e]
        right[e] = np.sqrt(weight[e]) * c[e]
    right = (right - np.einsum("eab,bm->eam", rows[:, :, 2], known)).reshape(len(edges) * b, -1)
    free = np.delete(rows, 2, axis=2).reshape(len(right), -1)
    return np.insert(np.linalg.lstsq(free, right, rcond=None)[0].reshape(count - 1, b, -1), 2, known, axis=0)


def test_chordal_relaxation_equals_two_dense_least_squares_problems(dimension):
    rng, k, d = np.random.default_rng(8), 3 * dimension - 3, dimension
    poses = lie.exp(rng.normal(size=(7, k)))
    Z = lie.between(*poses[EDGES.T]) @ lie.exp(0.3 * rng.normal(size=(9, k)))
    information = np.array([np.diag(rng.uniform(1.0, 5.0, k)) for _ in EDGES])
    found = relax_chordally(GraphProblem(EDGES, Z, information, np.arange(7) == 2), poses)
    kappa, tau = (np.trace(information[:, part, part], axis1=1, axis2=2) for part in (slice(d, k), slice(0, d)))
    turned = np.swapaxes(Z[:, :d, :d], 1, 2)
    matrices = least_squares(7, EDGES, kappa, turned, np.zeros((9, d, d)), poses[2, :d, :d].T)
    R = [
        (U * np.append(np.ones(d - 1), np.linalg.det(U @ V))) @ V
        for U, _, V in map(np.linalg.svd, np.swapaxes(matrices, 1, 2))
    ]
    leaps = np.array([R[i] @ Z[e, :d, d] for e, (i, _) in enumerate(EDGES)])[:, None]
    positions = least_squares(7, EDGES, tau, np.ones((9, 1, 1)), leaps, poses[2, None, :d, d])[:, 0]
    np.testing.assert_allclose(found[:, :d, :d], R, atol=1e-9)
    np.testing.assert_allclose(found[:, :d, d], positions, atol=1e-9)
