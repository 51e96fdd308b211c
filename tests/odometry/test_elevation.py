"""Elevation offset: found on real sweeps and on made-up ground, corrected, and never made up."""

import math
from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import RaySpan
from scanchain.kernels.registration.plane_adjustment import plane_equations, planes
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.odometry.elevation import Adjusting, ElevationCalibration, _combined, raised
from scanchain.preprocess import Sweep
from scanchain.trajectory import read_tum
from tests.support import made, naive
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


def adjusted(scans, poses):
    """What an adjustment finds in cells of 1 m, step by step."""
    adjusting = Adjusting(scans, poses, 1.0)
    return next(found for found in iter(adjusting.step, "never") if found is not None)


@pytest.mark.parametrize("offset_deg", [0.0, 0.3, -0.2])
def test_the_offset_and_the_poses_are_found_on_ground_of_any_shape(offset_deg):
    rng = np.random.default_rng(0)
    offset_rad = math.radians(offset_deg)
    scans = [raised(seen(T, rng), -offset_rad) for T in POSES]
    shifted = POSES @ lie.exp(rng.normal(0.0, [0.03] * 3 + [0.003] * 3, (8, 6)))
    shifted[-1] = POSES[-1]
    found = adjusted(scans, shifted)
    assert found.offset_rad == pytest.approx(offset_rad, abs=math.radians(0.02))
    assert found.sigma_rad < math.radians(0.03)
    assert np.abs(lie.between(found.poses[:-1], found.poses[1:]) - lie.between(POSES[:-1], POSES[1:])).max() < 0.02


def test_the_equations_are_those_of_planes_that_are_free_and_no_turn_of_all_poses_matters():
    rng = np.random.default_rng(4)
    scans = [seen(T, rng, 400) for T in POSES[:3]]
    points, number = np.concatenate(scans), np.repeat(np.arange(3), [len(scan) for scan in scans])
    n, poses, scale_m = len(points), POSES[:3], 0.05
    lifted, beside, normals, residual = raised(points, 0.001), np.zeros((n, 3)), np.empty((n, 3)), np.zeros(n)
    plane, found = np.empty(n, np.int32), np.zeros((20, 20))
    count = planes(lifted, number, poses, 2.0, beside, residual, plane, normals)
    assert count > 20
    of_planes = plane, beside, residual, normals[:count]
    plane_equations(lifted, number, *of_planes, poses, scale_m, found)
    H, b = found[:-1, :-1], found[:-1, -1]
    wanted = naive.plane_equations(lifted, number, *of_planes, poses, scale_m)
    assert np.allclose(H, wanted[0], atol=1e-8 * np.abs(H).max())
    assert np.allclose(b, wanted[1], atol=1e-8 * np.abs(b).max())
    turn = np.array([[lie.adjoint(lie.inverse(T)) @ [0.0, 0.0, 0.0, 1.0, 2.0, 3.0]] for T in poses]).ravel()
    assert abs(b[:-1] @ turn) < 1e-9 * np.abs(b).max() * np.linalg.norm(turn)
    assert turn @ H[:-1, :-1] @ turn < 1e-9 * np.abs(H).max() * turn @ turn


def test_points_are_raised_by_their_elevation_alone():
    points = seen(POSES[0], np.random.default_rng(1))
    moved = raised(points, 0.01)
    elevation = [np.arctan2(each[:, 2], np.hypot(each[:, 0], each[:, 1])) for each in (points, moved)]
    azimuth = [np.arctan2(each[:, 1], each[:, 0]) for each in (points, moved)]
    assert np.allclose(elevation[1] - elevation[0], 0.01) and np.allclose(*azimuth)
    assert np.allclose(np.linalg.norm(points, axis=1), np.linalg.norm(moved, axis=1))


def test_only_the_points_of_the_scans_own_lidar_are_raised():
    points, calibration = (
        np.random.default_rng(0).uniform(-9.0, 9.0, (30, 3)),
        ElevationCalibration(is_wanted=True),
    )
    calibration.offset_rad = 0.004
    spans = RaySpan(np.zeros(3), 20), RaySpan(np.ones(3), 10)
    corrected = calibration.corrected(Sweep(points, np.empty(0), 0.0, spans)).points
    np.testing.assert_array_equal(corrected, [*raised(points[:20], 0.004), *points[20:]])


def test_points_in_planes_are_those_of_flat_cells_that_three_scans_see():
    rng = np.random.default_rng(5)
    points, number = np.concatenate([seen(T, rng, 400) for T in POSES]), np.repeat(np.arange(8), 1200)
    n = len(points)
    beside, normals, residual, plane = np.zeros((n, 3)), np.zeros((n, 3)), np.zeros(n), np.empty(n, np.int32)
    count = planes(points, number, POSES, 2.0, beside, residual, plane, normals)
    world = np.einsum("nij,nj->ni", POSES[number, :3, :3], points) + POSES[number, :3, 3]
    wanted = naive.flat_cells(world - POSES[0, :3, 3], number, 2.0)
    assert count == len(wanted) > 20
    for p, (members, normal) in enumerate(wanted):
        assert np.array_equal(np.flatnonzero(plane == p), members)
        assert abs(normals[p] @ normal) == pytest.approx(1.0, abs=1e-6)
        assert np.allclose(beside[members], world[members] - world[members].mean(axis=0), atol=1e-9)
        assert np.allclose(residual[members], beside[members] @ normals[p])


def calibrated(poses, offset_deg, rng, *, is_wanted=True, points=3000):
    """A calibration that took scans from these poses, and how often it asked for another map."""
    calibration, rebuilt = ElevationCalibration(is_wanted=is_wanted), 0
    for T in poses:
        cloud = raised(seen(T, rng, points), -math.radians(offset_deg))
        rebuilt += bool(calibration.update(raised(cloud, calibration.offset_rad), T))
    return calibration, rebuilt


def drive(scans):
    return np.stack([lie.exp(np.array([1.0 * k, 0.05 * k, 0.0, 0.0, 0.005 * k, 0.01 * k])) for k in range(scans)])


@pytest.mark.parametrize(("is_wanted", "poses"), [(False, drive(30)), (True, np.repeat(drive(1), 30, axis=0))])
def test_nothing_is_estimated_where_unwanted_or_at_rest(is_wanted, poses):
    calibration, rebuilt = calibrated(poses, 0.3, np.random.default_rng(2), is_wanted=is_wanted, points=300)
    assert calibration.offset_rad == 0.0 and calibration.sigma_rad == math.inf and not rebuilt


def test_an_offset_is_refined_as_the_lidar_moves_on_with_a_map_built_anew_but_once_and_none_is_known_to_be_none():
    sigma_deg = {}
    for scans, offset_deg in ((20, -0.2), (60, -0.2), (60, 0.0)):
        calibration, rebuilt = calibrated(drive(scans), offset_deg, np.random.default_rng(3))
        assert math.degrees(calibration.offset_rad) == pytest.approx(offset_deg, abs=0.02 if offset_deg else 0.0)
        assert rebuilt == (offset_deg != 0.0)
        sigma_deg[scans, offset_deg] = math.degrees(calibration.sigma_rad)
    assert sigma_deg[60, -0.2] < 0.6 * sigma_deg[20, -0.2] < 0.015 and sigma_deg[60, 0.0] < 0.015


def test_windows_that_contradict_each_other_say_so_in_the_deviation():
    alike, apart = (_combined(np.radians([[0.2, 0.002], [second, 0.002]])) for second in (0.2, 0.4))
    assert apart[1] > 3.0 * alike[1]
    poor = _combined(np.radians([[0.2, 0.002], [-0.9, 0.2]]))
    assert math.degrees(poor[0]) == pytest.approx(0.2, abs=0.01)


def test_a_few_flat_points_give_no_offset():
    rng = np.random.default_rng(3)
    for scans in ([seen(T, rng, 2) for T in POSES], [np.zeros((50, 3))] * 8, [np.empty((0, 3))] * 8):
        assert adjusted(scans, POSES).sigma_rad > math.radians(0.1)


def pitch_per_meter(poses, truth):
    """Mean size of the pitch error over 20 scans, rad/m."""
    first, last = np.arange(10, len(poses) - 20), np.arange(30, len(poses))
    motion, true = lie.between(poses[first], poses[last]), lie.between(truth[first], truth[last])
    error = lie.log(lie.between(true, motion))
    return np.mean(np.abs(error[:, 4]) / np.linalg.norm(true[:, :3, 3], axis=1))


def driven(scans, changes=None, T_base_lidar=None):
    odometry = Odometry(configured(3, changes), T_base_lidar)
    return np.array([odometry.process(scan).T_odom_lidar for scan in scans]), odometry


def test_the_vertical_angles_of_kitti_are_corrected_and_its_pitch_drifts_less():
    scans, error = kitti_scans(54), {}
    truth = read_tum(shared_data("3d/kitti_0001_first54.tum")).poses
    for is_wanted in (False, True):
        poses, odometry = driven(scans, {"preprocess.calibrate_elevation": is_wanted})
        error[is_wanted] = pitch_per_meter(poses, truth)
    assert math.degrees(odometry.elevation.offset_rad) == pytest.approx(0.2, abs=0.03)  # its readers take 0.205
    assert 0 < odometry.calibrated_from < 20
    assert error[True] < 0.5 * error[False]


def test_the_offset_does_not_depend_on_the_voxels_of_the_map():
    _, odometry = driven(kitti_scans(28), {"local_map.voxel_size_m": 0.5, "preprocess.map_voxel_m": 0.25})
    assert math.degrees(odometry.elevation.offset_rad) == pytest.approx(0.2, abs=0.03)


@pytest.mark.parametrize("offset_deg", [-0.1, 0.3])
def test_the_offset_is_found_on_a_straight_fast_road(offset_deg):
    log = open_log(made.log("highway", seconds=4, sensor="os1-32"))
    scans = [
        replace(scan, points=raised(scan.points.astype(float), -math.radians(offset_deg)).astype(np.float32))
        for scan in log.scans()
    ]
    _, odometry = driven(scans, T_base_lidar=log.T_base_lidar)
    assert math.degrees(odometry.elevation.offset_rad) == pytest.approx(offset_deg, abs=0.03)
