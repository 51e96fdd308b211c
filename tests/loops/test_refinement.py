"""All scans at the end: corrected as their keyframes; in the plane, each aligned to the map of all keyframes."""

import numpy as np
import pytest

from scanchain import Slam, lie
from scanchain.data import Keyframe, Scan
from scanchain.kernels.registration.icp import refine
from scanchain.loops import refined, spread
from scanchain.point_store import PointStore
from scanchain.registration import VoxelMap
from scanchain.registration.plicp import settings_of
from tests.support import naive
from tests.support.scenes import configured

ANGLES = np.linspace(-3.0, 3.0, 240)


def seen_in_room(T, length_m=6.0, width_m=4.0, reach_m=np.inf):
    """Points (N, 2) that a lidar at a pose sees of the four walls of a room around the origin."""
    yaw = np.arctan2(T[1, 0], T[0, 0])
    c, s = np.cos(ANGLES + yaw), np.sin(ANGLES + yaw)
    x_m = (np.sign(c) * 0.5 * length_m - T[0, 2]) / c
    y_m = (np.sign(s) * 0.5 * width_m - T[1, 2]) / s
    ranges_m = np.minimum(x_m, y_m)
    seen = ranges_m < reach_m
    return (ranges_m[:, None] * np.column_stack([np.cos(ANGLES), np.sin(ANGLES)]))[seen]


def drive(**room):
    """Twenty true poses in a room, the points of their scans, and every fifth as a keyframe."""
    truth = np.array([lie.pose_2d(0.1 * k - 1.0, 0.03 * k, 0.05 * k) for k in range(20)])
    store = PointStore(2)
    stored = [store.add(seen_in_room(T, **room)) for T in truth]
    keyframes = [Keyframe(k // 5, k, k, stored[k], truth[k], 0.1 * k) for k in range(0, 20, 5)]
    return truth, [each.read() for each in stored], keyframes


def shaken(truth, sigma_m, sigma_rad, seed=0):
    """The poses, but for keyframes, off by so much."""
    noise = np.random.default_rng(seed).normal(size=(len(truth), 3)) * [sigma_m, sigma_m, sigma_rad]
    noise[::5] = 0.0
    return truth @ lie.exp(noise)


def error_m(poses, truth):
    return np.sqrt(np.mean((poses - truth)[:, :2, 2] ** 2))


def test_scans_share_the_corrections_of_the_keyframes_around_them_but_not_over_an_unknown_motion(dimension):
    rng, k = np.random.default_rng(0), 3 * dimension - 3
    odometry, keyframes = lie.exp(rng.normal(size=(20, k))), np.array([0, 5, 10, 17])
    ahead = np.eye(k)[0]
    more_m = np.array([0.0, 0.0, 0.5, 0.5])
    shifted = odometry[keyframes] @ lie.exp(more_m[:, None] * ahead)
    for starts, moved_m in (((), [0, 0, 0, 0, 0, 0, 0.1, 0.2, 0.3, 0.4]), ((2,), [0.0] * 10)):
        world = lie.exp(rng.normal(size=k))
        found = spread(world @ shifted, keyframes, odometry, starts)
        np.testing.assert_allclose(found[keyframes], world @ shifted, atol=1e-9)
        off_m = np.linalg.norm((lie.inverse(world) @ found - odometry)[:, :-1, -1], axis=1)
        np.testing.assert_allclose(off_m[:10], moved_m, atol=1e-9)
        after_last = [lie.between(each[17:18], each[17:]) for each in (found, odometry)]
        np.testing.assert_allclose(*after_last, atol=1e-9)


def test_scans_find_the_place_that_the_keyframes_give_them():
    truth, scans, keyframes = drive()
    poses = shaken(truth, 0.03, 0.005)
    after = refined(poses, scans.__getitem__, keyframes, poses[::5], configured(2))
    assert error_m(after, truth) < 0.3 * error_m(poses, truth)


def test_a_scan_stays_where_the_map_tells_nothing():
    truth, scans, keyframes = drive(length_m=100.0, reach_m=10.0)
    poses = truth.copy()
    poses[7] = truth[7] @ lie.pose_2d(0.0, 0.03, 0.0)
    poses[8] = lie.pose_2d(0.03, 0.0, 0.0) @ truth[8]
    after = refined(poses, scans.__getitem__, keyframes, poses[::5], configured(2))
    assert abs(after[7, 1, 2] - truth[7, 1, 2]) < 0.005
    assert abs(after[8, 0, 2] - poses[8, 0, 2]) < 0.5 * 0.03
    assert np.abs(after - poses)[:, 0, 2].max() < 0.025  # along the corridor, of any scan


def test_scans_are_aligned_in_coordinates_of_a_country_as_around_the_origin():
    truth, scans, keyframes = drive()
    poses, moved = shaken(truth, 0.03, 0.005), shaken(truth, 0.03, 0.005)
    moved[:, :2, 2] += (400_000.0, 5_400_000.0)
    found = [refined(each, scans.__getitem__, keyframes, each[::5], configured(2)) for each in (poses, moved)]
    np.testing.assert_allclose(found[1][:, :2, 2] - (400_000.0, 5_400_000.0), found[0][:, :2, 2], atol=1e-5)


def test_a_scan_without_points_or_far_from_everything_stays():
    truth, scans, keyframes = drive()
    scans[3] = np.empty((0, 2))
    poses = truth.copy()
    poses[4] = lie.pose_2d(50.0, 50.0, 1.0)
    after = refined(poses, scans.__getitem__, keyframes, poses[::5], configured(2))
    assert np.array_equal(after[3:5], poses[3:5])


@pytest.mark.parametrize("least_share", [0.3, 1.0])
def test_the_kernel_is_one_alignment_after_the_other(least_share):
    truth, scans, keyframes = drive()
    config = configured(2)
    surfaces = VoxelMap(2, config.local_map)
    for keyframe in keyframes:
        surfaces.insert(keyframe.points, truth[keyframe.scan_index])
    points, starts = np.concatenate(scans), np.cumsum([0, *map(len, scans)])
    prior, terms = np.diag([2.0, 2.0, 40.0]), settings_of(config.matching, surfaces, wide=False)
    fast = shaken(truth, 0.05, 0.02)
    slow = fast.copy()
    refine(surfaces.voxels, points, starts, fast, prior, least_share, terms)
    naive.refine(surfaces.voxels, points, starts, slow, prior, least_share, terms)
    np.testing.assert_allclose(fast, slow, atol=1e-9)
    assert (fast != shaken(truth, 0.05, 0.02)).any()


def test_the_first_scan_of_a_log_that_begins_at_speed_stays_at_the_origin():
    slam, times_s, velocity = Slam(dimension=2), 0.09 * np.arange(240) / 240, np.array([1.5, 0.0, 0.2])
    for k in range(12):
        T_world_beams = lie.pose_2d(-1.5, 0.2, 0.0) @ lie.exp((0.1 * k + times_s)[:, None] * velocity)
        beams = np.array([seen_in_room(T)[beam] for beam, T in enumerate(T_world_beams)], np.float32)
        slam.process(Scan.of(beams, 0.1 * k, times_s.astype(np.float32)))
    away_m, _ = lie.apart(np.eye(3), slam.finish().trajectory.poses[0])
    assert away_m < 0.01
