import math
import re
from itertools import accumulate

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.errors import InputError
from scanchain.graph.consistency import Consistency
from scanchain.graph.odometry_errors import corrected
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.problem import GraphProblem
from tests.benchmarks.wrong_edges import try_wrong_loops
from tests.support.graphs import graph_of, published
from tests.support.scenes import shared_data


def with_false_loops(name, share, seed=0):
    """A published graph, its loops under suspicion, with random ones added, and the poses it should end with."""
    true, graph = published(name), published(name, loops="robust")
    true.optimize(GraphConfig())
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


def position_error_m(graph, true):
    return float(np.sqrt(((graph.poses[:, :2, 2] - true.poses[:, :2, 2]) ** 2).sum(axis=1).mean()))


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


class OtherSlope:
    """Weight and loss of two functions."""

    def weight(self, chi2, s, mu):
        return s**2 / (s**2 + chi2)

    def loss(self, chi2, s, mu):
        return s**2 * -np.expm1(-chi2 / s**2)


class Scalar(OtherSlope):
    """A loss that takes one residual at a time."""

    def loss(self, chi2, s, mu):
        return s**2 * -math.expm1(-chi2 / s**2)


@pytest.mark.parametrize(("name", "fault"), [("OtherSlope", "slope of loss"), ("Scalar", "fails for")])
def test_a_loss_of_the_users_that_is_none_is_refused(name, fault):
    graph, _, _ = with_false_loops("intel", 0.03)
    with pytest.raises(InputError, match=fault):
        graph.optimize(GraphConfig(robust=f"{__name__}:{name}"))


def round_trips(drifted, turns=3, written="forward", every=10):
    """A graph of laps whose odometry is measured as ``drifted`` makes it.

    every : every so many poses, a lap is closed to the one before
    written : how its odometry edges are: "forward", "backward" (from each pose to the one before), "last first"
    """
    rng = np.random.default_rng(1)
    true = [lie.pose_2d(10 * np.cos(a), 10 * np.sin(a), a + np.pi / 2) for a in np.arange(60 * turns) * np.pi / 30]
    graph, sigma = graph_of(true), np.array([0.01, 0.01, 0.005])
    odometry = []
    for i in range(len(true) - 1):
        Z = drifted(i, lie.inverse(true[i]) @ true[i + 1] @ lie.exp(0.3 * sigma * rng.normal(size=3)))
        odometry.append((i + 1, i, lie.inverse(Z)) if written == "backward" else (i, i + 1, Z))
    for i, j, Z in reversed(odometry) if written == "last first" else odometry:
        graph.add_edge(i, j, Z, np.diag(sigma**-2))
    for i in range(0, len(true) - 60, every):
        Z = lie.inverse(true[i]) @ true[i + 60] @ lie.exp(0.3 * sigma * rng.normal(size=3))
        graph.add_edge(i, i + 60, Z, np.diag(sigma**-2), is_loop=True)
    return graph, np.array(true)


WRITTEN = pytest.mark.parametrize("written", ["forward", "backward", "last first"])


@WRITTEN
def test_loops_that_agree_show_a_systematic_drift_of_odometry_instead_of_being_rejected(written):
    drift = np.array([0.0, -0.01])  # laps do not show the scale
    graph, true = round_trips(lambda i, Z: corrected(Z, -drift), written=written)
    answer = graph.optimize(GraphConfig(), initialize="odometry")
    assert not answer.rejected.any()
    assert graph.drift[1] == pytest.approx(drift[1], abs=1e-3)
    (line,) = graph.corrections(np.arange(len(graph)))
    assert re.fullmatch(r"corrected by loop closures: length [+-]0\.\d %, turn -(9|10)\.\d mrad/m", line)
    assert np.abs(graph.poses - true)[:, :2, 2].max() < 0.2


@WRITTEN
def test_loops_that_agree_show_a_slip_of_odometry_instead_of_being_rejected(written):
    graph, true = round_trips(
        lambda i, Z: Z @ lie.pose_2d(0.15 if 70 <= i < 80 else 0.0, 0.0, 0.0), written=written
    )
    answer = graph.optimize(GraphConfig(), initialize="odometry")
    assert not answer.rejected.any() and not graph.drift.any()
    (slip,) = graph.inflated
    assert slip.first < 80 and slip.first + slip.count > 70
    first, last = 10 * slip.first, 10 * (slip.first + slip.count)
    (line,) = graph.corrections(10 * np.arange(len(graph)), "scans")
    said = re.fullmatch(
        rf"corrected by loop closures: a slip of (.*) m between scans {first:,} and {last:,}", line
    )
    assert float(said[1]) == pytest.approx(-1.5, abs=0.3)
    assert np.abs(graph.poses - true)[:, :2, 2].max() < 0.7


@WRITTEN
def test_loops_that_agree_show_a_jump_of_odometry_among_the_last_poses_instead_of_being_rejected(written):
    jump = lie.pose_2d(-2.0, 1.0, 0.1)
    graph, true = round_trips(lambda i, Z: Z @ jump if i == 1105 else Z, turns=20, written=written, every=2)
    graph.optimize(GraphConfig(), initialize="odometry")
    assert graph.state().is_rejected.any() and np.abs(graph.poses - true)[1110:, :2, 2].max() > 1.0
    graph.optimize_end(GraphConfig(), 1000, "judge")
    assert not graph.is_rejected.any() and not graph.drift.any()
    (jump,) = graph.inflated
    edge = jump.first
    assert abs(edge - 1105) <= 1
    assert graph.corrections(10 * np.arange(len(graph)), "scans") == [
        f"corrected by loop closures: a jump between scans {10 * edge:,} and {10 * edge + 10:,}"
    ]
    assert np.abs(np.delete(graph.poses - true, 1105, axis=0))[:, :2, 2].max() < 0.05  # it is to either side


@pytest.mark.parametrize("first", [0, 100])
def test_odometry_that_no_loop_contradicts_is_left_as_it_is(first):
    graph, _ = round_trips(lambda i, Z: Z)
    graph.optimize_end(GraphConfig(), first, "judge") if first else graph.optimize(GraphConfig())
    assert not graph.corrections(np.arange(len(graph))) and graph.inflated == ()
    assert not graph.drift.any()


def test_steps_as_short_as_their_noise_are_no_drift_of_the_scale():
    rng = np.random.default_rng(5)
    true = np.array(list(accumulate(lie.exp(rng.normal(0.0, [0.1, 0.1, 0.5], (900, 3))), np.matmul)))
    sigma = np.array([0.1, 0.1, 0.05])
    chain = np.stack([np.arange(899), np.arange(1, 900)], axis=1)
    pairs = rng.integers(0, 900, (1200, 2))
    edges = np.concatenate([chain, pairs[np.abs(pairs[:, 0] - pairs[:, 1]) > 1]])
    measured = lie.between(true[edges[:, 0]], true[edges[:, 1]]) @ lie.exp(
        sigma * rng.normal(size=(len(edges), 3))
    )
    measured[-10:] = measured[-10:] @ lie.pose_2d(1.0, -1.0, 0.5)  # wrong: something to explain
    is_loop = np.arange(len(edges)) >= len(chain)
    graph = graph_of(true, edges, measured, np.diag(sigma**-2), is_loop)
    assert graph.optimize(GraphConfig(), initialize="given").rejected.sum() >= 10
    assert not graph.drift.any() and not graph.inflated


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
