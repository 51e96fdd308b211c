"""Hand-eye calibration: the mounting by the motions of base and lidar, and what they do not show."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.registration.hand_eye import MountingEstimator, hand_eye

NOISE_M, NOISE_RAD = 0.005, 0.002


def solved(lidar, wheels):
    """The mounting by motions over ten scans."""
    return hand_eye(*(lie.between(each[:-10:10], each[10::10]) for each in (wheels, lidar)))


def mounted(yaw_deg, x, y, dimension=2, *, roll_deg=0.0, pitch_deg=0.0):
    T = lie.exp(np.array([0.0, 0, 0, 0, 0, np.radians(yaw_deg)]))
    T = (
        T
        @ lie.exp(np.array([0.0, 0, 0, 0, np.radians(pitch_deg), 0]))
        @ lie.exp(np.array([0.0, 0, 0, np.radians(roll_deg), 0, 0]))
    )
    T[:2, 3] = x, y
    return lie.flatten(T) if dimension == 2 else T


def driven(T_base_lidar, *, count=300, speed_m=0.05, turn_rad=0.03, scale=1.0, slips=(), seed=0):
    """Poses of lidar and base by wheels over a drive that turns to and fro; noise on both."""
    rng, d = np.random.default_rng(seed), T_base_lidar.shape[0] - 1
    k = 3 if d == 2 else 6
    base = wheels = lie.identity(d)
    lidar, told = [], []
    for n in range(count):
        twist = np.zeros(k)
        twist[0], twist[-1] = speed_m, turn_rad * np.sin(n / 25.0)
        base = base @ lie.exp(twist)
        twist[0] *= scale
        twist[1] = 0.3 if n in slips else 0.0
        wheels = wheels @ lie.exp(twist)
        noise = rng.normal(size=k) * lie.by_component(k, NOISE_M, NOISE_RAD)
        lidar.append(base @ T_base_lidar @ lie.exp(noise))
        told.append(wheels)
    return np.array(lidar), np.array(told)


@pytest.mark.parametrize(
    ("yaw_deg", "x", "y"), [(0, 0.0, 0.0), (37, 0.5, -0.2), (90, 0.0, 0.3), (180, -0.05, 0.0), (-120, 0.1, 0.1)]
)
@pytest.mark.parametrize(
    "faults", [{}, {"scale": 1.05}, {"slips": (100, 101, 180)}], ids=["good", "scale", "slips"]
)
@pytest.mark.parametrize("dimension", [2, 3])
def test_motions_show_yaw_and_place_whatever_scale_and_slips(dimension, yaw_deg, x, y, faults):
    T = mounted(yaw_deg, x, y, dimension)
    found = solved(*driven(T, **faults))
    yaw_rad = lie.wrap(lie.yaw(lie.inverse(T) @ found.T_base_lidar))
    assert abs(yaw_rad) < min(4.0 * found.sigma_rad, np.radians(1.0))
    assert np.linalg.norm((found.T_base_lidar - T)[:2, -1]) < min(5.0 * found.sigma_m, 0.03)
    assert found.sigma_m < 0.05 and not found.is_mirrored
    assert found.is_apart == (abs(yaw_deg) > 5 or np.hypot(x, y) > 0.2)


def test_standard_deviations_are_those_of_the_errors():
    T = mounted(37, 0.4, 0.1)
    found = [solved(*driven(T, seed=seed)) for seed in range(40)]
    yaw = [float(lie.yaw(lie.inverse(T) @ each.T_base_lidar)) / each.sigma_rad for each in found]
    place = [(each.T_base_lidar - T)[0, -1] / each.sigma_m for each in found]
    assert 0.2 < np.std(yaw) < 1.5 and 0.2 < np.std(place) < 1.5


def test_in_space_a_lidar_upside_down_is_so_and_level_is_assumed():
    T = mounted(40, 0.3, 0.1, 3, roll_deg=180.0)
    found = solved(*driven(T))
    assert lie.rotation_angle(lie.inverse(T) @ found.T_base_lidar) < np.radians(1.5)
    np.testing.assert_allclose(found.T_base_lidar[:2, 3], T[:2, 3], atol=0.03)
    assert "upside down, assumed level" in found.text


@pytest.mark.parametrize("dimension", [2, 3])
def test_a_straight_drive_shows_the_yaw_and_leaves_the_place_at_the_origin(dimension):
    lidar, wheels = driven(mounted(90, 0.3, 0.2, dimension), turn_rad=0.0)
    noise = np.random.default_rng(1).normal(0.0, 0.003, len(wheels))  # of the wheels' heading, whatever its sense
    for sign in (-1.0, 1.0):
        wobbling = wheels @ lie.exp(np.eye(lie.twist_size(wheels[0]))[-1] * sign * noise[:, None])
        assert not solved(lidar, wobbling).is_mirrored
    found = solved(lidar, wheels)
    assert found.sigma_m > 0.1
    np.testing.assert_array_equal(found.T_base_lidar[:-1, -1], 0.0)
    assert abs(float(lie.yaw(found.T_base_lidar)) - np.pi / 2) < 4.0 * found.sigma_rad
    assert "lidar turned by" in found.text and "its position is not observable: the log hardly turns" in found.text


@pytest.mark.parametrize("twist", [[0.05, 0.0, 0.02], [0.0, 0.0, 0.05]], ids=["one curve", "on the spot"])
def test_a_motion_that_several_mountings_explain_shows_none(twist):
    T, rng = mounted(50, 0.4, 0.0), np.random.default_rng(0)
    wheels = np.array([lie.exp(n * np.array(twist)) for n in range(300)])
    lidar = wheels @ T @ lie.exp(rng.normal(size=(300, 3)) * [NOISE_M, NOISE_M, NOISE_RAD])
    assert solved(lidar, wheels) is None


def test_a_planar_lidar_that_turns_against_the_base_is_mirrored():
    lidar, wheels = driven(mounted(0, 0.2, 0.0))
    mirror = np.diag([1.0, -1.0, 1.0])
    assert solved(mirror @ lidar @ mirror, wheels).is_mirrored


def test_rest_and_wheels_that_have_nothing_to_do_with_the_lidar_show_nothing():
    T = mounted(37, 0.4, 0.0)
    lidar, wheels = driven(T, speed_m=0.0, turn_rad=0.0)
    assert solved(lidar, wheels) is None
    lidar, _ = driven(T)
    rng = np.random.default_rng(0)
    assert solved(lidar, np.array([lie.exp(twist) for twist in rng.normal(size=(300, 3))])) is None
    assert solved(lidar, wheels[:40]) is None


def test_an_estimator_says_what_it_knows_and_goes_without_scans_whose_pose_is_open():
    lidar, wheels = driven(mounted(37, 0.4, 0.0))
    estimator = MountingEstimator(np.eye(3), is_stated=False)
    for n, (T_odom_lidar, T_odom_base) in enumerate(zip(lidar, wheels, strict=True)):
        is_open = n in (0, 50)
        wrong = T_odom_lidar @ lie.pose_2d(5.0, 0.0, 1.0)
        estimator.update(wrong if is_open else T_odom_lidar, T_odom_base, is_open=is_open)
        assert n > 60 or estimator.is_usable == (is_open or estimator.found is not None)
    assert estimator.is_usable
    note = estimator.finish()
    assert "mounting estimated from the wheels: lidar turned by 37." in note and "0.40 m ahead of the base" in note
    assert MountingEstimator(np.eye(3), is_stated=False).finish() == ""
