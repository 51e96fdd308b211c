"""Simulated IMUs: without errors they measure the motion, with them as much else as their model says."""

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from click.testing import CliRunner
from mcap.reader import make_reader

from scanchain import lie
from scanchain.__main__ import scanchain
from scanchain.errors import InputError
from scanchain.simulation import IMUS, SENSORS, WORLDS, plan, simulate
from tests.support.naive_logs import decoded

STEP_S = 0.005
GRAVITY = np.array([0.0, 0.0, 9.81])


def measured(name, motion, times_s, seed=0):
    return IMUS[name].measure(motion, times_s, np.random.default_rng(seed))


def standing(tilt_rad=0.1):
    """A motion that is none, on a slope."""
    T = lie.exp(np.array([1.0, 2.0, 3.0, tilt_rad, -tilt_rad, 0.5]))
    return SimpleNamespace(base=lambda times_s: np.tile(T, (len(times_s), 1, 1)))


def messages(path, topic):
    return [message for _, _, _, message in decoded(path, [topic])]


def vectors(readings):
    """Stamps (N,), angular velocities and linear accelerations (N, 3) of sensor_msgs/Imu."""
    stamps_ns = [each.header.stamp.sec * 10**9 + each.header.stamp.nanosec for each in readings]
    pairs = [(each.angular_velocity, each.linear_acceleration) for each in readings]
    return np.array(stamps_ns), *(
        np.array([(v.x, v.y, v.z) for v in column]) for column in zip(*pairs, strict=True)
    )


@pytest.mark.parametrize("world", WORLDS)
def test_the_gyro_integrates_to_the_rotation_and_the_specific_force_less_gravity_to_the_velocity(world):
    drive = plan(world, sensor="vlp-16", imu="ideal")
    times_s = np.arange(0.0, min(WORLDS[world].duration_s, 60.0), STEP_S)
    rates, forces = measured("ideal", drive.motion, times_s)
    T = drive.motion.base(times_s) @ drive.imu.T_base_imu
    steps = np.zeros((len(rates) - 1, 6))
    steps[:, 3:] = 0.5 * STEP_S * (rates[1:] + rates[:-1])
    R = T[0]
    for step in lie.exp(steps):
        R = R @ step
    assert np.rad2deg(lie.rotation_angle(lie.inverse(R) @ T[-1])) < 0.01
    in_world = np.einsum("nij,nj->ni", T[:, :3, :3], forces)
    gained_m_s = STEP_S * (in_world - GRAVITY)[1:-1].sum(axis=0)
    first_m_s, last_m_s = ((T[k + 1] - T[k])[:3, 3] / STEP_S for k in (0, -2))
    assert np.allclose(gained_m_s, last_m_s - first_m_s, atol=0.003)
    assert np.allclose(
        in_world.mean(axis=0), GRAVITY, atol=0.05 + 2.0 * WORLDS[world].vehicle.speed_m_s / times_s[-1]
    )


def test_the_error_of_the_differences_is_far_below_the_noise_of_a_sample():
    T_base_imu, twist = IMUS["ideal"].T_base_imu, np.array([3.0, 0.2, 0.1, 0.3, -0.5, 4.0])
    begin = lie.exp(np.array([100.0, -50.0, 2.0, 0.3, 0.2, 1.0]))
    motion = SimpleNamespace(base=lambda times_s: begin @ lie.exp(np.outer(times_s, twist)))
    times_s = np.arange(0.0, 5.0, STEP_S)
    rates, forces = measured("ideal", motion, times_s)
    velocity, rate = twist[:3], twist[3:]  # constant in the frame of the base
    at_imu = np.cross(rate, velocity + np.cross(rate, T_base_imu[:3, 3]))
    up = np.swapaxes(motion.base(times_s)[:, :3, :3], 1, 2) @ GRAVITY
    root_hertz = np.sqrt(1.0 / STEP_S)
    assert np.abs(rates - rate @ T_base_imu[:3, :3]).max() < 0.001 * IMUS["mems"].gyro.noise * root_hertz
    error = np.abs(forces - (at_imu + up) @ T_base_imu[:3, :3]).max()
    assert error < 0.02 * IMUS["mems"].accelerometer.noise * root_hertz


@pytest.mark.parametrize("world", ["forest", "staircase", "turns", "highway"])
def test_half_the_step_of_the_differences_gives_the_same_within_a_hundredth_of_the_noise(world, monkeypatch):
    motion, times_s = plan(world).motion, np.arange(0.0, 20.0, STEP_S)
    coarse = measured("ideal", motion, times_s)
    monkeypatch.setattr("scanchain.simulation.imu._STEP_S", 5e-4)
    for values, finer, errors in zip(
        coarse, measured("ideal", motion, times_s), (IMUS["mems"].gyro, IMUS["mems"].accelerometer), strict=True
    ):
        assert np.sqrt(np.mean((values - finer) ** 2)) < 0.01 * errors.noise / np.sqrt(STEP_S)


@pytest.mark.parametrize("name", ["ideal", "mems-no-transform"])
def test_at_rest_it_measures_gravity_upwards_and_no_rotation(name):
    model = replace(IMUS[name], gyro=IMUS["ideal"].gyro, accelerometer=IMUS["ideal"].accelerometer)
    rates, forces = model.measure(standing(), np.arange(0.0, 1.0, STEP_S), np.random.default_rng(0))
    T_world_imu = standing().base(np.zeros(1))[0] @ model.T_base_imu
    assert np.allclose(rates, 0.0, atol=1e-9) and np.allclose(forces, T_world_imu[:3, :3].T @ GRAVITY, atol=1e-6)
    level = model.measure(standing(0.0), np.zeros(1), np.random.default_rng(0)).accelerations_m_s2[0]
    assert level.argmax() == (2 if name == "ideal" else 1)  # upright, and on its side


def test_noise_bias_and_walk_are_as_large_as_the_model_says():
    model, times_s = IMUS["mems"], np.arange(0.0, 100.0, STEP_S)
    true = measured("ideal", standing(), times_s)
    runs = [measured("mems", standing(), times_s, seed) for seed in range(40)]
    for values, errors in zip(range(2), (model.gyro, model.accelerometer), strict=True):
        off = np.array([run[values] - true[values] for run in runs])
        assert off.std(axis=1).mean() == pytest.approx(errors.noise / np.sqrt(STEP_S), rel=0.03)
        ends = off[:, :200].mean(axis=1), off[:, -200:].mean(axis=1)  # over one second
        assert ends[0].std() == pytest.approx(errors.bias, rel=0.2)
        spread = np.hypot(errors.walk * np.sqrt(99.0), np.sqrt(2.0) * errors.noise)
        assert (ends[1] - ends[0]).std() == pytest.approx(spread, rel=0.2)


def test_a_fault_changes_what_its_name_says_and_nothing_else():
    drive, times_s = plan("turns"), np.arange(0.0, 20.0, STEP_S)
    rates, forces = measured("mems", drive.motion, times_s)
    seen = {name: measured(name, drive.motion, times_s) for name in IMUS}
    assert np.allclose(seen["mems-g"].accelerations_m_s2 * 9.80665, forces)
    assert np.allclose(np.deg2rad(seen["mems-degrees"].rates_rad_s), rates)
    assert np.array_equal(seen["mems-sign"].rates_rad_s, -rates)
    limit = np.deg2rad(60.0)
    assert np.array_equal(seen["mems-saturated"].rates_rad_s, np.clip(rates, -limit, limit))
    assert np.abs(rates).max() > 1.5 * limit
    for values, frozen in zip((rates, forces), seen["mems-frozen"], strict=True):
        assert np.array_equal(frozen[:2001], values[:2001]) and np.array_equal(
            frozen[2000:], [values[2000]] * 2000
        )
    for name in ("mems-degrees", "mems-sign", "mems-saturated"):
        assert np.array_equal(seen[name].accelerations_m_s2, forces)
    assert np.array_equal(seen["mems-g"].rates_rad_s, rates)
    shaken = [np.std(values - true) for values, true in zip(seen["mems-vibration"], seen["ideal"], strict=True)]
    assert np.rad2deg(shaken[0]) == pytest.approx(2.8, abs=0.3) and shaken[1] == pytest.approx(2.8, abs=0.3)


@pytest.mark.parametrize(("name", "late_s"), [("mems-late", 0.3), ("mems-half-late", 0.0025)])
def test_late_stamps_belong_to_earlier_values(tmp_path, name, late_s):
    simulate("turns", tmp_path / "a.mcap", duration_s=2.0, sensor="lms-270", imu=name)
    stamps_ns, rates, forces = vectors(messages(tmp_path / "a.mcap", "/imu/data"))
    drive = plan("turns", duration_s=2.0, sensor="lms-270")
    true = measured("ideal", drive.motion, (stamps_ns - stamps_ns[0]) * 1e-9 - late_s)
    assert np.std(rates - true.rates_rad_s, axis=0).max() < 1.1 * IMUS[name].gyro.noise / np.sqrt(STEP_S)
    assert np.std(forces - true.accelerations_m_s2, axis=0).max() < 0.025


@pytest.mark.parametrize(("world", "sensor"), [("office", "lms-270"), ("turns", "vlp-16"), ("gap", "lms-270")])
def test_a_log_holds_samples_at_200_hz_and_the_mounting_while_all_else_stays_the_same(tmp_path, world, sensor):
    duration_s = 14.0 if world == "gap" else 3.0
    logs = {name: tmp_path / f"{name}.mcap" for name in ("none", "ideal", "mems-no-transform")}
    for name, path in logs.items():
        imu = None if name == "none" else name
        simulate(world, path, duration_s=duration_s, sensor=sensor, seed=3, imu=imu)
    readings = messages(logs["ideal"], "/imu/data")
    stamps_ns, rates, forces = vectors(readings)
    scans_ns = int(duration_s * 1e9)
    assert set(np.diff(stamps_ns)) == {5_000_000} and np.ptp(stamps_ns) == scans_ns
    assert {each.header.frame_id for each in readings} == {"imu_link"}
    assert all(each.orientation_covariance[0] == -1.0 for each in readings)
    drive = plan(world, duration_s=duration_s, sensor=sensor, seed=3)
    true = measured("ideal", drive.motion, (stamps_ns - stamps_ns[0]) * 1e-9)
    assert np.array_equal(rates, true.rates_rad_s) and np.array_equal(forces, true.accelerations_m_s2)
    frames = {}
    for name, path in logs.items():
        ((static),) = messages(path, "/tf_static")
        frames[name] = {each.child_frame_id: each.transform for each in static.transforms}
        with path.open("rb") as stream:
            entries = [each for _, _, each in make_reader(stream).iter_messages(log_time_order=False)]
        assert [each.log_time for each in entries] == sorted(each.log_time for each in entries)
        kinds = {each.channel_id for each in entries}
        assert len(kinds) == (4 if name == "none" else 5)
    assert set(frames["none"]) == set(frames["mems-no-transform"]) == {"lidar"}
    assert set(frames["ideal"]) == {"lidar", "imu_link"}
    moved, T_base_imu = frames["ideal"]["imu_link"], IMUS["ideal"].T_base_imu
    assert np.allclose([getattr(moved.translation, axis) for axis in "xyz"], T_base_imu[:3, 3])
    quat_xyzw = np.array([getattr(moved.rotation, axis) for axis in "xyzw"])
    assert np.allclose(lie.from_quaternion(quat_xyzw), T_base_imu[:3, :3])
    lidar = "/scan" if SENSORS[sensor].dimension == 2 else "/points"
    for topic in (lidar, "/odom", "/ground_truth"):
        without, *others = (contents(path, topic) for path in logs.values())
        assert len(without) > 10 and all(other == without for other in others)


def contents(path, topic):
    """Bytes of all messages of a topic, with their times."""
    with path.open("rb") as stream:
        return [(each.log_time, each.data) for _, _, each in make_reader(stream).iter_messages([topic])]


def test_an_unknown_imu_is_refused_and_the_help_names_all(tmp_path):
    with pytest.raises(InputError, match="IMU 'fog' does not exist; choose one of ideal, mems, mems-g"):
        simulate("office", tmp_path / "a.mcap", duration_s=0.2, imu="fog")
    assert list(tmp_path.iterdir()) == []
    text = CliRunner().invoke(scanchain, ["simulate", "--help"]).output.split()
    assert set(IMUS) <= set(text)
