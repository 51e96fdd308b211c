"""Delay of the wheels' stamps: found from the motions of the scans, in blocks, where these show it."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.odometry.delay import WheelDelay, WheelPath, correlations

TIMES_S = np.arange(0.0, 60.0, 0.1)


def base_at(times_s, *, changes=True):
    """Poses of a base at changing speed, in curves or on a circle at one speed."""
    fine_s = np.arange(-2.0, 63.0, 0.01)
    speed = 1.0 + 0.5 * np.sin(0.8 * fine_s + np.sin(0.31 * fine_s)) * changes
    yaw = np.cumsum(0.4 * np.sin(0.5 * fine_s) * changes + 0.1 * (not changes)) * 0.01
    path = np.cumsum(speed * np.array([np.cos(yaw), np.sin(yaw)]), axis=1) * 0.01
    x, y, yaw = (np.interp(times_s, fine_s, each) for each in (*path, yaw))
    return np.stack([lie.pose_2d(*each) for each in zip(x, y, yaw, strict=True)])


def measured(delay_s, dimension=2, *, changes=True, jump_s=0.0, is_known=True):
    """The delay found where wheels of wrong scale report what was ``delay_s`` before, and stamps jump once."""
    rng, found = np.random.default_rng(0), WheelDelay()
    lidar, wheels = base_at(TIMES_S, changes=changes), base_at(TIMES_S - delay_s, changes=changes)
    wheels[:, :2, 2] *= 1.03
    if dimension == 3:
        lidar, wheels = lie.lift(lidar), lie.lift(wheels)
    lidar = lidar @ lie.exp(rng.normal(0.0, 2e-4, (len(lidar), lie.twist_size(lidar[0]))))
    for k, time_s in enumerate(TIMES_S):
        stamp_ns = round(1e9 * (time_s + jump_s * (k > 400)))
        found.update(stamp_ns, lidar[k], wheels[k], is_known=is_known)
    return found


@pytest.mark.parametrize("delay_s", [-0.3, 0.0, 0.2, 0.66])
def test_the_delay_is_that_at_which_the_motions_agree(dimension, delay_s):
    assert measured(delay_s, dimension).seconds == pytest.approx(delay_s, abs=0.021)
    assert measured(delay_s, dimension, jump_s=-7.0).seconds == pytest.approx(delay_s, abs=0.021)


def test_a_steady_motion_or_one_that_scans_do_not_determine_shows_no_delay():
    assert measured(0.66, changes=False).seconds == 0.0
    assert measured(0.66, is_known=False).seconds == 0.0
    assert WheelDelay().seconds == 0.0


def test_a_small_delay_is_none_and_parts_of_a_log_add_up():
    assert measured(0.06).seconds == 0.0
    parts = WheelDelay()
    for _ in range(2):
        parts.add(measured(0.2))
    np.testing.assert_allclose(parts.total, 2.0 * measured(0.2).total)
    assert parts.is_clear and not WheelDelay().is_clear


def test_stamps_that_are_all_the_same_show_no_delay():
    found, poses = WheelDelay(), base_at(TIMES_S)
    for pose in poses:
        found.update(0, pose, pose, is_known=True)
    assert found.seconds == 0.0 and not found.is_clear


def test_motions_within_the_largest_delay_of_the_ends_of_the_path_are_not_covered():
    path = WheelPath(TIMES_S, base_at(TIMES_S))
    ends_s = np.array([[0.5, 0.6], [1.5, 1.6], [58.8, 58.95], [58.8, 58.85]])
    assert path.covers(ends_s).tolist() == [False, True, False, True]


def test_correlations_are_those_of_the_known_values_and_without_half_of_them_minus_one():
    rng = np.random.default_rng(1)
    measured, by_scans = rng.normal(size=(3, 40)), rng.normal(size=40)
    known = np.ones((3, 40), bool)
    known[1, 25:], known[2, 15:] = False, False
    found = correlations(measured, by_scans, known)
    np.testing.assert_allclose(found[0], np.corrcoef(measured[0], by_scans)[0, 1])
    np.testing.assert_allclose(found[1], np.corrcoef(measured[1, :25], by_scans[:25])[0, 1])
    assert found[2] == -1.0
