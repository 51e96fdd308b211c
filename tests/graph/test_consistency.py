"""Edges against all others, and groups of edges that agree."""

from types import SimpleNamespace

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.consistency import Consistency, agreeing_groups, apart, carried, connected, is_bent
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
    group = np.arange(count, len(pairs))
    without, chi2 = optimized(everything & (np.arange(len(pairs)) < count))
    falls = Consistency(problem, whole.poses, everything).of_group(group)
    rises = Consistency(problem, without.poses, np.arange(len(pairs)) < count).of_group(group)
    assert falls == pytest.approx(with_all - chi2, rel=0.05) and rises == pytest.approx(with_all - chi2, rel=0.05)


def test_edges_that_join_the_same_segments_with_the_same_mistake_are_a_group_and_others_are_none():
    true = np.array([lie.pose_2d(0.5 * k, 0.0, 0.0) for k in range(50)])
    chain = [(k, k + 1) for k in range(49)]
    right = [(k, k + 20) for k in (3, 4, 5, 6)]
    wrong = [(k, k + 20) for k in (4, 5, 6, 7, 8)]  # 3 m too far, all of them
    lone = [(5, 25), (30, 45), (6, 26)]
    edges = np.array([*chain, *right, *wrong, *lone])
    Z = lie.between(*true[edges.T]) @ lie.exp(0.001 * np.random.default_rng(0).normal(size=(len(edges), 3)))
    Z[53:58] = Z[53:58] @ lie.pose_2d(3.0, 0.0, 0.0)
    Z[58] = Z[58] @ lie.pose_2d(0.0, 2.0, 0.0)
    Z[60] = Z[60] @ lie.pose_2d(0.0, 0.0, 1.0)
    graph = graph_of(true, edges, Z, 1e4 * np.eye(3), np.arange(len(edges)) >= 49)
    problem, every = graph._prepared(), np.ones(len(edges), bool)
    groups = agreeing_groups(problem, true, every, 16.0)
    assert [group.tolist() for group in groups] == [[49, 50, 51, 52], [53, 54, 55, 56, 57]]
    every[[50, 51]] = False
    assert [group.tolist() for group in agreeing_groups(problem, true, every, 16.0)] == [[53, 54, 55, 56, 57]]


@pytest.mark.parametrize(
    ("count", "step_m", "sizes"), [(4, 0.03, [4]), (4, 0.3, []), (40, 0.0, [40]), (60, 0.0, [])]
)
def test_a_group_differs_by_no_more_than_odometry_between_its_edges_may_and_is_not_too_large(count, step_m, sizes):
    true = np.array([lie.pose_2d(0.5 * k, 0.0, 0.0) for k in range(200)])
    chain, loops = [(k, k + 1) for k in range(199)], [(4 * k, 4 * k + 20) for k in range(min(count, 40))]
    loops += [(k, k + 21) for k in range(count - len(loops))]
    edges = np.array([*chain, *loops])
    Z = lie.between(*true[edges.T])
    Z[199:] = Z[199:] @ lie.exp(np.outer(step_m * np.arange(count), [1.0, 0.0, 0.0]))
    information = np.where(np.arange(len(edges)) < 199, 1e4, 1e8)[:, None, None] * np.eye(3)
    problem = graph_of(true, edges, Z, information, np.arange(len(edges)) >= 199)._prepared()
    groups = agreeing_groups(problem, true, np.ones(len(edges), bool), 16.0)
    assert [len(group) for group in groups] == sizes


@pytest.mark.parametrize(
    ("increase", "is_rejected", "bent"),
    [
        (np.full(20, 2.0), False, False),
        (np.full(20, 4.0), False, True),  # all of them by more than their three residuals
        (20.0 * np.eye(20)[3], False, True),  # one by more than an edge in force may have
        (20.0 * np.eye(20)[3], True, False),
        (10.0 * np.eye(20)[3], False, False),
        (500.0 * np.eye(20)[19], False, False),  # that of a single pose is not of the map
    ],
)
def test_a_map_is_bent_by_what_its_edges_contradict_one_by_one_or_on_average(increase, is_rejected, bent):
    edges = np.column_stack([np.append(np.arange(19), -1), np.arange(1, 21)])
    rejected = is_rejected & (np.arange(20) == 3)
    before, after = (
        SimpleNamespace(edges=edges, edge_chi2=chi2, poses=np.empty((21, 3, 3)), is_rejected=rejected)
        for chi2 in (np.ones(20), 1.0 + increase)
    )
    assert is_bent(before, after, 1.0) is bent


def test_a_pose_carried_along_true_poses_is_the_true_one(dimension):
    rng = np.random.default_rng(1)
    true = lie.exp(rng.normal(size=(12, 3 * dimension - 3)))
    edges, others = rng.integers(0, 12, (2, 30, 2))
    found = carried(true, edges, lie.between(*true[edges.T]), others)
    np.testing.assert_allclose(found, lie.between(*true[others.T]), atol=1e-12)


def test_groups_are_the_components_of_the_pairs_that_agree():
    rng = np.random.default_rng(2)
    pairs = rng.integers(0, 60, (70, 2))
    component = {k: {k} for k in range(60)}
    for a, b in pairs.tolist():
        if (a + b) % 3:
            for each in (both := component[a] | component[b]):
                component[each] = both
    expected = sorted({tuple(sorted(each)) for each in component.values() if len(each) >= 3})
    found = connected(pairs, 60, lambda a, b: (a + b) % 3 != 0)
    assert sorted(tuple(group.tolist()) for group in found) == expected and len(expected) >= 2


def test_of_edges_near_each_other_at_both_ends_the_first_alone_is_left():
    ends = np.random.default_rng(3).integers(0, 60, (200, 2))
    edges = np.arange(3, 200, 2)
    left = []
    for edge in edges.tolist():
        if all(np.abs(ends[edge] - ends[other]).max() > 5 for other in left):
            left.append(edge)
    assert apart(ends, edges).tolist() == left and 10 < len(left) < 90
