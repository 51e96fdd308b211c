"""The accelerometer: positions along its samples, gravity, faults, and the places where it helps."""

from dataclasses import replace

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.config import PreprocessConfig
from scanchain.data import GRAVITY_M_S2, Inertial, Scan
from scanchain.odometry.accelerometer import Accelerometer
from scanchain.odometry.gyro import Gyro
from scanchain.odometry.odometry import first_match
from scanchain.preprocess import sweep_of
from scanchain.settings import load_settings
from tests.benchmarks.imu import driven
from tests.support import made

SCAN_S, SAMPLE_S = 0.1, 0.005
BIAS = np.array([0.03, -0.02, 0.04])
T_LIDAR_IMU = lie.exp(np.array([0.1, -0.2, 0.3, 0.0, 0.0, 0.5]))
TILT = lie.exp(np.array([0.0, 0.0, 0.0, 0.05, -0.1, 0.0]))  # of the odometry frame
UP = np.array([0.0, 0.0, 1.0])


def lidar_at(times_s):
    """Poses (N, 4, 4) in the tilted odometry frame of a lidar that winds and speeds up and down."""
    turns = np.multiply.outer(0.8 * np.sin(0.9 * times_s), np.array([0.1, 0.0, 1.0]))
    poses = lie.exp(np.hstack([np.zeros((len(times_s), 3)), turns]))
    poses[:, :3, 3] = np.stack([3.0 * times_s, 2.0 * np.sin(0.7 * times_s), 0.2 * np.cos(times_s)], axis=1)
    return TILT @ poses


def samples_at(times_s, unit, step_s=1e-3):
    """Rates and specific forces (N, 3) of the IMU, by central differences."""
    before, now, after = (lidar_at(times_s + each) @ T_LIDAR_IMU for each in (-step_s, 0.0, step_s))
    rates = lie.log(lie.inverse(before) @ after)[:, 3:] / (2.0 * step_s)
    forces = (before - 2.0 * now + after)[:, :3, 3] / step_s**2 + GRAVITY_M_S2 * TILT[:3, :3] @ UP
    return rates, (np.einsum("nji,nj->ni", now[:, :3, :3], forces) + BIAS) / unit


def drive(scans, *, blind=0, unit=1.0, gravity=True, noise_m=0.002, corridor=None):
    """An accelerometer after these scans, the last ``blind`` of them lost, and the errors of its positions.

    From the scan ``corridor`` on, matches leave a direction open, which they take for slightly different ones.
    """
    random, gyro, accelerometer, errors = np.random.default_rng(0), Gyro(3), Accelerometer(), []
    T_last = before = lidar_at(np.zeros(1))[0]
    for k in range(scans):
        stamps_s = SCAN_S * (k - 1) + SAMPLE_S * np.arange(1, 2 + SCAN_S / SAMPLE_S)
        rates, forces = samples_at(stamps_s, unit)
        if not gravity:
            forces = forces - forces.mean(axis=0)
        inertial = Inertial(np.round(1e9 * stamps_s).astype(np.int64) + 10**18, rates, forces, T_LIDAR_IMU)
        scan = Scan.of(np.eye(3), 1e9 + SCAN_S * k, index=k, inertial=inertial)
        gyro.add(scan)
        gyro.predict(scan, sweep_of(scan, PreprocessConfig()))
        accelerometer.predict(T_last, gyro)
        T = lidar_at(np.array([SCAN_S * k]))[0]
        errors.append(float(np.linalg.norm(accelerometer.position - T[:3, 3])))
        if k >= scans - blind:
            match, T = None, T.copy()
            T[:3, 3] = accelerometer.position
        else:
            T[:3, 3] += noise_m * random.normal(size=3)
            match = first_match(T, np.ones((100, 3)), load_settings(3).config.matching)
        if corridor is not None and k >= corridor:
            T[0, 3] = accelerometer.position[0]
            open_ = T[:3, :3].T @ lie.exp(np.concatenate([np.zeros(3), 0.005 * random.normal(size=3)]))[:3, 0]
            information = np.eye(6)
            information[:3, :3] -= np.outer(open_, open_)
            match = replace(match, information=1e6 * information, observability=0.1)
        gyro.correct(lie.between(T_last, T) if k else None)
        accelerometer.correct(T, match, (T_last @ lie.between(before, T_last))[:3, 3])
        before, T_last = T_last, T
    return accelerometer, np.array(errors)


def test_it_predicts_positions_and_finds_velocity_and_gravity():
    accelerometer, errors = drive(60)
    assert errors[20:].max() < 0.01
    assert accelerometer.is_used
    assert 0.1 < accelerometer.innovation < 3.0
    gravity = accelerometer.x[6:9]
    assert np.degrees(np.arccos(-gravity @ TILT[:3, :3] @ UP / np.linalg.norm(gravity))) < 0.2
    assert "IMU: its accelerometer predicts the translation of 72 % of the scans, to 0.00" in accelerometer.note()


def test_where_scans_are_lost_it_continues_the_motion_for_seconds():
    accelerometer, errors = drive(80, blind=20)
    assert errors[-20:].max() < 0.15  # of 6 m, and 2 s on a curve
    assert np.isnan(accelerometer.innovation)
    assert np.trace(accelerometer.covariance) ** 0.5 > errors[-1] / 3.0  # and says how far off it may be


def test_a_direction_that_scans_leave_open_is_not_measured_by_their_noise_across_it():
    accelerometer, errors = drive(200, corridor=30)
    assert errors[-1] < np.sqrt(accelerometer.P[0, 0]) < 2.0  # of 60 m; if it were measured 1.2 m off, and 0.1 m


def test_accelerations_in_g_are_converted_and_such_without_gravity_not_used():
    accelerometer, errors = drive(60, unit=GRAVITY_M_S2)
    assert errors[20:].max() < 0.01
    assert accelerometer.warnings() == ("IMU: its accelerations are in g: converted",)
    accelerometer, _ = drive(60, gravity=False)
    assert not accelerometer.is_used
    assert "do not hold gravity" in accelerometer.warnings()[0]


def test_one_of_the_wrong_sign_is_not_used():
    accelerometer, _ = drive(60, unit=-1.0)
    assert not accelerometer.is_used


@pytest.mark.parametrize(
    ("world", "sensor", "seed", "most_m", "share"),
    [("corridor", "vlp-16", 1, 0.15, 0.3), ("gap", "rosette", 0, 0.1, 0.1)],
)
def test_where_scans_leave_the_translation_open_the_error_is_a_fraction(world, sensor, seed, most_m, share):
    path = made.log(world, sensor=sensor, seconds=15.0, seed=seed, imu="mems")
    truth = scanchain.read_tum(path.with_suffix(".tum"))
    ours = driven(scanchain.open_log(path), truth)
    assert ours.ate_m < most_m
    without = driven(scanchain.open_log(path, imu_topic="none"), truth)
    assert ours.ate_m < share * without.ate_m
