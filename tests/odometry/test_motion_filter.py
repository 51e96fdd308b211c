"""The motion filter is the Kalman filter of pose and motion; a pose that is off does not throw the motion."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.odometry.motion_filter import MotionFilter


def textbook(any_motion, noise, measurements, information):
    """Motion and its covariance after poses measured (N,) in one dimension, by the joint filter of both."""
    state, P = np.zeros(2), np.diag([0.0, any_motion])
    F, H, R = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[1.0, 0.0]]), 1.0 / information
    for z in measurements:
        state = F @ state
        P = F @ (P + np.diag([0.0, noise])) @ F.T
        K = P @ H.T / (H @ P @ H.T + R)
        state = state + (K * (z - state[0])).ravel()
        P = P - K @ H @ P
    return state, P


@pytest.mark.parametrize("d", [2, 3])
def test_along_a_line_it_is_the_kalman_filter_of_pose_and_motion(d):
    k = 3 if d == 2 else 6
    rng = np.random.default_rng(0)
    places = np.cumsum(np.full(8, 0.4)) + 0.05 * rng.normal(size=8)
    noise, information = 0.01, 1.0 / 0.05**2
    state, P = textbook(0.25, noise, places, information)
    found, x = MotionFilter(0.25 * np.eye(k)), 0.0
    for place in places:
        x += found.motion[0, -1]
        surprise = np.zeros(k)
        surprise[0] = place - x
        found.correct(surprise, information * np.eye(k), noise * np.eye(k))
        x += (found.pose_covariance * information)[0, 0] * surprise[0]
    assert found.motion[0, -1] == pytest.approx(state[1], abs=1e-12)
    assert found.motion_covariance[0, 0] == pytest.approx(P[1, 1], abs=1e-12)
    assert found.covariance[0, 0] == pytest.approx(P[0, 1], abs=1e-12)
    assert found.pose_covariance[0, 0] == pytest.approx(P[0, 0], abs=1e-12)


def test_a_pose_that_is_off_once_does_not_throw_the_motion():
    """At 2.5 m/s and 10 Hz, by matches good to 1 cm, one of which is 3 cm off."""
    found, noise, information = MotionFilter(0.25 * np.eye(6)), 1e-5 * np.eye(6), 1e4 * np.eye(6)
    along = np.eye(6)[0]
    found.correct(0.25 * along, information, noise)
    for off in [0.0] * 10 + [0.03, -0.03, 0.0, 0.0]:
        found.correct(off * along, information, noise)
    assert abs(found.motion[0, 3] - 0.25) < 0.01


def test_along_a_direction_that_nothing_tells_of_the_motion_goes_on_and_its_doubt_grows():
    found, noise = MotionFilter(0.25 * np.eye(6)), 1e-4 * np.eye(6)
    blind = np.diag([0.0, 1.0, 1.0, 1.0, 1.0, 1.0]) * 1e4
    found.correct(np.array([0.25, 0.0, 0.0, 0.0, 0.0, 0.0]), 1e4 * np.eye(6), noise)
    before = found.motion_covariance.copy()
    for _ in range(20):
        found.correct(np.zeros(6), blind, noise)
    assert found.motion[0, 3] == pytest.approx(0.25, abs=1e-4)
    assert found.motion_covariance[0, 0] == pytest.approx(before[0, 0] + 20 * 1e-4, rel=1e-6)
    assert found.motion_covariance[1, 1] < 5e-4
    assert found.predicted(noise)[0][0, 0] > 20.0 * before[0, 0]


def test_a_turn_carries_what_is_wrong_with_the_pose_along():
    """A heading that is in doubt puts the next position in doubt, to the side of a motion."""
    found = MotionFilter(1e-12 * np.eye(3))
    found.begin(lie.pose_2d(2.0, 0.0, 0.0))
    found.pose_covariance = np.diag([0.0, 0.0, 0.01])
    assert found.predicted(np.zeros(3))[0][1, 1] == pytest.approx(4.0 * 0.01, rel=1e-3)


@pytest.mark.parametrize("d", [2, 3])
def test_a_measured_rotation_replaces_that_of_the_motion_and_leaves_its_translation_as_it_was(d):
    k = 3 if d == 2 else 6
    found = MotionFilter(0.25 * np.eye(k))
    found.correct(0.2 * np.ones(k), 1e4 * np.eye(k), 1e-4 * np.eye(k))
    before, covariance = lie.log(found.motion)[:d], found.motion_covariance[:d, :d].copy()
    rotation = np.array([0.1, -0.2, 0.3])[-(k - d) :]
    found.turn(rotation)
    np.testing.assert_allclose(lie.log(found.motion), [*before, *rotation], atol=1e-12)
    np.testing.assert_array_equal(found.motion_covariance[:d, :d], covariance)
    assert not found.motion_covariance[d:].any() and not found.covariance[:, d:].any()
