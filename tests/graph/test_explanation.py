import re
from itertools import accumulate

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.graph.explanation import RejectedLoops
from scanchain.graph.odometry_errors import corrected
from tests.support.graphs import graph_of


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


def test_errors_of_odometry_change_chi2_and_the_residuals_of_rejected_loops_as_in_the_graph_optimized_anew(
    dimension,
):
    rng, k, count = np.random.default_rng(4), 3 * dimension - 3, 24
    true = np.array(list(accumulate([lie.exp(np.eye(k)[0] + 0.3 * np.eye(k)[-1])] * count, np.matmul)))
    chain = [(i, i + 1) if i % 3 else (i + 1, i) for i in range(count - 1)]
    edges = np.array([*chain, (0, 20), (3, 23), (1, 12), (9, 21), (15, 2)])
    kept = np.arange(len(edges)) < len(chain) + 2
    sigma, is_loop = rng.uniform(0.01, 0.03, k), np.arange(len(edges)) >= len(chain)
    Z = lie.between(*true[edges.T]) @ lie.exp(sigma * rng.normal(size=(len(edges), k)))
    omega = np.diag(sigma**-2.0)

    def optimized(measured):
        graph = graph_of(true, edges[kept], measured[kept], omega)
        return graph.optimize(GraphConfig(robust="none", tolerance=1e-14)).chi2_after, graph.poses.copy()

    chi2, poses = optimized(Z)
    problem = graph_of(true, edges, Z, omega, is_loop)._prepared()
    odometry = np.arange(len(chain))
    loops = RejectedLoops(problem, poses, odometry, kept)
    assert loops.edges.tolist() == np.flatnonzero(~kept).tolist() and loops.stride == 1
    among = slice(5, 15)
    twists, changes = 0.01 * rng.normal(size=(10, k, 2)), []
    for sign in (1.0, -1.0):
        moved = Z.copy()
        moved[odometry[among]] = Z[odometry[among]] @ lie.exp(sign * twists[..., 0])
        chi2_moved, poses_moved = optimized(moved)
        changes.append((chi2_moved - chi2, (problem.errors(poses_moved) - loops.errors)[loops.edges]))
    (ahead, residuals), (back, others) = changes
    b, A = loops.quadratic(twists, among)
    assert A[0, 0] == pytest.approx(0.5 * (ahead + back), rel=0.03)
    assert b[0] == pytest.approx(0.25 * (back - ahead), rel=0.03)
    found = np.array([shift.sum(axis=0)[:, 0] for shift in loops.shifts(twists, among)])
    np.testing.assert_allclose(found, 0.5 * (residuals - others), atol=0.03 * np.abs(found).max())
