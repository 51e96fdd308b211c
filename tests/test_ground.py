"""Vehicles on wheels stay in planes where the lidar does not contradict it; hills and ramps stay as they are."""

from dataclasses import replace

import numpy as np
import pytest
from msgspec.structs import replace as with_fields

import scanchain
from scanchain import lie
from scanchain.config import Config
from scanchain.data import KeyframeErrors
from scanchain.ground import flattened
from scanchain.simulation import plan
from tests.support import made
from tests.support.fixes import driven

DRIFT_RAD_M = 5e-6  # pitch, which lifts a path of 440 m by 0.5 m
COVARIANCE = np.diag(np.array([0.002] * 3 + [0.0005] * 3) ** 2)  # of an edge, without the floor of the optimizer


def config_of(ground):
    """The default one, for this use of the ground."""
    return Config(graph=with_fields(Config().graph, ground=ground))


def flattened_drive(world, pitch_rad_m=DRIFT_RAD_M, *, ground="auto", T_lidar_mounted=None, levels=True):
    """Graph of a drive with drift, the same on its ground, the note on it, and true poses of the keyframes."""
    T = np.eye(4) if T_lidar_mounted is None else T_lidar_mounted
    truth = plan(world, sensor="vlp-16", duration_s=60.0 if world == "field" else None).truth()
    _, graph, chosen = driven(replace(truth, poses=truth.poses @ T), pitch_rad_m=pitch_rad_m)
    errors = [KeyframeErrors(1.0, COVARIANCE, 0.5)] * len(graph)
    found, note = flattened(graph, errors, T[2, :3], config_of(ground), levels=levels)
    return graph, found, note, truth.poses[chosen] @ T


def height_errors_m(poses, true):
    """Errors of the heights above the first pose."""
    errors = poses[:, 2, 3] - true[:, 2, 3]
    return np.abs(errors - errors[0])


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_drift_of_the_height_is_corrected_on_a_flat_ground_however_the_lidar_is_mounted(tilt):
    T = lie.exp(np.array([0.0, 0.0, 0.0, 0.5 * tilt, tilt, 2.0 * tilt]))
    before, graph, note, true = flattened_drive("field", T_lidar_mounted=T)
    assert "flat over 100 % of the path, which levels the result" in note
    drifted_m = height_errors_m(true[0] @ before.poses, true).max()
    assert drifted_m > 0.3
    assert height_errors_m(graph.poses, true).max() < 0.1 * drifted_m


def test_a_world_that_gravity_leveled_is_not_leveled_again():
    before, graph, note, _ = flattened_drive("field", levels=False)
    assert "levels" not in note
    steps = [lie.between(each.poses[:-1], each.poses[1:]) for each in (before, graph)]
    assert np.abs(lie.log(lie.between(*steps))[:, :2]).max() < 0.01  # along the ground nothing moves
    mean = graph.poses[:, :3, 2].mean(axis=0)
    np.testing.assert_allclose(mean / np.linalg.norm(mean), before.poses[:, :3, 2].mean(axis=0), atol=1e-3)


@pytest.mark.parametrize("world", ["town", "rounds", "highway", "forest"])
def test_a_rolling_ground_stays_as_it_is(world):
    before, graph, note, _ = flattened_drive(world)
    assert graph is before and note == ""


def test_a_hill_as_gentle_as_drift_is_flattened_only_where_the_user_says_so():
    before, graph, note, _ = flattened_drive("field", 1e-4)
    assert graph is before and note == ""
    before, graph, note, true = flattened_drive("field", 1e-4, ground="on")
    assert height_errors_m(before.poses, true).max() > 10.0
    assert height_errors_m(graph.poses, true).max() < 0.1


def test_two_floors_are_flat_and_the_ramp_between_them_stays_as_it_is():
    before, graph, note, true = flattened_drive("garage", 1e-4)
    constrained = graph.edges[graph.is_of_origin, 1]
    on_ramp = np.abs(true[:, 2, 2]) < 0.999
    assert "flat over 75 % of the path" in note and not on_ramp[constrained].any() and on_ramp.sum() > 20
    steps = [lie.between(each.poses[:-1], each.poses[1:])[on_ramp[1:]] for each in (before, graph)]
    assert np.abs(lie.log(lie.between(*steps))).max() < 1e-3
    on_top = [np.median(each.poses[true[:, 2, 3] > 4.9, 2, 3]) for each in (before, graph)]
    assert abs(on_top[1] - on_top[0]) < 0.1 and height_errors_m(graph.poses, true).max() < 0.1


def test_edges_that_contradict_a_plane_keep_the_path_as_it_is():
    truth = plan("field", sensor="vlp-16", duration_s=60.0).truth()
    _, graph, _ = driven(truth, pitch_rad_m=DRIFT_RAD_M)
    certain = [KeyframeErrors(1.0, 1e-6 * COVARIANCE, 0.5)] * len(graph)
    assert flattened(graph, certain, np.array([0.0, 0.0, 1.0]), Config(), levels=True)[0] is graph


def test_a_log_with_wheels_is_flat_and_without_them_as_it_was():
    path = made.log("field", sensor="vlp-16", seconds=14.0)
    true = scanchain.read_tum(path.with_suffix(".tum")).poses

    def solved(ground, *, wheels):
        log = scanchain.open_log(path)
        slam = scanchain.Slam(config_of(ground), log.T_base_lidar, dimension=3)
        for scan in log:
            slam.process(scan if wheels else replace(scan, T_odom_base=None))
        result = slam.finish()
        return result, any("ground: flat" in note for note in result.sensor_notes)

    (wheels, is_flat), (off, _) = (solved(ground, wheels=True) for ground in ("auto", "off"))
    drifted_m = height_errors_m(true[0] @ off.trajectory.poses, true).max()
    assert is_flat and height_errors_m(wheels.trajectory.poses, true).max() < 0.5 * drifted_m
    np.testing.assert_allclose(wheels.odometry.poses[0], wheels.trajectory.poses[0], atol=1e-12)
    (without, is_flat), (off, _) = (solved(ground, wheels=False) for ground in ("auto", "off"))
    assert not is_flat and np.array_equal(without.trajectory.poses, off.trajectory.poses)
    assert solved("on", wheels=False)[1]
