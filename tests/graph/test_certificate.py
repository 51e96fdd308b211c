"""The certificate: its bounds hold, true minima get it, false ones do not."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.certificate import Minorants, dual_matrix, minorize
from scanchain.graph.cholesky import BlockPattern
from scanchain.graph.problem import GraphProblem
from tests.support import naive_graph
from tests.support.graphs import PLAIN, closed_ring, garage, graph_of, published, restarted, sight, tangled


def minorant_values(bound, G_i, G_j, leap):
    """The bound at rotations G_i, G_j (N, d, d) against the estimate, with t_j − t_i = leap; see ``Minorants``."""
    turned = (np.swapaxes(G_i, 1, 2) @ leap[..., None])[..., 0] - bound.leap[0]
    torsion = (bound.coupling[0] * (np.eye(leap.shape[1]) - np.swapaxes(G_i, 1, 2) @ G_j)).sum(axis=(1, 2))
    return bound.value[0] + bound.tau[0] * (turned**2).sum(axis=1) + turned @ bound.force[0] + torsion


def everywhere(problem, T_i, T_j):
    """χ² (N,) of the only edge of a problem with its ends at each of these poses."""
    count = len(T_i)
    Z, omega = (np.repeat(each, count, axis=0) for each in (problem.measurements, problem.information))
    edges = np.arange(2 * count).reshape(2, -1).T.copy()
    of_all = GraphProblem(edges, Z, omega, np.zeros(2 * count, bool))
    return of_all.chi2(of_all.errors(np.concatenate([T_i, T_j])))


@pytest.mark.parametrize("touching", [False, True])
@pytest.mark.parametrize("is_of_position", [False, True])
def test_the_bound_of_an_edge_is_nowhere_above_its_chi2(dimension, is_of_position, touching):
    rng = np.random.default_rng(1)
    k, bounded = (3, 6)[dimension - 2], 0
    for _ in range(60):
        noise = rng.choice([0.01, 0.1, 0.3] if touching else [0.01, 0.1, 0.3, 1.0])
        poses = lie.exp(rng.normal(size=(2, k)))
        Z = lie.inverse(poses[0]) @ poses[1] @ lie.inverse(lie.exp(noise * rng.normal(size=k)))
        A = rng.normal(size=(k, k))
        omega = (0.1 * A @ A.T + np.diag(rng.choice([1.0, 0.1], k))) / noise**2
        if is_of_position:
            omega[dimension:], omega[:, dimension:] = 0.0, 0.0
        problem = GraphProblem(np.array([[0, 1]]), Z[None], omega[None], np.array([True, False]))
        bound = minorize(problem, poses, np.ones(1), touching=touching)
        if np.isnan(bound.tau[0]):
            assert touching
            continue
        at_estimate = problem.chi2(problem.errors(poses))[0]
        if touching or is_of_position:
            assert bound.value[0] == pytest.approx(at_estimate)
        reach = rng.choice([1e-3, 0.03, 0.3, 1.0, 3.0], size=(2000, 1))
        T_i, T_j = lie.exp(reach * rng.normal(size=(2, 2000, k))) @ poses[:, None]
        chi2 = everywhere(problem, T_i, T_j)
        G_i, G_j = (T[:, :-1, :-1] @ T_0[:-1, :-1].T for T, T_0 in zip((T_i, T_j), poses, strict=True))
        values = minorant_values(bound, G_i, G_j, T_j[:, :-1, -1] - T_i[:, :-1, -1])
        assert np.all(values <= chi2 + 1e-9 * (chi2 + at_estimate) + 1e-11)
        bounded += 1
    assert bounded >= 20


@pytest.mark.parametrize("touching", [False, True])
def test_the_dual_matrix_is_the_sum_of_the_bounds_of_the_edges(dimension, touching):
    """For any rotations and positions: S with the multipliers taken off differs from the bounds by a constant."""
    rng = np.random.default_rng(5)
    k, count = (3, 6)[dimension - 2], 5
    poses = lie.exp(rng.normal(size=(count, k)))
    edges = np.array([[0, 1], [2, 1], [2, 3], [4, 3], [4, 0], [1, 3]])
    measured = lie.inverse(poses[edges[:, 0]]) @ poses[edges[:, 1]] @ lie.exp(0.005 * rng.normal(size=(6, k)))
    A = rng.normal(size=(6, k, k))
    problem = GraphProblem(edges, measured, A @ np.swapaxes(A, 1, 2) + np.eye(k), np.zeros(count, bool))
    bound = minorize(problem, poses, np.ones(6), touching=touching)
    blocks, residual = dual_matrix(problem, bound, np.ones(6, bool))
    pattern = BlockPattern(np.full(count, dimension + 1), problem.pattern.pairs)
    S = naive_graph.dense(pattern, blocks.reshape(-1))

    def stacked(G, t):
        return np.concatenate([np.concatenate([G_i.T, t_i[None]]) for G_i, t_i in zip(G, t, strict=True)])

    start = stacked(np.tile(np.eye(dimension), (count, 1, 1)), poses[:, :-1, -1])
    assert np.allclose(S @ start, residual.reshape(-1, dimension))
    for _ in range(5):
        moved = lie.exp(rng.normal(size=(count, k)))
        G, t = moved[:, :-1, :-1], poses[:, :-1, -1] + rng.normal(size=(count, dimension))
        expected = sum(
            minorant_values(
                Minorants(*(getattr(bound, name)[e : e + 1] for name in Minorants.__slots__)),
                G[i][None], G[j][None], (t[j] - t[i])[None],
            )[0] - bound.value[e]
            for e, (i, j) in enumerate(edges)
        )  # fmt: skip
        X = stacked(G, t)
        assert np.trace(X.T @ S @ X) - np.trace(start.T @ S @ start) == pytest.approx(expected, rel=1e-9)


def test_the_two_numbers_that_the_bound_rests_on():
    """V⁻¹ slopes at most 0.9311 up to π; κ‖φ‖² bends at least as said, for θ* up to 1 rad, in all directions."""
    for theta in np.linspace(1e-2, np.pi - 1e-6, 40):
        for toward in np.linspace(0.0, np.pi / 2, 20):
            ahead = 1e-6 * np.array([np.sin(toward), 0.0, np.cos(toward)])
            there, back = (_inverse_v(np.array([0.0, 0.0, theta]) + sign * ahead) for sign in (1.0, -1.0))
            assert np.linalg.norm(there - back, 2) / 2e-6 <= 0.9311
    delta = np.linspace(1e-2, np.pi, 1500)[:, None]
    cosine = np.linspace(-1.0, 1.0, 401)
    for start in np.linspace(0.0, 1.0, 21):
        half = np.cos(start / 2) * np.cos(delta / 2) - np.sin(start / 2) * np.sin(delta / 2) * cosine
        angle = 2.0 * np.arccos(np.clip(np.abs(half), 0.0, 1.0))
        gained = angle**2 - start**2 - 2.0 * start * np.sin(delta) * cosine
        assert (gained - (2.0 - 0.72 * start**2) * (1.0 - np.cos(delta))).min() >= -1e-12


def _inverse_v(phi):
    columns = [lie.exp(np.array([*axis, *phi]))[:3, 3] for axis in np.eye(3)]
    return np.linalg.inv(np.array(columns).T)


@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_a_ring_wound_up_once_is_a_minimum_but_not_certified_and_the_relaxation_unwinds_it(dimension, noise):
    """Turning by 2π/40 at every step no step is far from its measurement, and yet all are wrong."""
    wound = closed_ring(dimension, 40, 1, noise)
    answer = wound.optimize(GraphConfig(robust="none", max_iterations=1000), initialize="given")
    assert answer.converged and answer.chi2_after > 1000.0
    certificate = wound.certify()
    assert not certificate.certified and certificate.gap > 0.9 * certificate.chi2
    unwound = closed_ring(dimension, 40, 0, noise)
    assert unwound.optimize(PLAIN).chi2_after < 100.0
    assert unwound.certify().certified
    again, certificate = wound.optimize_globally(PLAIN, initialize="given")
    assert certificate.certified and again.initialization == "relaxation"
    assert again.chi2_after == pytest.approx(unwound.state().chi2, rel=1e-6, abs=1e-6)


def test_a_graph_without_contradictions_is_optimal_whatever_the_rounding():
    graph = closed_ring(2, 5, 0)
    graph.optimize(PLAIN)
    certificate = graph.certify()
    assert certificate.certified and certificate.relative_gap == 0.0
    assert certificate.verdict == "globally optimal: χ² is zero"


def test_the_minimum_and_its_certificate_do_not_depend_on_the_unit_of_the_information(dimension):
    of_all, poses = [], []
    for unit in (1.0, 1e-6, 1e-12):
        ring = closed_ring(dimension, 40, 0, 0.1)
        graph = graph_of(ring.poses, ring.edges, ring.measurements, unit * ring.information)
        answer, certificate = graph.optimize(PLAIN, initialize="given"), graph.certify()
        assert answer.converged and answer.chi2_after < 0.9 * answer.chi2_before
        assert certificate.certified and not certificate.is_zero and certificate.relative_gap < 1e-3
        of_all.append(answer.chi2_after / unit)
        poses.append(graph.poses)
    assert of_all == pytest.approx([of_all[0]] * 3, rel=1e-6)
    assert np.abs(np.array(poses) - poses[0]).max() < 1e-5


def test_an_unfinished_answer_has_a_wider_gap():
    graph = published("sphere2500")
    best = graph.optimize(PLAIN).chi2_after
    graph = published("sphere2500")
    early = graph.optimize(GraphConfig(robust="none", max_iterations=2))
    certificate = graph.certify()
    assert certificate.certified
    assert 0.0 < early.chi2_after - best <= certificate.gap < 0.01 * best


def test_a_graph_with_several_fixed_poses_is_certified_if_they_agree_with_its_edges():
    graph = closed_ring(2, 30, 0, noise=0.01)
    graph.fix(0)
    graph.fix(7)
    graph.optimize(PLAIN)
    assert graph.certify().certified


@pytest.mark.parametrize("seed", range(12))
def test_no_minimum_is_below_the_lower_bound(dimension, seed):
    """Small graphs with several minima, each solved from 16 starts; bounds at the best, the worst, the first."""
    graph, rng = tangled(dimension, seed), np.random.default_rng(seed)
    starts = [graph] + [restarted(graph, rng, size) for size in (0.1, 0.5, 1.5) for _ in range(5)]
    config = GraphConfig(robust="none", max_iterations=200)
    minima = [
        (each.optimize(config, initialize="given" if index else "auto").chi2_after, index)
        for index, each in enumerate(starts)
    ]
    least = min(minima)[0]
    for index in (0, min(minima)[1], max(minima)[1]):
        certificate = starts[index].certify()
        assert certificate.lower_bound <= least * (1.0 + 1e-7) + 1e-9
        assert not certificate.certified or certificate.gap <= 0.01 * certificate.chi2


def test_noise_up_to_where_the_relaxation_is_not_tight_gets_a_gap():
    graph = garage(count=300, sigma=(0.3, 0.1))
    graph.optimize(PLAIN)
    certificate = graph.certify()
    assert 1e-5 < certificate.relative_gap < 0.05


def test_an_edge_that_cannot_be_bounded_costs_its_chi2_and_no_more():
    rng = np.random.default_rng(0)
    truth = [lie.pose_2d(4.0 * np.cos(a), 4.0 * np.sin(a), a + np.pi / 2) for a in np.linspace(0.0, 6.0, 40)]
    graph = graph_of(truth)
    for reach in (1, 2, 5):
        for i in range(40 - reach):
            off = lie.exp(0.05 * rng.normal(size=3))
            graph.add_edge(i, i + reach, lie.inverse(truth[i]) @ truth[i + reach] @ off, 400.0 * np.eye(3))
    contrary = lie.inverse(truth[3]) @ truth[30] @ lie.pose_2d(0.0, 0.0, 2.0)
    graph.add_edge(3, 30, contrary, 0.1 * np.eye(3))
    graph.optimize(PLAIN)
    certificate = graph.certify()
    price = graph.state().edge_chi2[-1]
    assert certificate.certified
    assert 0.9 * price < certificate.gap < 0.01 * certificate.chi2


@pytest.mark.parametrize("information", [1e-300, 1e-50, 1e50])
def test_no_information_that_is_taken_overflows(dimension, information):
    k = (3, 6)[dimension - 2]
    measured = lie.exp(0.3 * np.random.default_rng(0).normal(size=(4, k)))
    edges, omega = [(0, 1), (1, 2), (2, 3), (3, 0)], np.diag([information, *[1.0] * (k - 1)])
    graph = graph_of([lie.identity(dimension)] * 4, edges, measured, omega)
    with np.errstate(all="raise", under="ignore"):
        assert np.isfinite(graph.optimize(PLAIN).chi2_after)
        graph.certify()
    assert np.isfinite(graph.poses).all()


@pytest.mark.parametrize("turns", [0, 1])
def test_a_ring_with_a_point_is_certified_unless_it_is_wound_up(turns):
    graph = closed_ring(2, 30, turns)
    mark = graph.add_point(np.array([2.0, 1.0]), 99)
    sight(graph, (0, mark), (2.0, 1.1), np.eye(2))
    sight(graph, (1, mark), (2.1, 1.0), np.eye(2))
    assert graph.optimize(PLAIN, initialize="given").converged
    assert graph.certify().certified == (turns == 0)
