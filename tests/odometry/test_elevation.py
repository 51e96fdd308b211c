"""Elevation offset: found on real sweeps and on made-up ground, corrected, and never made up."""

import math

import numpy as np
import pytest

from scanchain import lie
from scanchain.odometry import Odometry
from scanchain.odometry.elevation import ElevationCalibration, adjusted, raised
from scanchain.trajectory import read_tum
from tests.support.scenes import configured, kitti_scans, shared_data

POSES = np.stack([lie.exp(np.array([2.0 * k, 0.1 * k, 0.0, 0.0, 0.01 * k, 0.02 * k])) for k in range(8)])


def seen(T, rng, points=3000):
    """Points on rolling ground and between two walls, with 1 cm of noise, as seen from T."""
    x, y = T[:3, 3][:2, None] + rng.uniform(-20.0, 20.0, (2, points))
    ground = np.stack([x, y, 0.3 * np.sin(0.2 * x) + 0.2 * np.cos(0.15 * y) - 1.7])
    wall = np.stack([x, np.sign(y) * 12.0, rng.uniform(-1.7, 3.0, points)])
    across = np.stack([np.sign(x - T[0, 3]) * 9.0 + 7.0, y, rng.uniform(-1.7, 3.0, points)])
    world = np.concatenate([ground, wall, across], axis=1).T + rng.normal(0.0, 0.01, (3 * points, 3))
    return lie.transform(lie.inverse(T), world)


@pytest.mark.parametrize("offset_deg", [0.0, 0.3, -0.2])
def test_the_offset_and_the_poses_are_found_on_ground_of_any_shape(offset_deg):
    rng = np.random.default_rng(0)
    offset_rad = math.radians(offset_deg)
    scans = [raised(seen(T, rng), -offset_rad) for T in POSES]
    shifted = POSES @ lie.exp(rng.normal(0.0, [0.03] * 3 + [0.003] * 3, (8, 6)))
    shifted[-1] = POSES[-1]
    found = adjusted(scans, shifted, 1.0)
    assert found.offset_rad == pytest.approx(offset_rad, abs=math.radians(0.02))
    assert found.is_accurate and found.is_significant == (offset_deg != 0.0)
    assert found.shows_none == (offset_deg == 0.0)
    assert np.abs(lie.between(found.poses[:-1], found.poses[1:]) - lie.between(POSES[:-1], POSES[1:])).max() < 0.02


def test_points_are_raised_by_their_elevation_alone():
    points = seen(POSES[0], np.random.default_rng(1))
    moved = raised(points, 0.01)
    elevation = [np.arctan2(each[:, 2], np.hypot(each[:, 0], each[:, 1])) for each in (points, moved)]
    azimuth = [np.arctan2(each[:, 1], each[:, 0]) for each in (points, moved)]
    assert np.allclose(elevation[1] - elevation[0], 0.01) and np.allclose(*azimuth)
    assert np.allclose(np.linalg.norm(points, axis=1), np.linalg.norm(moved, axis=1))


@pytest.mark.parametrize(("is_wanted", "poses"), [(False, POSES), (True, np.repeat(POSES[:1], 30, axis=0))])
def test_nothing_is_estimated_where_unwanted_or_at_rest(is_wanted, poses):
    rng = np.random.default_rng(2)
    calibration = ElevationCalibration(is_wanted=is_wanted)
    assert not any(calibration.take(raised(seen(T, rng, 300), -0.005), T, 1.0) for T in poses)
    assert calibration.offset_rad == 0.0


def test_a_few_flat_points_give_no_offset():
    rng = np.random.default_rng(3)
    for scans in ([seen(T, rng, 5) for T in POSES], [np.zeros((50, 3))] * 8):
        assert not adjusted(scans, POSES, 1.0).is_significant


def pitch_per_meter(poses, truth):
    """Mean size of the pitch error over 20 scans, rad/m."""
    first, last = np.arange(10, len(poses) - 20), np.arange(30, len(poses))
    motion, true = lie.between(poses[first], poses[last]), lie.between(truth[first], truth[last])
    error = lie.log(lie.between(true, motion))
    return np.mean(np.abs(error[:, 4]) / np.linalg.norm(true[:, :3, 3], axis=1))


def test_the_vertical_angles_of_kitti_are_corrected_and_its_pitch_drifts_less():
    scans, error, offset_deg = kitti_scans(54), {}, {}
    truth = read_tum(shared_data("3d/kitti_0001_first54.tum")).poses
    for is_wanted in (False, True):
        odometry = Odometry(configured(3, {"preprocess.calibrate_elevation": is_wanted}))
        poses = np.array([odometry.process(scan).T_odom_lidar for scan in scans])
        error[is_wanted] = pitch_per_meter(poses, truth)
        offset_deg[is_wanted] = math.degrees(odometry.elevation.offset_rad)
    assert offset_deg[False] == 0.0 and 0.15 < offset_deg[True] < 0.3  # readers of KITTI correct it by 0.205
    assert 0 < odometry.calibrated_from < 20
    assert error[True] < 0.5 * error[False]
