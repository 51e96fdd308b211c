"""Minima of whole graphs: published ones, those with false loops, those that grow."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.factors import Position, edge_information
from scanchain.graph.optimization import fit, has_loops, solve
from scanchain.graph.pose_graph import PoseGraph
from tests.benchmarks.wrong_edges import try_wrong_loops
from tests.support.graphs import BEST, PLAIN, graph_of, published, ring, with_false_loops
from tests.support.scenes import configured, shared_data


def position_error_m(graph, true):
    return float(np.sqrt(((graph.poses[:, :2, 2] - true.poses[:, :2, 2]) ** 2).sum(axis=1).mean()))


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


@pytest.mark.parametrize(
    ("name", "share", "kind", "seed"),
    [
        *((name, share, "nearby", 0) for name in ("intel", "manhattan") for share in (0.1, 0.5)),
        *(("intel", 0.3 / 0.7, "groups of 10", seed) for seed in (0, 2)),
    ],
)
def test_a_tenth_to_a_half_of_wrong_loops_leave_the_trajectory_as_it_is_without_them(name, share, kind, seed):
    outcome = try_wrong_loops(shared_data(f"graphs/{name}.g2o"), share, kind, seed)
    assert outcome.wrong_rejected >= 0.99 and outcome.true_rejected <= 0.01
    assert outcome.ate_m <= 1.1 * outcome.ate_clean_m + 1e-3
    assert outcome.certified


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


def test_loops_are_judged_by_the_noise_they_have_where_they_claim_to_have_more():
    """Information matrices a hundred times too small would let in a loop that is off by a meter."""
    rng = np.random.default_rng(0)
    sigma = np.array([0.02, 0.02, 0.002])
    true = [lie.pose_2d(np.cos(a) * 5, np.sin(a) * 5, a) for a in np.linspace(0.0, 12.0 * np.pi, 180)]
    graph = graph_of(true)
    pairs = [(i, i + 1) for i in range(179)] + [(i, i + 30) for i in range(0, 150, 3)]
    for i, j in pairs:
        Z = lie.inverse(true[i]) @ true[j] @ lie.exp(sigma * rng.normal(size=3))
        graph.add_edge(i, j, Z, 0.01 * np.diag(sigma**-2), is_loop=j - i > 1)
    Z = lie.inverse(true[10]) @ true[100] @ lie.exp(np.array([1.0, 0.0, 0.0]))
    graph.add_edge(10, 100, Z, 0.01 * np.diag(sigma**-2), is_loop=True)
    answer = graph.optimize(GraphConfig(robust="truncated"))
    assert answer.state.edges[answer.rejected].tolist() == [[10, 100]]


@pytest.mark.parametrize("robust", ["huber", "cauchy", "geman-mcclure", "tukey", "truncated"])
def test_a_robust_loss_hardly_moves_a_graph_whose_loops_are_true(robust):
    graph, true, _ = with_false_loops("intel", 0.0)
    answer = graph.optimize(GraphConfig(robust=robust))
    assert not answer.rejected.any()
    assert position_error_m(graph, true) < 0.02


def test_false_edges_stay_in_force_where_a_pose_would_be_loose_without_them():
    """Two loops hold the last pose, and each claims another place."""
    poses, measured = ([lie.pose_2d(x, 0.0, 0.0) for x in xs] for xs in ((0.0, 1.0, 3.0), (1.0, 2.0, 3.0)))
    graph = graph_of(poses, [(0, 1), (0, 2), (1, 2)], measured, 1e4 * np.eye(3), [False, True, True])
    answer = graph.optimize(GraphConfig(robust="huber"))
    assert not answer.rejected.any() and answer.state.degrees_of_freedom == 3
    assert answer.state.weight.min() > 0.0 and graph.certify().chi2 == pytest.approx(answer.chi2_after)


@pytest.mark.parametrize("robust", ["huber", "cauchy", "geman-mcclure", "tukey", "truncated"])
def test_rejected_edges_have_no_weight_and_the_answer_is_the_minimum_without_them(robust):
    graph, true, false = with_false_loops("intel", 0.03)
    answer = graph.optimize(GraphConfig(robust=robust))
    if robust in ("truncated", "geman-mcclure"):
        assert graph.is_rejected[false].mean() >= 0.99 and not graph.is_rejected[~graph.is_loop].any()
        assert graph.is_rejected[graph.is_loop & ~false].mean() <= (0.01 if robust == "truncated" else 0.04)
        assert position_error_m(graph, true) < (0.2 if robust == "truncated" else 2.0)
    assert robust != "truncated" or np.isin(graph.weight, [0.0, 1.0]).all()
    assert np.array_equal(answer.rejected, answer.state.weight == 0.0)
    in_force = (answer.state.weight * answer.state.edge_chi2)[~answer.rejected].sum()
    assert answer.state.chi2 == pytest.approx(in_force) and answer.state.chi2 == pytest.approx(answer.chi2_after)
    problem = graph._prepared()
    equations = problem.linearize(graph.poses, problem.errors(graph.poses), graph.weight)
    step = problem.cholesky
    step.factorize(equations.values)
    assert np.abs(step.solve(equations.gradient)).max() < 0.02  # m and rad, left to the tolerance


def extended(graph, whole, count):
    """The graph with more poses of a whole one, up to so many, chained to its own, and with their edges."""
    first, last = len(graph), whole.edges.max(axis=1)
    T_new_old = lie.identity(2) if not first else graph.poses[-1] @ lie.inverse(whole.poses[first - 1])
    for index in range(first, count):
        graph.add_pose(lie.normalize(T_new_old @ whole.poses[index]), index)
    new = np.flatnonzero((last >= first) & (last < count))
    graph.add_edges(whole.edges[new], whole.measurements[new], whole.information[new], whole.is_loop[new])
    return graph


@pytest.mark.parametrize(("share", "seed"), [(0.1, 0), (0.43, 0), (0.43, 1)])
def test_updates_of_a_growing_graph_end_where_judging_all_loops_anew_does(share, seed):
    whole, *_ = with_false_loops("intel", share, seed)
    graph = extended(PoseGraph(2), whole, 900)
    graph.optimize(GraphConfig(), initialize="given")
    for count in range(950, len(whole), 150):
        anew = extended(graph, whole, count).copy()
        updated = graph.optimize(GraphConfig(), initialize="given", rejection="update")
        judged = anew.optimize(GraphConfig(), initialize="given")
        assert position_error_m(graph, anew) < 0.05 and np.array_equal(graph.is_rejected, anew.is_rejected)
        assert updated.iterations <= min(9, judged.iterations)


def test_the_last_poses_follow_new_loops_as_if_all_others_were_fixed():
    whole, *_ = with_false_loops("intel", 0.0)
    graph = extended(PoseGraph(2), whole, 900)
    graph.optimize(GraphConfig(), initialize="given")
    anew, before = extended(graph, whole, 1000).copy(), graph.poses.copy()
    graph.optimize_end(GraphConfig(), 850, "update")
    for index in range(850):
        anew.fix(index)
    anew.optimize(GraphConfig(), initialize="given")
    assert np.array_equal(graph.poses[:850], before[:850])
    assert position_error_m(graph, anew) < 0.01 < np.linalg.norm(graph.poses[-1, :2, 2] - before[-1, :2, 2])
    assert np.array_equal(graph.is_rejected, anew.is_rejected)


@pytest.mark.parametrize(("off_m", "is_taken"), [(0.3, True), (30.0, False)])
def test_an_update_takes_in_a_loop_as_far_off_as_odometry_may_be_and_no_farther(off_m, is_taken):
    poses, edges = [lie.pose_2d(float(x), 0.0, 0.0) for x in range(21)], [(k, k + 1) for k in range(20)]
    graph = graph_of(poses, edges, [lie.pose_2d(1.0, 0.0, 0.0)] * 20, 100.0 * np.eye(3))
    graph.add_edge(0, 3, lie.pose_2d(3.0, 0.0, 0.0), 1e4 * np.eye(3), is_loop=True)
    graph.optimize(GraphConfig(), initialize="given")
    graph.add_edge(0, 20, lie.pose_2d(20.0 + off_m, 0.0, 0.0), 1e4 * np.eye(3), is_loop=True)
    answer = graph.optimize(GraphConfig(), initialize="given", rejection="update")
    assert graph.weight.tolist() == [1.0] * 21 + [float(is_taken)]
    assert graph.poses[20, 0, 2] == pytest.approx(20.0 + is_taken * off_m, abs=0.01)
    assert answer.cost_after < answer.chi2_before


def test_a_fit_counts_edges_in_force_and_a_loop_is_one_by_edges_of_the_origin_too():
    poses = [lie.pose_2d(float(x), 0.0, 0.0) for x in range(4)]
    graph = graph_of(poses, [(k, k + 1) for k in range(3)], [lie.pose_2d(1.0, 0.0, 0.0)] * 3, np.eye(3))
    graph.optimize(GraphConfig())
    assert not has_loops(graph.state())
    with_loop, with_origin = graph.copy(), graph.copy()
    with_loop.add_edge(0, 3, lie.pose_2d(30.0, 0.0, 0.0), 1e4 * np.eye(3), is_loop=True)
    assert has_loops(with_loop.state())
    state = with_loop.optimize(GraphConfig()).state
    assert state.is_rejected.sum() == 1 and not has_loops(state) and "1 edge rejected" in fit(state)
    with_origin.add_factor(Position(), 0, np.eye(2))
    assert not has_loops(with_origin.state())
    with_origin.add_factor(Position(), 3, np.eye(2), poses[3])
    assert has_loops(with_origin.state()) and "rejected" not in fit(with_origin.state())


def test_the_minimum_has_rotations_to_the_last_digit_and_fixed_poses_to_the_bit_however_far_off(dimension):
    graph, _ = ring(dimension, count=60, noise=0.05)
    poses = lie.exp(np.append(np.full(dimension, 1e6), np.ones(2 * dimension - 3))) @ graph.poses
    problem = graph._prepared()
    minimum = solve(problem, poses, PLAIN, "given")
    found = minimum.estimate.poses
    R = found[:, :-1, :-1]
    assert np.array_equal(found[0], poses[0]) and minimum.converged
    np.testing.assert_allclose(R @ np.swapaxes(R, 1, 2), np.tile(np.eye(dimension), (60, 1, 1)), atol=1e-14)
    near = solve(problem, graph.poses, PLAIN, "given").estimate
    assert minimum.estimate.cost == pytest.approx(near.cost, rel=1e-5)


def test_a_long_log_that_hangs_on_a_map_by_next_to_no_information_is_optimized():
    graph, k = PoseGraph(2), 3
    graph.fix(graph.add_pose(lie.identity(2), 0))
    anywhere = edge_information(np.zeros((k, k)), 1e4, np.pi)
    close = edge_information(1e6 * np.eye(k), 0.01, 0.003)
    for index in range(1, 401):
        before = index - 1
        graph.add_pose(lie.pose_2d(0.5 * (before % 2), 0.0, 0.0), index)
        Z = lie.between(graph.poses[before], graph.poses[index])
        graph.add_edge(before, index, Z, anywhere if index == 1 else close)
        if index > 2:
            graph.add_edge(1 + before % 2, index, lie.identity(2), close, is_loop=True)
    graph.optimize(configured(2).graph, initialize="given")
    assert np.allclose(graph.poses[1:3, :2, 2], graph.poses[399:401, :2, 2], atol=1e-6)


def test_poses_beyond_a_motion_that_nothing_measured_are_still_optimized():
    information = np.tile(1e5 * np.eye(3), (199, 1, 1))
    information[[0, 120]] = edge_information(np.zeros((3, 3)), 19.0, 3.8)
    chain, poses = [(k, k + 1) for k in range(199)], [lie.pose_2d(float(k), 0.0, 0.0) for k in range(200)]
    graph = graph_of(poses, chain, [lie.pose_2d(1.0, 0.0, 0.0)] * 199, information)
    for index in range(150, 160):
        graph.add_edge(index, index + 30, lie.pose_2d(30.0, 0.0, 0.0), 1e5 * np.eye(3), is_loop=True)
    assert graph.optimize(configured(2).graph, initialize="given").converged
