"""Predicted poses: at constant velocity, over gaps, and how far off they may be."""

from dataclasses import replace

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Scan, State
from scanchain.odometry.odometry import first_match
from scanchain.odometry.prediction import Predictor, Source
from scanchain.preprocess import sweep_of
from tests.support.drives import NO_WHEELS
from tests.support.scenes import configured


def at(x_m, dimension):
    T = lie.identity(dimension)
    T[0, -1] = x_m
    return T


def predicted(dimension, position, times_s, wheels=None, lost=()):
    """The predictor after scans at x(t), which matches give exactly, and its prediction for the last of them.

    wheels : readings x(t) of the wheels, where there are any; lost : numbers of scans that are lost
    """
    config = configured(dimension)
    predictor = Predictor(config.odometry, lie.identity(dimension), is_mounted=True)
    for index, time_s in enumerate(times_s):
        T_odom_base = None if wheels is None else at(wheels(time_s), dimension)
        scan = Scan.of(np.empty((0, dimension)), time_s, index=index, T_odom_base=T_odom_base)
        scan = replace(scan, log_time_ns=scan.stamp_ns)
        prediction = predictor.predict(scan, sweep_of(scan, config.preprocess))
        if index + 1 < len(times_s):
            match = first_match(at(position(time_s), dimension), np.zeros((1000, dimension)), config.matching)
            predictor.correct(scan, prediction, match, State.LOST if index in lost else State.OK)
    return predictor, prediction


EVENLY_S = 0.1 * np.arange(21)


def evenly(time_s):
    return 2.0 * time_s


def test_at_constant_velocity_the_next_pose_is_predicted_and_known_ever_better(dimension):
    sigmas_m = []
    for count in (3, 8, 21):
        _, found = predicted(dimension, evenly, EVENLY_S[:count])
        assert found.source is Source.CONSTANT_VELOCITY and not found.is_guess and found.jump_m == 0.0
        np.testing.assert_allclose(found.T_odom_lidar, at(evenly(EVENLY_S[count - 1]), dimension), atol=1e-3)
        sigmas_m.append(np.sqrt(found.prior.covariance[0, 0]))
    assert sigmas_m[0] > sigmas_m[1] > sigmas_m[2] and sigmas_m[2] < 0.1 * found.prior.widest[0]


@pytest.mark.parametrize("gap_s", [0.7, 3.0])
def test_over_a_gap_the_motion_continues_as_a_guess_with_a_stop_among_the_other_poses(dimension, gap_s):
    _, found = predicted(dimension, evenly, [*EVENLY_S, 2.0 + gap_s])
    assert found.is_guess and found.interval_s == pytest.approx(gap_s)
    np.testing.assert_allclose(found.T_odom_lidar, at(4.0 + 2.0 * gap_s, dimension), atol=1e-6)
    assert np.sqrt(found.prior.covariance[0, 0]) == pytest.approx(found.prior.widest[0])
    _, after = predicted(dimension, evenly, [*EVENLY_S, 2.0 + gap_s, 2.1 + gap_s])
    np.testing.assert_allclose(after.T_odom_lidar, at(evenly(2.1 + gap_s), dimension), atol=1e-6)
    others_m = sorted(T[0, -1] for T in found.alternatives())
    assert others_m == pytest.approx(4.0 + 2.0 * np.sort([0.0, 0.1, 0.5 * gap_s, gap_s, 1.5 * gap_s]))


def test_windows_grow_with_the_time_up_to_their_limits(dimension):
    windows = [predicted(dimension, evenly, [*EVENLY_S, 2.0 + s])[1].windows() for s in (0.1, 0.3, 0.7, 3.0, 9.0)]
    widest = [np.max(each, axis=0) for each in windows]
    assert (np.diff(widest, axis=0) >= 0.0).all() and widest[-1][1] == np.pi
    if dimension == 2:
        assert widest[0].tolist() == [0.3, 0.3] and widest[-2].tolist() == pytest.approx([4.5, np.pi])
        assert widest[-1][0] == 5.0
    else:
        (by_acceleration_m, _), (by_speed_m, _) = windows[0]
        assert (by_acceleration_m, by_speed_m) == pytest.approx((1.0, 4.0))
        assert [len(each) for each in windows] == [2, 2, 1, 1, 1] and widest[-1][0] == 30.0


def test_lost_scans_continue_the_motion_in_wider_windows_and_cannot_refute_wheels(dimension):
    sound, found = predicted(dimension, evenly, EVENLY_S)
    doubtful, after_lost = predicted(dimension, evenly, EVENLY_S, lost=range(12, 20))
    np.testing.assert_allclose(after_lost.T_odom_lidar, at(evenly(2.0), dimension), atol=1e-3)
    assert (found.lost_s, after_lost.lost_s) == (0.0, pytest.approx(0.8))
    assert np.min(after_lost.windows()) > np.min(found.windows())
    jumped, _ = predicted(dimension, lambda time_s: evenly(time_s) + 1.5 * (time_s > 1.85), EVENLY_S)
    assert [each.doubts_scans for each in (sound, doubtful, jumped)] == [False, True, True]


def test_in_a_burst_of_stamps_a_velocity_is_computed_with_the_usual_interval():
    _, found = predicted(3, evenly, [*EVENLY_S, 2.001])
    assert found.interval_s == pytest.approx(0.001)
    twist = found.scan_motion_by(np.array([0.2, 0.0, 0.0, 0.0, 0.0, 0.0])).twist
    np.testing.assert_allclose(twist, [2.0, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-6)


@pytest.mark.parametrize("before_s", [0.1, 0.06, 0.19, 0.04])
def test_the_motion_during_a_scan_is_the_velocity_at_its_stamp_where_intervals_are_even_enough(before_s):
    def position(time_s):
        return 3.0 * time_s + time_s**2

    _, found = predicted(3, position, [0.9 - before_s, 1.0 - before_s, 1.0, 1.1])
    way_m = position(1.1) - position(1.0)
    speed_m_s = 3.0 + 2.0 * 1.1 if before_s > 0.05 else way_m / 0.1
    twist = found.scan_motion_by(lie.log(at(way_m, 3))).twist
    np.testing.assert_allclose(twist, [speed_m_s, 0.0, 0.0, 0.0, 0.0, 0.0], atol=1e-9)


def test_the_error_of_deskewing_is_the_mean_distance_of_points_at_the_acceleration():
    acceleration_m_s2, duration_s = 4.0, 0.1

    def position(time_s):
        return 5.0 * time_s + 0.5 * acceleration_m_s2 * time_s**2

    _, found = predicted(3, position, [0.0, 0.1, 0.2, 0.3])
    since_middle_s = np.linspace(-0.5, 0.5, 10_001) * duration_s
    mean_m = np.mean(0.5 * acceleration_m_s2 * since_middle_s**2)
    error = found.deskewing_error(at(position(0.3), 3), duration_s)
    np.testing.assert_allclose(error, [mean_m, 0.0, 0.0, 0.0, 0.0, 0.0], rtol=1e-3, atol=1e-9)


@pytest.mark.parametrize(("off_m", "jump_m"), [(0.0, 0.0), (0.5, 0.0), (3.0, 3.0)])
def test_wheels_predict_the_motion_that_they_measure_and_a_jump_of_theirs_is_told(dimension, off_m, jump_m):
    predictor, found = predicted(
        dimension, evenly, EVENLY_S, lambda time_s: 7.0 + evenly(time_s) + off_m * (time_s == EVENLY_S[-1])
    )
    assert found.source is Source.WHEELS and found.prior.is_measured
    assert found.T_odom_lidar[0, -1] == pytest.approx(4.0 + off_m, abs=1e-6)
    assert found.jump_m == pytest.approx(jump_m, abs=1e-3)
    scan = Scan.of(np.empty((0, dimension)), 2.0, index=20)
    again = predictor.predict(scan, sweep_of(scan, configured(dimension).preprocess), by_wheels=False)
    assert again.source is Source.CONSTANT_VELOCITY and not again.prior.is_measured


@pytest.mark.parametrize(("off_m", "least", "most"), [(0.0, 0.0, 0.1), (0.1, 2.0, 100.0)])
def test_wheels_that_contradict_a_match_have_a_large_innovation(dimension, off_m, least, most):
    last_s = EVENLY_S[-2]  # that is matched
    predictor, _ = predicted(
        dimension, evenly, EVENLY_S, lambda time_s: evenly(time_s) + off_m * (time_s == last_s)
    )
    assert least <= predictor.innovations["wheels"] < most
    predictor, _ = predicted(dimension, evenly, EVENLY_S)
    assert np.isnan(list(predictor.innovations.values())).all()


@pytest.mark.parametrize(
    ("is_kept", "changes", "limit_m"),
    [
        (lambda index: True, None, 0.01),
        (lambda index: index >= 40, None, 0.02),  # it starts at speed
        (lambda index: not 30 <= index < 40, None, 0.05),
        (lambda index: not 40 <= index < 52, NO_WHEELS, 0.05),
    ],
)
def test_six_seconds_in_town_with_gaps_or_none_drift_by_centimeters(town_drive, is_kept, changes, limit_m):
    kept = [scan for scan in town_drive.scans if is_kept(scan.index)]
    assert town_drive.error_m(town_drive.tracked(kept, changes)) < limit_m
