"""The front end: keyframes, and how certain the motion since the last one is."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Prior, State
from scanchain.logs import open_log
from scanchain.odometry import FrontEnd
from scanchain.odometry.front_end import KeyframeErrorTracker
from scanchain.odometry.odometry import Tracked, first_match
from scanchain.settings import load_settings
from scanchain.slam import Slam
from tests.benchmarks.harness import ate_m
from tests.support import made
from tests.support.scenes import configured


def test_a_covered_lidar_is_lost_and_found_again_and_closures_can_bend_the_edge_over_it(town_drive):
    slam, scans = Slam(configured(3), town_drive.T_base_lidar), [*town_drive.scans]
    scans[30:33] = [replace(scan, points=0.001 * scan.points) for scan in scans[30:33]]
    steps = [slam.process(scan) for scan in scans]
    assert [step.state for step in steps[29:34]] == [State.OK, *[State.LOST] * 3, State.OK]
    assert "preprocess.min_range_m (0.5)" in steps[31].reason
    result = slam.finish()
    assert ate_m(result.odometry, town_drive.truth) < 0.05
    after = next(keyframe.index for keyframe in result.keyframes if keyframe.scan_index >= 33)
    sigma_m = [np.sqrt(np.linalg.inv(information)[0, 0]) for information in result.graph.information]
    assert sigma_m[after - 1] > 0.5 and max(sigma_m[: after - 1] + sigma_m[after:]) < 0.1


def tracked_at(T, config, state=State.OK, **of_match):
    """A scan without points, as odometry has it at this pose."""
    d, k = len(T) - 1, lie.twist_size(T)
    match = replace(first_match(T, np.zeros((9, d)), config.matching), **of_match)
    prior = Prior(T, 1e-4 * np.eye(k), np.ones(k))
    return Tracked(None, np.empty((0, d)), np.empty((0, d)), T, match, state, "", prior, 0.0, 0.0, 0.0)


def test_a_keyframe_is_made_where_the_lidar_moved_or_turned_enough_and_was_not_lost(dimension):
    config, rng = configured(dimension), np.random.default_rng(0)
    limit_m, limit_rad = config.odometry.keyframe_distance_m, config.odometry.keyframe_angle_rad
    front_end, T, T_last, reasons = FrontEnd(config, np.eye(dimension + 1)), lie.identity(dimension), None, set()
    sigma = lie.by_component(lie.twist_size(T), limit_m, limit_rad) / 3.0
    for _ in range(400):
        T = T @ lie.exp(sigma * rng.normal(size=len(sigma)))
        tracked = tracked_at(T, config, State.LOST if rng.random() < 0.5 else State.OK)
        front_end.odometry.process = lambda scan, tracked=tracked: tracked
        located = front_end.locate(None)
        moved_m, turned_rad = (np.inf, 0.0) if T_last is None else lie.apart(T_last, T)
        is_far = moved_m > limit_m or turned_rad > limit_rad
        assert located.is_keyframe == (T_last is None or (is_far and tracked.state is State.OK))
        assert located.information.any() == located.is_keyframe
        reasons.add((bool(moved_m > limit_m), bool(turned_rad > limit_rad), tracked.state))
        T_last = T if located.is_keyframe else T_last
    assert len(reasons) == 8


def test_errors_at_a_keyframe_are_the_mean_of_fitting_scans_and_the_share_of_the_map_that_is_new(dimension):
    config, k = configured(dimension), 3 if dimension == 2 else 6
    tracker = KeyframeErrorTracker(k)
    for value, of_match, state in (
        (1.0, {}, State.OK),
        (9.0, {"fit": 0.1}, State.OK),
        (3.0, {}, State.OK),
        (9.0, {"observability": 0.5}, State.DEGENERATE),
        (9.0, {}, State.LOST),
        (5.0, {}, State.OK),
    ):
        T = lie.identity(dimension)
        tracker.update(tracked_at(T, config, state, systematic=value * np.eye(k), **of_match))
    T[0, -1] = 0.8
    points = 4.0 * np.eye(dimension)  # all 4 m away
    here = msgspec.structs.replace(tracked_at(T, config, variance_factor=2.5), matched=points)
    first, second = (tracker.at_keyframe(here, lie.identity(dimension)) for _ in range(2))
    np.testing.assert_allclose(first.systematic, 3.0 * np.eye(k))
    assert (first.renewal, second.renewal) == (1.0, pytest.approx(0.2))  # a pose before the first was undetermined
    turned = msgspec.structs.replace(here, T_odom_lidar=lie.exp(np.eye(k)[-1] * 0.3 * np.pi))
    assert tracker.at_keyframe(turned, lie.identity(dimension)).renewal == pytest.approx(0.3)
    assert first.variance_factor == 2.5


def covariances(dimension, information, scans, gained=None):
    """Of the motion since the keyframe, after scans 0.1 m apart: (fit, whether it is measured, state, error)."""
    front_end = FrontEnd(configured(dimension, {"odometry.keyframe_distance_m": 100.0}), np.eye(dimension + 1))
    nothing, k, told = np.empty((0, dimension)), len(information), []
    for index, (fit, is_measured, state, off) in enumerate(scans):
        T = lie.pose_2d(0.1 * index, 0.0, 0.0)
        T = T if dimension == 2 else lie.lift(T)
        prior = Prior(T @ lie.exp(off), 1e-4 * np.eye(k), np.ones(k), is_measured)
        match = first_match(T, np.zeros((9, dimension)), configured(dimension).matching)
        match = replace(match, information=information, fit=fit)
        tracked = Tracked(None, nothing, nothing, T, match, state, "", prior, 0.0, 0.0, 0.0, gained)
        front_end.odometry.process = lambda scan, tracked=tracked: tracked
        front_end.locate(None)
        told.append(np.linalg.inv(front_end.information + 1e-9 * np.eye(k)))
    return np.array(told)


def test_where_scans_see_nothing_along_uncertainty_grows_over_those_without_a_wheel_reading_too():
    def sigmas_m(is_read):
        scans = [(1.0, each, State.DEGENERATE, np.zeros(3)) for each in is_read]
        return np.sqrt(covariances(2, np.diag([0.0, 1e6, 1e6]), scans)[:, 0, 0])

    scan = np.arange(24)
    whole, holed, without = (
        sigmas_m(read) for read in (scan > 0, (scan > 0) & ((scan < 5) | (scan > 14)), scan == 9)
    )
    assert np.allclose(whole[1:], 0.01 * scan[1:], rtol=1e-3) and np.allclose(holed, whole)
    assert (without > 1e4).all()  # what came before the first reading is unknown up to the next keyframe


def test_where_scans_see_nothing_along_uncertainty_grows_by_what_the_filter_of_the_imu_gains():
    scans = [(1.0, index > 0, State.DEGENERATE, np.zeros(6)) for index in range(9)]
    information = np.diag([0.0, 1e6, 1e6, 1e6, 1e6, 1e6])
    found = covariances(3, information, scans, gained=1e-6 * np.eye(6))[1:, 0, 0]
    assert np.allclose(found, 1e-6 * np.arange(1, 9), rtol=2e-2)  # prior.covariance, of the position, is 1e-4


@pytest.mark.parametrize("is_measured", [True, False])
def test_a_motion_over_a_scan_that_correspondences_contradict_is_known_as_predicted(is_measured):
    off = np.array([0.0, 0.4, 0.0, 0.0, 0.0, 0.1])
    scans = [(fit, is_measured, State.OK, off) for fit in (1.0, 1.0, 0.5, 1.0)]
    sigmas = np.sqrt(np.diagonal(covariances(3, 1e6 * np.eye(6), scans), axis1=1, axis2=2))
    assert np.all(sigmas[:2] <= 1e-3 * (1.0 + 1e-9))
    assert np.allclose(sigmas[2:], np.hypot(np.abs(off), 0.01), atol=0.02) and sigmas[3, 0] > 0.009


def test_noise_within_what_is_assumed_changes_nothing():
    scans = list(open_log(made.log("office", seconds=3, noise_m=0.02)).scans())
    front_end = FrontEnd(load_settings(2).config, None, 2)
    located = [front_end.locate(scan) for scan in scans]
    assert front_end.odometry.resolution.noise.sigma_m == pytest.approx(0.02, rel=0.1)
    assert {each.noise_m for each in located} == {0.0}
    assert front_end.odometry.local_map.voxels.size_m == 0.1
