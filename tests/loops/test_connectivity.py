"""Segments that loops join, and the drift of odometry along the shortest path between keyframes."""

import numpy as np
import pytest
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from scanchain import lie
from scanchain.loops.connectivity import Drift, Segments
from tests.support.graphs import graph_of


def joined(count, loops=()):
    """So many keyframes, and loops between some of them."""
    one = [lie.identity(2)]
    return graph_of(one * count, loops, one * len(loops), np.eye(3), [True] * len(loops))


def connected(segments, graph):
    """Which keyframes loops or odometry connect to the newest."""
    components = segments.components(graph)
    return components == components[-1]


def test_a_new_segment_is_connected_to_nothing_until_a_loop_does_it():
    segments = Segments()
    assert connected(segments, joined(5)).all()
    segments.start(3)
    segments.start(6)
    assert connected(segments, joined(9)).tolist() == [False] * 6 + [True] * 3
    assert connected(segments, joined(9, [(1, 4)])).tolist() == [False] * 6 + [True] * 3
    assert connected(segments, joined(9, [(1, 7)])).tolist() == [True] * 3 + [False] * 3 + [True] * 3
    assert connected(segments, joined(9, [(4, 7), (1, 4)])).all()


@pytest.mark.parametrize("seed", range(4))
def test_segments_are_joined_where_loops_in_force_or_an_assumption_connect_their_keyframes(seed):
    rng, count, segments = np.random.default_rng(seed), 60, Segments()
    for start in np.sort(rng.choice(np.arange(1, count), 9, replace=False)).tolist():
        segments.start(start)
    pairs, weight = np.sort(rng.choice(count, (7, 2), replace=False)), np.tile([1.0, 0.2], 4)[:7]
    graph = joined(count, pairs)
    graph._weight.replace(weight)
    number = segments.of(np.arange(count))
    inside = np.flatnonzero(np.diff(number) == 0)
    links = [*zip(inside, inside + 1, strict=True), *pairs[weight > 0.5]]
    segments.assume(5)
    for with_assumed in (False, True):
        i, j = np.array([*links, (5, count - 1)] if with_assumed else links).T
        _, wanted = connected_components(coo_array((np.ones(len(i)), (i, j)), (count, count)))
        found = segments.components(graph, with_assumed=with_assumed)
        assert len({*zip(found, wanted, strict=True)}) == len({*found}) == len({*wanted})
    assert 1 < len({*found}) < 9


def test_a_span_ends_where_the_next_segment_starts():
    segments = Segments()
    segments.start(7)
    assert [segments.span(k, 12) for k in (0, 6, 7, 11)] == [(0, 7), (0, 7), (7, 12), (7, 12)]


def chain(count, sigma_m=0.01):
    """Keyframes a meter apart on a straight line."""
    poses, edges = [lie.pose_2d(float(k), 0.0, 0.0) for k in range(count)], [(k, k + 1) for k in range(count - 1)]
    information = np.diag([sigma_m**-2.0, sigma_m**-2.0, 1e6])
    return graph_of(poses, edges, [lie.pose_2d(1.0, 0.0, 0.0)] * len(edges), information)


@pytest.mark.parametrize(
    ("count", "more", "is_loop", "newest", "limit_m", "expected"),
    [
        (30, [], False, 29, 2.0, {k: min(0.1 * (29 - k), 2.0) for k in range(30)}),  # up to its limit
        (30, [(5, 25, 20.0)], True, 29, 5.0, {5: 0.4, 8: 0.7}),  # a loop shortens it for all that it connects
        (4, [(1, 3, 3.0), (1, 3, 0.5)], False, 0, 5.0, {0: 0.0, 1: 0.1, 2: 0.2, 3: 0.15}),  # the shorter counts
    ],
)
def test_uncertainty_grows_along_the_shortest_path(count, more, is_loop, newest, limit_m, expected):
    graph = chain(count)
    for i, j, meters in more:
        graph.add_edge(i, j, lie.pose_2d(meters, 0.0, 0.0), 1e6 * np.eye(3), is_loop=is_loop)
    uncertainty_m = Drift(0.1).between(graph, newest, limit_m)
    assert uncertainty_m[list(expected)] == pytest.approx(list(expected.values()), abs=1e-3)


def test_an_edge_counts_by_its_own_uncertainty_where_odometry_was_lost():
    graph = chain(3)
    graph.add_pose(lie.pose_2d(3.0, 0.0, 0.0), 3)
    graph.add_edge(2, 3, lie.pose_2d(1.0, 0.0, 0.0), np.diag([2.0, 2.0, 25.0]))
    assert Drift(0.1).between(graph, 3, 5.0) == pytest.approx([1.2, 1.1, 1.0, 0.0])


def test_a_rejected_loop_shortens_no_path_and_fixed_poses_do_not_drift_apart():
    graph, alone = chain(30), Drift(0.1).between(chain(30), 29, 5.0)
    graph.add_edge(5, 25, lie.pose_2d(20.0, 0.0, 0.0), 1e6 * np.eye(3), is_loop=True)
    graph._weight.replace(np.append(np.ones(29), 0.2))
    np.testing.assert_array_equal(Drift(0.1).between(graph, 29, 5.0), alone)
    for index in (3, 7, 20):
        graph.fix(index)
    np.testing.assert_array_equal(Drift(0.1).between(graph, 29, 5.0)[[3, 7, 20, 8]], alone[[20, 20, 20, 8]])


def test_uncertainty_follows_a_graph_that_grows():
    graph, drift = chain(10), Drift(0.1)
    drift.between(graph, 9, 5.0)
    graph.add_pose(lie.pose_2d(10.0, 0.0, 0.0), 10)
    graph.add_edge(9, 10, lie.pose_2d(1.0, 0.0, 0.0), 1e6 * np.eye(3))
    assert Drift(0.1).between(graph, 10, 5.0) == pytest.approx(drift.between(graph, 10, 5.0))
