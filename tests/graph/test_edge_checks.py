"""Poses that their edges leave free are found and named before anything is certified."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.errors import InputError
from scanchain.graph.edge_checks import (
    first_of_unjoined,
    free_poses,
    has_loop,
    listed,
    loose,
    nearest_semidefinite,
    positive_semidefinite,
    ranks,
    skip_poses,
)
from scanchain.graph.pose_graph import PoseGraph
from scanchain.graph.problem import GraphProblem
from tests.support import naive_graph
from tests.support.graphs import PLAIN, graph_of


def chain(dimension, silent=None, loops=(), count=6):
    """Poses far from the origin, each measured from the one before; edge (4, 5) says nothing of some axes.

    silent : slice of the axes of the twist; or a number by which all its information is multiplied
    """
    rng = np.random.default_rng(0)
    k = (3, 6)[dimension - 2]
    twists = rng.normal(size=(count, k))
    twists[:, :dimension] = 5.0 * twists[:, :dimension] + 1000.0
    true = lie.exp(twists)
    graph = PoseGraph(dimension, 10 * np.arange(count))
    for index, pose in enumerate(true):
        graph.add_pose(pose, index)
    for i, j in [*((i, i + 1) for i in range(count - 1)), *loops]:
        information = 100.0 * np.eye(k)
        if (i, j) == (count - 2, count - 1) and isinstance(silent, slice):
            information[silent] = 0.0
            information[:, silent] = 0.0
        elif (i, j) == (count - 2, count - 1) and silent is not None:
            information *= silent
        graph.add_edge(i, j, lie.inverse(true[i]) @ true[j] @ lie.exp(0.01 * rng.normal(size=k)), information)
    return graph


@pytest.mark.parametrize("silent", ["x", "y", "yaw", "positions", "rotations"])
def test_a_pose_free_along_some_axis_is_named_and_nothing_certified_unless_a_loop_holds_it(dimension, silent):
    rotations = slice(dimension, None)
    axes = {"x": slice(0, 1), "y": slice(1, 2), "yaw": slice(-1, None), "positions": slice(0, dimension)}
    graph = chain(dimension, axes.get(silent, rotations))
    answer = graph.optimize(PLAIN)
    assert answer.converged and answer.chi2_after < 1e-9
    assert graph.free_poses().tolist() == [50]
    assert graph.certify().verdict == "not certified: the edges leave 1 pose free: 50"
    assert not len(chain(dimension, axes.get(silent, rotations), [(0, 5)]).free_poses())


def test_all_zero_information_is_refused_with_the_names_of_the_poses(dimension):
    with pytest.raises(InputError, match=r"1 of 6 poses are not joined to a fixed one: 50; .* is not zero"):
        chain(dimension, 0.0).optimize(PLAIN)


def test_poses_that_hang_on_next_to_no_information_are_named(dimension):
    assert chain(dimension, 1e-9).weakly_joined().tolist() == [50]
    assert chain(dimension, 1e-9, [(0, 5)]).weakly_joined().tolist() == []
    assert chain(dimension, 1e-3).weakly_joined().tolist() == []


@pytest.mark.parametrize("share", [1e-30, 1e-12, 1e-9])
@pytest.mark.parametrize("axes", [slice(None), slice(0, 1), slice(-1, None)])
@pytest.mark.parametrize("far_m", [0.0, 5e6])
def test_a_group_on_next_to_no_information_is_named_whole_by_certificate_and_covariances(
    dimension, share, axes, far_m
):
    rng, k = np.random.default_rng(4), (3, 6)[dimension - 2]
    true = np.tile(lie.identity(dimension), (10, 1, 1))
    true[:, 0, -1] = far_m
    for index in range(1, 10):
        true[index] = true[index - 1] @ lie.exp(rng.normal(size=k))
    edges = np.array([*((i, i + 1) for i in range(9)), (0, 4), (5, 9), (0, 2), (6, 8)])
    information = np.tile(100.0 * np.eye(k), (len(edges), 1, 1))
    information[4, axes, axes] *= share
    measured = lie.between(*true[edges.T]) @ lie.exp(0.01 * rng.normal(size=(len(edges), k)))
    graph = graph_of(true, edges, measured, information)
    assert graph.optimize(PLAIN).converged
    certificate, refusal = graph.certify(), ""
    try:
        assert np.isfinite(graph.covariances()).all()
    except InputError as error:
        refusal = str(error)
    assert certificate.reason in refusal and ("5 to 9;" in refusal) == (share < 1e-10) != certificate.certified


def test_free_is_what_lies_in_the_null_space_of_the_dense_matrix(dimension):
    rng = np.random.default_rng(1)
    k, count, seen = (3, 6)[dimension - 2], 8, set()
    for _ in range(40):
        poses = lie.exp(rng.normal(size=(count, k)))
        edges = np.array([*((i, i + 1) for i in range(count - 1)), (0, 3), (2, 6)])
        Z = lie.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]]
        silent = rng.random((len(edges), k)) < 0.15
        information = (~silent).astype(float)[:, :, None] * np.eye(k)
        fixed = np.arange(count) == 0
        problem = GraphProblem(edges, Z, information, fixed)
        found = free_poses(problem, poses, np.ones(len(edges)), ranks(information), np.arange(count))
        equations = problem.linearize(poses, problem.errors(poses), np.ones(len(edges)))
        H = naive_graph.dense(problem.pattern, equations.values)
        values, vectors = np.linalg.eigh(H)
        null = vectors[:, values < 1e-10 * values[-1]].reshape(count - 1, k, -1)
        moving = 1 + np.flatnonzero((np.abs(null) > 1e-6).any(axis=(1, 2)))
        assert found.tolist() == moving.tolist()
        seen.add(len(moving))
    assert len(seen) >= 3


@pytest.mark.parametrize("initialize", ["auto", "given", "odometry", "spanning-tree", "chordal"])
@pytest.mark.parametrize("robust", ["none", "huber", "truncated"])
def test_graphs_of_any_information_end_in_an_answer_or_in_an_error_that_names_poses(initialize, robust):
    rng = np.random.default_rng(2)
    for _ in range(25):
        dimension, count = int(rng.integers(2, 4)), int(rng.integers(1, 7))
        k = (3, 6)[dimension - 2]
        true = lie.exp(rng.normal(size=(count, k)))
        graph = graph_of(true)
        pairs = [(i, i + 1) for i in range(count - 1)] + [(0, count - 1)] * (count > 2)
        for i, j in pairs:
            information = np.eye(k) * (rng.random(k) < 0.7)
            Z = lie.inverse(true[i]) @ true[j] @ lie.exp(0.1 * rng.normal(size=k))
            graph.add_edge(i, j, Z, information, is_loop=j - i > 1)
        try:
            graph.optimize(GraphConfig(robust=robust), initialize=initialize)
        except InputError as error:
            assert "not joined to a fixed one" in str(error) or " free: " in str(error)
            continue
        assert not (len(graph.free_poses()) and graph.certify().certified)


@pytest.mark.parametrize("k", [2, 3, 6])
def test_the_rank_of_an_information_matrix_does_not_depend_on_its_units(k):
    rng = np.random.default_rng(0)
    for rank in range(k + 1):
        A = rng.normal(size=(20, rank, k))
        units = np.diag(10.0 ** rng.uniform(-6.0, 6.0, k))
        assert (ranks(units @ np.swapaxes(A, 1, 2) @ A @ units) == rank).all()
    assert ranks(np.diag([1e-12, *[1e9] * (k - 1)])[None]).tolist() == [k]


def test_the_projected_matrix_is_the_nearest_semidefinite_one():
    rng = np.random.default_rng(0)
    A = rng.normal(size=(50, 6, 6))
    A += np.swapaxes(A, 1, 2)
    nearest = nearest_semidefinite(A)
    assert positive_semidefinite(nearest).all()
    # optimal: what is left over is negative semidefinite and orthogonal to the projection
    assert np.linalg.eigvalsh(A - nearest)[:, -1].max() < 1e-12
    assert np.abs(np.einsum("eab,eab->e", A - nearest, nearest)).max() < 1e-11


@pytest.mark.parametrize(
    ("corner", "is_sound"),
    [
        ([[1.0, 0.5], [0.5, 0.25]], True),  # of rank one
        ([[-1e-7, 0.0], [0.0, 1.0]], True),  # as printed digits may make it
        ([[-1e-5, 0.0], [0.0, 1.0]], False),
    ],
)
def test_a_matrix_is_sound_that_is_symmetric_and_has_no_negative_eigenvalue(corner, is_sound):
    matrix = np.eye(3)
    matrix[1:, 1:] = corner
    assert positive_semidefinite(matrix[None]).tolist() == [is_sound]


def test_poses_without_a_chain_to_a_fixed_one_are_loose_and_more_edges_than_a_forest_has_are_a_loop():
    rng = np.random.default_rng(3)
    loops = []
    for _ in range(200):
        count = int(rng.integers(2, 9))
        edges = rng.integers(0, count, (int(rng.integers(0, 9)), 2))
        fixed = rng.random(count) < 0.3
        part, cycles = list(range(count)), 0
        for i, j in edges.tolist():
            cycles += part[i] == part[j]
            part = [part[i] if each == part[j] else each for each in part]
        joined = {part[pose] for pose in np.flatnonzero(fixed)}
        assert loose(edges, fixed).tolist() == [pose for pose in range(count) if part[pose] not in joined]
        assert has_loop(edges, count) == (cycles > 0)
        loops.append(cycles > 0)
    assert 20 < sum(loops) < 180


def test_edges_skip_poses_that_join_others_than_successive_ones_unless_one_is_a_point():
    edges = np.array([(0, 1), (1, 0), (0, 2), (3, 0), (0, 4), (4, 2)])
    assert skip_poses(edges, np.arange(5) == 4).tolist() == [False, False, True, True, False, False]


@pytest.mark.parametrize(
    ("names", "text"),
    [
        ([3], "3"),
        ([3, 4], "3, 4"),
        ([3, 5, 6, 7, 9], "3, 5 to 7, 9"),
        (range(0, 18, 2), "0, 2, 4, 6, 8, 10, 12, 14, ..."),
        (range(0, 16, 2), "0, 2, 4, 6, 8, 10, 12, 14"),
    ],
)
def test_names_in_sequence_are_listed_as_a_range_and_scattered_ones_cut_off(names, text):
    assert listed(np.array(names)) == text


def test_the_first_pose_of_every_part_without_a_fixed_one_is_found():
    edges, fixed = np.array([[5, 1], [2, 4], [4, 2]]), np.zeros(7, np.bool_)
    assert first_of_unjoined(edges, fixed).tolist() == [0, 1, 2, 3, 6]
    fixed[[4, 6]] = True
    assert first_of_unjoined(edges, fixed).tolist() == [0, 1, 3]
    assert first_of_unjoined(edges[:0], ~fixed | fixed).tolist() == []
