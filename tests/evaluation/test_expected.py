"""Expected errors against the truth of simulated logs, and as smfeval judges them; NEES; maps without a truth."""

from functools import cache

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import Config
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import (
    ScanPoses,
    absolute_error,
    disagreement,
    expected_ate,
    expected_errors,
    motion_nees,
    pair,
    sampled_map,
    sharpness,
)
from scanchain.graph.pose_graph import PoseGraph
from scanchain.logs import open_log
from scanchain.trajectory import read_tum, write_wide_tum
from tests.benchmarks.trust import judged, placed
from tests.support import made
from tests.support.graphs import PLAIN, graph_of, ring

pytestmark = pytest.mark.error_bars

DRIVES = [
    ("office", "lms-270", 20.0),
    ("identical", "lms-270", 20.0),
    ("town", "vlp-16", 5.0),
    ("hall", "os1-32", 12.0),
]


@cache
def driven(world, sensor, duration_s):
    """Result, steps, mounting, expected errors and truth of a simulated drive."""
    return placed(made.log(world, sensor=sensor, seconds=duration_s, seed=2))


@pytest.mark.parametrize("drive", DRIVES, ids=lambda drive: drive[0])
def test_a_simulated_drive_errs_as_its_expected_ate_and_its_covariances_say(drive):
    result, steps, _, expected, truth = driven(*drive)
    found = judged("", result, steps, expected, truth)
    assert found.is_covered and 1.0 / 3.0 < found.ratio < 3.0
    assert 0.2 < found.nees < 3.0
    if drive in DRIVES[::2]:
        assert 0.05 < found.gap < 6.0, "smfeval finds the covariances of keyframes too tight or too loose"


def test_of_a_graph_without_an_edge_no_error_is_expected(dimension):
    graph = PoseGraph(dimension)
    graph.add_pose(lie.identity(dimension), 0)
    scans = ScanPoses.of(graph.poses, np.zeros(1, np.int64), np.zeros((1, graph.freedom)))
    with pytest.raises(InputError, match="has no edge"):
        expected_errors(graph, (), Config(), scans)


def test_scans_move_with_their_keyframes(dimension):
    rng = np.random.default_rng(0)
    k = 3 * (dimension - 1)
    poses, of_keyframes = lie.exp(rng.normal(size=(7, k))), np.array([0, 3, 4])
    scans = ScanPoses.of(poses, of_keyframes, np.zeros((7, k)))
    assert scans.keyframe.tolist() == [0, 0, 0, 1, 2, 2, 2]
    change = 1e-6 * rng.normal(size=(3, k))
    turn = lie.exp(np.concatenate([np.zeros((3, dimension)), change[:, dimension:]], axis=1))
    keyframes = poses[of_keyframes]
    moved = turn @ keyframes
    moved[:, :dimension, dimension] = keyframes[:, :dimension, dimension] + change[:, :dimension]
    after = moved[scans.keyframe] @ lie.between(keyframes[scans.keyframe], poses)
    (found,) = scans.errors(change[None])
    np.testing.assert_allclose(found[:, :dimension], (after - poses)[:, :dimension, dimension], atol=1e-11)
    np.testing.assert_allclose(found[:, dimension:], change[scans.keyframe, dimension:])


def test_a_wide_tum_file_has_the_pose_and_the_lower_triangle_of_its_covariance(tmp_path):
    result, _, _, expected, _ = driven(*DRIVES[0])
    write_wide_tum(tmp_path / "wide.tum", result.keyframe_trajectory, expected.covariances)
    rows = np.loadtxt(tmp_path / "wide.tum")
    assert rows.shape == (len(result.keyframes), 29)
    covariance = np.zeros((6, 6))
    covariance[np.tril_indices(6)] = rows[5, 8:]
    np.testing.assert_allclose(
        covariance[np.ix_([0, 1, 5], [0, 1, 5])], np.tril(expected.covariances[5]), rtol=1e-5
    )
    assert np.linalg.eigvalsh(expected.covariances[5])[0] > 0.0


def test_a_shaken_way_makes_a_duller_map():
    office = made.log("office", seconds=6)
    log = open_log(office)
    scans, truth = list(log.scans()), read_tum(office.with_suffix(".tum"))
    exact = Trajectory(truth.stamps_ns, lie.flatten(truth.poses))
    noise = np.random.default_rng(0).normal(scale=[0.03, 0.03, 0.01], size=(len(truth), 3))
    shaken = Trajectory(exact.stamps_ns, exact.poses @ lie.exp(noise))
    sharp, dull = sharpness([sampled_map(scans, way, 1) for way in (exact, shaken)])
    assert sharp.thickness_m < 0.7 * dull.thickness_m
    assert sharp.mean_map_entropy < dull.mean_map_entropy


def test_a_map_that_has_fallen_apart_spoils_no_other():
    wall = np.random.default_rng(0).uniform(size=(5_000, 3)) * [10.0, 0.05, 3.0]
    scattered = np.random.default_rng(1).uniform(-5e3, 5e3, (5_000, 3))
    alone, (beside, lost) = sharpness([wall]), sharpness([wall, scattered])
    assert lost is None and beside == alone[0]


def test_disagreement_is_the_distance_of_motions_not_of_positions():
    steps = np.tile(lie.exp(np.array([1.0, 0.0, 0.1])), (30, 1, 1))
    way = np.array([np.linalg.matrix_power(steps[0], k) for k in range(30)])
    turned = lie.exp(np.array([5.0, 2.0, 1.0])) @ way
    longer = np.array([np.linalg.matrix_power(lie.exp(np.array([1.01, 0.0, 0.1])), k) for k in range(30)])
    apart_m = disagreement([way, turned, longer, way[:0]])
    assert apart_m[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert apart_m[0, 2] == pytest.approx(0.01, rel=0.01)
    assert np.isnan(apart_m[3]).all() and np.isnan(apart_m[:, 3]).all()


@pytest.mark.parametrize("k", [3, 6])
def test_errors_drawn_from_the_covariances_have_a_nees_of_one(k):
    rng = np.random.default_rng(k)
    count = 4000
    truth = lie.exp(rng.normal(scale=0.3, size=(count, k)))
    roots = 0.01 * rng.normal(size=(count, k, k))
    covariances = roots @ np.swapaxes(roots, 1, 2) + 1e-6 * np.eye(k)
    errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.normal(size=(count, k)))
    nees = motion_nees(truth @ lie.exp(errors), covariances, truth)
    assert nees.mean() == pytest.approx(1.0, abs=0.06)
    twice = motion_nees(truth @ lie.exp(errors), 4.0 * covariances, truth)
    np.testing.assert_allclose(twice, 0.25 * nees)
    covariances[7] = np.nan
    assert np.flatnonzero(np.isnan(motion_nees(truth, covariances, truth))).tolist() == [6, 7]


def test_of_results_of_redrawn_measurements_95_of_100_lie_within_the_bounds_of_the_expected_ate(dimension):
    rng = np.random.default_rng(0)
    _, true = ring(dimension, count=24)
    inside = 0
    for _ in range(100):
        graph = redrawn(true, rng)
        bounds = expected_ate(graph)
        poses = Trajectory(graph.stamps_ns, lie.lift(graph.poses))
        ate = absolute_error(pair(poses, Trajectory(graph.stamps_ns, lie.lift(true))))
        inside += bounds.low <= ate.translation_m.rmse <= bounds.high
    assert 90 <= inside <= 99


def redrawn(true, rng):
    """A ring, optimized, whose edges err as their information says."""
    k = 3 if len(true[0]) == 3 else 6
    sigma = rng.uniform(0.005, 0.03, k)
    edges = np.stack([np.arange(len(true)), (np.arange(len(true)) + 1) % len(true)], axis=1)
    measured = lie.between(*true[edges.T]) @ lie.exp(sigma * rng.normal(size=(len(true), k)))
    graph = graph_of(true, edges, measured, np.diag(sigma**-2.0), stamps_ns=1_000_000_000 * np.arange(len(true)))
    graph.optimize(PLAIN)
    return graph
