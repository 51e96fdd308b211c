"""The gyro: rotations along its samples, what is wrong with them is found out, and it is used where it helps."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import scanchain
from scanchain import lie
from scanchain.config import PreprocessConfig
from scanchain.data import Inertial, Scan
from scanchain.odometry.gyro import Gyro
from scanchain.preprocess import sweep_of
from tests.benchmarks.imu import driven
from tests.support import made

SCAN_S, SAMPLE_S = 0.1, 0.005
BIAS = np.radians([0.5, -0.4, 0.3])
ALIGNED = np.eye(3)


def rate_at(times_s):
    """Angular velocity (N, 3) of a lidar that sways about all axes, rad/s."""
    waves = np.array([0.31, 0.43, 0.71]), np.array([0.0, 1.0, 2.0]), np.array([0.5, 0.6, 2.0])
    return waves[2] * np.sin(2.0 * np.pi * np.multiply.outer(times_s, waves[0]) + waves[1])


def rotated(begin_s, end_s):
    """The rotation matrix from one instant to another, by small steps."""
    times_s = np.linspace(begin_s, end_s, 201)
    steps = Rotation.from_rotvec(rate_at(0.5 * (times_s[1:] + times_s[:-1])) * np.diff(times_s)[:, None])
    R = np.eye(3)
    for step in steps.as_matrix():
        R = R @ step
    return R


def drive(
    gyro,
    scans=80,
    *,
    late_s=0.0,
    axes=ALIGNED,
    stated=ALIGNED,
    limit=np.inf,
    match_rad=5e-4,
    dimension=3,
    is_frozen=False,
):
    """Feed a gyro with the samples and the rotations of scans; the errors of its rotations from scan to scan."""
    random, errors, last_s = np.random.default_rng(0), [], -0.5
    for k in range(scans):
        stamp_s = SCAN_S * k
        stamps_s = (
            np.arange(np.ceil((last_s + 1e-6) / SAMPLE_S), np.ceil((stamp_s + SCAN_S) / SAMPLE_S) + 1) * SAMPLE_S
        )
        last_s = stamps_s[-1]
        rates = rate_at(stamps_s - late_s) * (np.array([0.0, 0.0, 1.0]) if dimension == 2 else 1.0)
        rates = np.clip(rates + BIAS + 0.001 * random.normal(size=rates.shape), -limit, limit) @ axes
        rates = rates * 0.0 + BIAS if is_frozen else rates
        stamps_ns = np.round(1e9 * stamps_s).astype(np.int64) + 10**18
        T = None if stated is None else np.block([[stated, np.zeros((3, 1))], [np.zeros((1, 3)), np.ones((1, 1))]])
        inertial = Inertial(stamps_ns, rates, np.zeros_like(rates), T)
        points, times_s = 5.0 * np.array([np.ones(dimension), -np.ones(dimension)]), np.array([0.0, SCAN_S])
        scan = Scan.of(points, 1e9 + stamp_s, times_s, index=k, inertial=inertial)
        gyro.add(scan)
        gyro.predict(scan, sweep_of(scan, PreprocessConfig()))
        if not k:
            gyro.correct(None)
            continue
        true = np.eye(dimension + 1)
        middle_s = stamp_s + 0.5 * SCAN_S
        if dimension == 3:
            true[:3, :3] = rotated(middle_s - SCAN_S, middle_s)
        else:
            instants = np.linspace(middle_s - SCAN_S, middle_s, 201)
            true = lie.pose_2d(0.0, 0.0, float(rate_at(instants)[:, 2].mean() * SCAN_S))
        size = gyro.size
        errors.append(gyro.rotation - lie.log(true)[-size:])
        found = true @ lie.exp(np.r_[np.zeros(dimension), match_rad * random.normal(size=size)])
        gyro.correct(found)
    return np.degrees(np.linalg.norm(errors, axis=1))


@pytest.mark.parametrize("dimension", [2, 3])
def test_its_rotations_are_those_of_the_lidar_and_its_bias_is_found(dimension):
    gyro = Gyro(dimension)
    errors_deg = drive(gyro, dimension=dimension)
    assert gyro.is_used
    assert errors_deg[20:].max() < 0.03
    assert 0.0 < gyro.innovation < 1.0  # it errs by less than stated
    assert np.degrees(np.abs(gyro.model.bias - BIAS[-gyro.size :])).max() < 0.1
    assert gyro.warnings() == ()
    assert "predicts the rotation of" in gyro.note()


MOUNTED = Rotation.from_euler("zyx", [90.0, 10.0, -20.0], degrees=True).as_matrix()


@pytest.mark.parametrize(
    ("disturbed", "words"),
    [
        ({"axes": -np.eye(3)}, "the sign of its rates is wrong"),
        ({"axes": np.degrees(1.0) * np.eye(3)}, "its rates are in degrees per second"),
        ({"axes": MOUNTED, "stated": ALIGNED}, "its axes are not those of the transforms"),
        ({"axes": MOUNTED, "stated": None}, ""),
        ({"late_s": 0.06}, "its stamps are 0.06 s late"),
        ({"late_s": -0.2}, "its stamps are 0.20 s early"),
    ],
)
def test_what_is_wrong_is_found_out_said_and_corrected(disturbed, words):
    gyro = Gyro(3)
    errors_deg = drive(gyro, **disturbed)
    assert gyro.is_used
    assert np.median(errors_deg[60:]) < 0.15
    assert words in " ".join(gyro.warnings())
    assert bool(words) == bool(gyro.warnings())
    if "late_s" not in disturbed:  # then it is used from the beginning, late
        assert np.sqrt(gyro.sums[0] / gyro.compared) < np.radians(0.2)


def test_with_stamps_so_late_that_its_samples_are_missing_it_is_not_used_and_said_to_be_late():
    gyro = Gyro(3)
    drive(gyro, late_s=0.3)
    assert not gyro.used
    assert "its stamps are 0.30 s late" in gyro.warnings()[0]


def test_saturated_rates_are_left_out_and_counted():
    gyro = Gyro(3)
    drive(gyro, limit=1.5)
    assert 20 < gyro.unusable["rates saturated at 86°/s"] < 60
    assert gyro.is_used


def test_rates_that_do_not_change_are_left_out():
    gyro = Gyro(3)
    drive(gyro, is_frozen=True)
    assert not gyro.used
    assert "rates that do not change" in gyro.warnings()[0]


def test_without_samples_for_long_there_is_no_rotation():
    gyro = Gyro(3)
    drive(gyro, scans=12)
    scan = Scan.of(np.ones((2, 3)), 1e9 + 2.0, np.array([0.0, SCAN_S]), index=12)
    assert gyro.predict(scan, sweep_of(scan, PreprocessConfig())) is None
    gyro.correct(np.eye(4))
    assert any("no sample" in line for line in gyro.warnings()) and np.isnan(gyro.innovation)


def test_a_rotation_by_scans_that_is_far_off_does_not_move_the_bias():
    gyro = Gyro(3)
    drive(gyro, scans=85)
    before, gyro.now_s, gyro.next_fit = gyro.model.bias, gyro.now_s + SCAN_S, np.inf
    gyro.correct(lie.exp(np.r_[np.zeros(3), gyro.rotation + np.array([0.0, 0.0, 0.1])]))
    assert gyro.errors[-1][0] > 0.005
    variance = gyro.sigma_rad**2 + gyro.bias_variance * SCAN_S**2
    assert gyro.innovation == pytest.approx(0.1 / np.sqrt(3.0 * variance), rel=1e-3) and gyro.innovation > 5.0
    assert np.array_equal(before, gyro.model.bias)


def test_after_a_jump_of_the_clock_it_goes_on_with_new_samples():
    gyro = Gyro(3)
    drive(gyro)
    stamps_ns = np.arange(10**9, 10**9 + 10**8, 5_000_000)
    inertial = Inertial(stamps_ns, np.zeros((20, 3)), np.zeros((20, 3)), np.eye(4))
    scan = Scan.of(np.ones((2, 3)), 1.0, np.array([0.0, SCAN_S]), index=80, inertial=inertial)
    gyro.add(replace(scan, clock_jump_s=-1e9))
    assert [len(times_s) for times_s, _ in gyro.blocks] == [20]
    assert gyro.predict(scan, sweep_of(scan, PreprocessConfig())) is None


def test_while_it_predicts_worse_than_the_last_motion_it_is_not_used():
    gyro = Gyro(3)
    gyro.errors.extend([(2.0, 1.0)] * 10)
    assert not gyro.is_used
    gyro.errors.extend([(0.5, 1.0)] * 20)
    assert gyro.is_used


FAULTS = {
    "mems": "",
    "mems-g": "its accelerations are in g: converted",
    "mems-half-late": "",
    "mems-vibration": "",
    "mems-no-transform": "",
    "mems-degrees": "its rates are in degrees per second",
    "mems-sign": "the sign of its rates is wrong",
    "mems-frozen": "rates that do not change",
    "mems-saturated": "rates saturated at 60°/s",
    "mems-late": "its stamps are 0.30 s late",
}


def turns(imu):
    """The log of turns of 200 deg/s with an IMU, and its truth."""
    log = made.log("turns", sensor="vlp-16", seconds=13.0, pace=1.67, imu=imu)
    return log, scanchain.read_tum(log.with_suffix(".tum"))


@pytest.fixture(scope="module")
def without():
    """Odometry of these scans, which are the same with any IMU, without it."""
    log, truth = turns("mems")
    return driven(scanchain.open_log(log, imu_topic="none"), truth)


@pytest.mark.slow
@pytest.mark.parametrize("imu", FAULTS)
def test_turns_of_200_degrees_a_second_are_not_worse_with_any_imu_and_better_with_a_sound_one(imu, without):
    log, truth = turns(imu)
    ours = driven(scanchain.open_log(log), truth)
    assert ours.ate_m < 1.1 * without.ate_m
    assert ours.step_deg < 1.1 * without.step_deg
    assert FAULTS[imu] in ours.words
    assert bool(FAULTS[imu]) == bool(ours.words)
    if imu == "mems":
        assert ours.used > 0.8
        assert ours.ate_m < 0.7 * without.ate_m
        assert ours.step_deg < 0.4 * without.step_deg
