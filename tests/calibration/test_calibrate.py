"""``scanchain calibrate``: a table and a file that a run takes, on simulated and real logs."""

import math
import tomllib

import numpy as np
import pytest
from click.testing import CliRunner

import scanchain
from scanchain import lie
from scanchain.__main__ import scanchain as command
from scanchain.calibration import Calibration, Parameter, calibrate, delay_of_wheels
from scanchain.errors import InputError
from scanchain.runs.job import Progress
from scanchain.settings import load_settings
from tests.support import made
from tests.support.scenes import shared_data


@pytest.fixture(scope="module")
def log():
    return made.log("turns", sensor="vlp-16", seconds=6.0, imu="mems-half-late")


def test_the_command_prints_a_table_and_writes_keys_that_a_log_takes(log, tmp_path):
    path = tmp_path / "sensors.toml"
    done = CliRunner().invoke(command, ["calibrate", str(log), "--out", str(path)], standalone_mode=False)
    assert done.exception is None
    for line in ("lidar /points", "elevation offset", "IMU", "yaw", "wheels /odom", "scale of turns"):
        assert line in done.output
    assert "not observable: wheels move in the plane, whatever its height" in done.output
    assert "not observable: the log turns about one axis, or hardly turns" in done.output
    assert set(tomllib.loads(path.read_text())) == {"log"}
    config = load_settings(3, file=path).config.log
    assert abs(config.odometry_turn_scale - 1.0) > 0.005
    opened = scanchain.open_log(log, config)
    assert opened.mounting.is_stated and len(list(opened)) == 60
    again = CliRunner().invoke(command, ["calibrate", str(log), "--out", str(path)])
    assert "exists" in str(again.exception)


def test_the_vertical_angles_of_kitti_are_found_and_its_beams_do_not_pass_for_a_wrong_range():
    log = scanchain.open_log(shared_data("3d/kitti_0001_first54.mcap"))
    elevation, ranges = calibrate(log, load_settings(3).config, Progress()).parameters
    assert elevation.value == pytest.approx(0.2, abs=0.03) and 0.01 < elevation.sigma < 0.06 and not elevation.why
    assert "contradict" in ranges.why


def test_a_planar_log_has_wheels_alone():
    log = scanchain.open_log(made.log("office", seconds=12))
    found = calibrate(log, load_settings(2).config, Progress())
    assert {each.sensor for each in found.parameters} == {"/scan on the base", "wheels /odom"}
    scale = next(each for each in found.parameters if each.name == "scale of distances")
    assert 0.98 < scale.value < 1.02 and scale.sigma < 0.01 and not scale.why


def test_too_few_scans_are_refused():
    log = scanchain.open_log(made.log("turns", sensor="vlp-16", seconds=6.0, imu="mems-half-late"), end_s=0.25)
    with pytest.raises(InputError, match="a calibration needs 5 at least"):
        calibrate(log, load_settings(3).config, Progress())


def test_only_what_is_observable_and_differs_from_what_a_run_assumes_becomes_a_key():
    found = Calibration()
    assert found.add("lidar", "elevation offset", "deg", math.radians(0.2), math.radians(0.02), "", key="a")
    assert found.add("lidar", "elevation offset", "deg", math.radians(0.03), math.radians(0.02), "", key="b")
    assert not found.add("wheels", "scale", "", 1.3, 0.1, "it only drives straight", key="c")
    assert found.add("wheels", "scale", "", 1.001, 0.001, "", key="d")
    assert found.keys == {"a": pytest.approx(math.radians(0.2))}
    assert found.parameters[0] == Parameter("lidar", "elevation offset", *map(pytest.approx, (0.2, 0.02)), "deg")
    assert found.parameters[2].why == "it only drives straight"
    assert tomllib.loads(found.toml())["log"] == found.keys


def first_scan(path, **keys):
    return next(iter(scanchain.open_log(path, **keys)))


def test_offsets_change_elevations_and_ranges_of_the_points_as_they_are_read(log):
    usual, changed = first_scan(log), first_scan(log, elevation_offset_rad=0.01, range_offset_m=0.05)
    lengths = [np.linalg.norm(each.points, axis=1) for each in (usual, changed)]
    np.testing.assert_allclose(lengths[1] - lengths[0], 0.05, atol=1e-4)
    elevations = [
        np.arcsin(each.points[:, 2] / length) for each, length in zip((usual, changed), lengths, strict=True)
    ]
    np.testing.assert_allclose(elevations[1] - elevations[0], 0.01, atol=1e-5)


def test_a_stated_pose_replaces_the_transforms_and_a_wrong_one_is_refused(log):
    opened = scanchain.open_log(log, lidar_pose="1 2 3 0 0 0 1", imu_rotation="0 0 0.7071068 0.7071068")
    np.testing.assert_array_equal(opened.T_base_lidar[:3, 3], [1.0, 2.0, 3.0])
    np.testing.assert_allclose(opened.imu.T_lidar_sensor[:3, 0], [0.0, 1.0, 0.0], atol=1e-6)
    for text in ("1 2 3", "a b c d e f g", "0 0 0 0 0 0 0"):
        with pytest.raises(InputError, match=r"log.lidar_pose is .* wanted x y z qx qy qz qw"):
            scanchain.open_log(log, lidar_pose=text)
    with pytest.raises(
        InputError, match=r"log.other_lidar_poses has 1 pose; wanted as many as topics after the first"
    ):
        scanchain.open_log(log, other_lidar_poses="0 0 0 0 0 0 1")


def test_wheels_are_read_earlier_and_their_motions_divided_by_the_scales(log):
    usual = [scan.T_odom_base for scan in scanchain.open_log(log)]
    scaled = [scan.T_odom_base for scan in scanchain.open_log(log, odometry_scale=2.0, odometry_turn_scale=0.5)]
    steps, halved = (lie.log(lie.between(np.array(each[:-1]), np.array(each[1:]))) for each in (usual, scaled))
    np.testing.assert_allclose(halved, steps * [0.5, 0.5, 0.5, 2.0, 2.0, 2.0], atol=1e-9)
    late = [scan.T_odom_base for scan in scanchain.open_log(log, odometry_delay_s=0.1)]
    np.testing.assert_allclose(late[10:-1], usual[11:], atol=1e-9)


def test_scans_wait_for_wheels_that_are_later_than_half_a_second():
    usual, late = (made.log("office", seconds=6, drift=0.0, wheels_delay_s=delay_s) for delay_s in (0.0, 0.66))
    usual, late = list(scanchain.open_log(usual)), list(scanchain.open_log(late, odometry_delay_s=0.66))
    for before, after in zip(usual[:50], late[:50], strict=True):
        expected, found = (lie.between(scans[20].T_odom_base, each.T_odom_base) for scans, each in
            ((usual, before), (late, after)))  # fmt: skip
        np.testing.assert_allclose(found, expected, atol=2e-3)
    assert [scan.T_odom_base is None for scan in late[50:]] == [False] * 4 + [True] * 6


def test_the_delay_of_wheels_is_found_from_parts_of_a_log_and_without_wheels_there_is_none():
    late = made.log("office", seconds=40, wheels_delay_s=-0.3)
    assert delay_of_wheels(scanchain.open_log(late)) == pytest.approx(-0.3, abs=0.021)
    assert delay_of_wheels(scanchain.open_log(made.log("office", seconds=12))) == 0.0
    assert delay_of_wheels(scanchain.open_log(shared_data("2d/mocap_room_1.bag"))) == 0.0


def test_wheels_whose_stamps_jitter_by_more_than_a_scan_get_no_parameters():
    log = scanchain.open_log(shared_data("2d/intel.mcap"), end_s=300.0)
    found = calibrate(log, load_settings(2).config, Progress())
    assert found.keys == {} and "contradict" in found.parameters[0].why


def test_samples_of_a_late_imu_come_with_the_scans_in_which_they_were_measured(log):
    usual, earlier = (list(scanchain.open_log(log, imu_delay_s=delay_s)) for delay_s in (0.0, 0.1))
    np.testing.assert_array_equal(earlier[20].inertial.stamps_ns + 100_000_000, usual[21].inertial.stamps_ns)
    np.testing.assert_array_equal(earlier[20].inertial.rates, usual[21].inertial.rates)


def test_the_pose_of_pandasets_second_lidar_is_recovered_from_a_start_off_by_10_cm_and_3_degrees():
    path, topics = shared_data("3d/pandaset_002_sweeps30to55.mcap"), ("/pandar64/points", "/pandar_gt/points")
    start = "0.074151 0.053855 -0.040017 -0.023473 -0.011561 0.000767 0.999657"
    log = scanchain.open_log(path, topic=topics, other_lidar_poses=start)
    found = calibrate(log, load_settings(3).config, Progress())
    rows = {each.name: each for each in found.parameters if each.sensor.startswith("/pandar_gt")}
    expected = {
        "x": -0.055,
        "y": -0.010,
        "z": -0.018,
        "roll": 0.06,
        "pitch": -0.07,
        "yaw": -0.09,
    }  # from the stated
    for name, value in expected.items():
        assert rows[name].value == pytest.approx(value, abs=0.02 if len(name) == 1 else 0.2) and not rows[name].why
    assert len(found.keys["other_lidar_poses"].split()) == 7
