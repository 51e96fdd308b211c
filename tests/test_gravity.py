"""The accelerometer levels a result and corrects drift of its tilt; wrong or unknown it does no harm."""

from dataclasses import replace

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.config import GraphConfig
from scanchain.data import GRAVITY_M_S2, RestForce
from scanchain.gravity import leveled
from tests.support import made
from tests.support.fixes import drive_of, driven

BIAS = np.array([0.3, -0.2, 0.1])
SIGMA_M_S2 = 0.01


def forces_along(truth, chosen):
    """Forces at rest of keyframes, with noise; the bias is known from the middle of the drive on."""
    random, forces = np.random.default_rng(0), {}
    for number, scan in enumerate(chosen.tolist()):
        noise = SIGMA_M_S2 * random.standard_normal(3)
        known = (number > len(chosen) // 2) * 1.0
        forces[number] = RestForce(
            GRAVITY_M_S2 * truth.poses[scan, 2, :3] + BIAS + noise,
            SIGMA_M_S2**2 * np.eye(3),
            known * BIAS,
            (1.0 - 0.999 * known) * np.eye(3),
        )
    return forces


def tilts_deg(poses, true):
    """Angles between the z axes of the world by poses and true ones (N, 4, 4)."""
    return np.degrees(np.linalg.norm(np.cross(poses[:, 2, :3], true[:, 2, :3]), axis=1))


@pytest.fixture(scope="module")
def truth():
    return drive_of("town", "rtk", seconds=60.0).truth()


def test_a_right_trajectory_is_leveled_rigidly(truth):
    _, graph, chosen = driven(truth)
    before, edges = graph.poses.copy(), len(graph.edges)
    graph, note = leveled(graph, forces_along(truth, chosen), GraphConfig())
    assert "levels the result to" in note and "corrects" not in note and len(graph.edges) == edges
    np.testing.assert_allclose(
        lie.between(graph.poses[:-1], graph.poses[1:]), lie.between(before[:-1], before[1:]), atol=1e-9
    )
    assert tilts_deg(graph.poses, truth.poses[chosen]).max() < 0.05


def test_drift_of_the_tilt_is_corrected_and_with_it_that_of_the_height():
    truth = drive_of("highway", "rtk").truth()
    _, graph, chosen = driven(truth, pitch_rad_m=2e-5)
    true = truth.poses[chosen]
    off_m = np.abs((true[0] @ graph.poses)[:, 2, 3] - true[:, 2, 3]).max()
    graph, note = leveled(graph, forces_along(truth, chosen), GraphConfig())
    assert "corrects drift of the tilt" in note
    assert tilts_deg(graph.poses, true).max() < 0.1
    left_m = np.abs(graph.poses[:, 2, 3] - true[:, 2, 3] + true[0, 2, 3]).max()
    assert left_m < 0.1 * off_m and off_m > 4.0
    assert np.linalg.norm(graph.poses[0, :3, 3]) < 0.01 and abs(graph.poses[0, 1, 0]) < 0.01


def test_forces_that_contradict_the_lidar_only_level(truth):
    _, graph, chosen = driven(truth)
    forces, edges = forces_along(truth, chosen), len(graph.edges)
    turned = lie.exp(np.array([0.0, 0.0, 0.0, 0.3, 0.0, 0.0]))[:3, :3]
    wrong = {k: each._replace(force=turned @ each.force) if k % 2 else each for k, each in forces.items()}
    graph, note = leveled(graph, wrong, GraphConfig())
    assert "contradicts the lidar" in note and len(graph.edges) == edges


@pytest.mark.parametrize(("imu", "is_level"), [("mems", True), ("mems-no-transform", False)])
def test_a_log_begins_at_its_true_tilt_where_the_mounting_of_the_imu_is_known(imu, is_level):
    path = made.log("town", sensor="vlp-16", seconds=12.0, imu=imu)
    truth, slam = scanchain.read_tum(path.with_suffix(".tum")), scanchain.Slam(dimension=3)
    for scan in scanchain.open_log(path):
        slam.process(replace(scan, T_odom_base=None))
    result = slam.finish()
    off_deg = [tilts_deg(each.poses, truth.poses).max() for each in (result.trajectory, result.odometry)]
    assert (max(off_deg) < 0.3) == is_level
    assert any("levels" in note for note in result.sensor_notes) == is_level
