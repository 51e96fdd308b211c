"""The IMU of a log: which topic it is, how it is turned on the lidar, and the samples that come with a scan."""

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs.info import describe
from scanchain.logs.writer import LogWriter, pack_imu
from scanchain.settings import load_settings
from scanchain.simulation.imu import IMUS
from tests.support import made
from tests.support.several_lidars import looped

STAMPS_NS = np.arange(0, 1_000_000_000, 10_000_000)


@pytest.fixture(scope="module")
def log():
    return made.log("turns", sensor="vlp-16", seconds=3.0, imu="mems")


def with_more(log, folder, topics, **fields):
    """Log files: the given one, and one with further IMUs."""
    path = folder / "more.mcap"
    begin_ns = scanchain.open_log(log).expected_stamps("/points")[0]
    with LogWriter(path) as writer:
        for topic in topics:
            for stamp_ns in begin_ns + STAMPS_NS:
                shifted_ns = int(stamp_ns) + fields.get("shift_ns", 0)
                data = pack_imu(shifted_ns, fields.get("frame", "imu_link"), np.zeros(3), np.zeros(3))
                writer.append(topic, "sensor_msgs/msg/Imu", data, int(stamp_ns))
    return [log, path]


def test_the_only_imu_is_found_with_its_pose_on_the_lidar(log):
    opened = scanchain.open_log(log)
    assert opened.imu.topic == "/imu/data"
    expected = lie.inverse(opened.mounting.T_base_lidar) @ IMUS["mems"].T_base_imu
    np.testing.assert_allclose(opened.imu.T_lidar_sensor, expected, atol=1e-9)


def test_scans_have_all_samples_in_order_each_once_to_their_end(log):
    scans = list(scanchain.open_log(log))
    stamps_ns = np.concatenate([each.inertial.stamps_ns for each in scans])
    assert (np.diff(stamps_ns) == 5_000_000).all()
    for scan in scans[:-1]:
        end_ns = scan.stamp_ns + round(1e9 * float(scan.times_s.max()))
        assert end_ns <= scan.inertial.stamps_ns[-1] < end_ns + 5_000_000
        assert scan.inertial.rates.shape == scan.inertial.accelerations.shape == (len(scan.inertial.stamps_ns), 3)
    assert np.linalg.norm(scans[0].inertial.accelerations, axis=1).mean() == pytest.approx(9.81, abs=0.1)


def test_after_a_jump_of_the_clock_scans_have_samples_again(log, tmp_path):
    path = looped(log, tmp_path / "looped.mcap", laps=2)
    scans = list(scanchain.open_log(path))
    assert len(scans) == 60
    jumped = next(k for k, scan in enumerate(scans) if scan.clock_jump_s)
    assert all(scan.inertial is not None for scan in scans[jumped + 1 :])
    assert scans[jumped].stamp_ns < scans[jumped - 1].stamp_ns


@pytest.mark.parametrize("behind_s", [-37.0, 0.0, 37.0])
def test_of_an_imu_of_another_clock_no_scan_has_samples_and_a_note_says_so(log, tmp_path, behind_s):
    parts = with_more(log, tmp_path, ["/b"], shift_ns=-round(1e9 * behind_s))
    opened = scanchain.open_log(parts, imu_topic="/b")
    assert all(scan.inertial is None for scan in opened) == bool(behind_s)
    assert ("no sample of the IMU is of the time of a scan" in str(opened.notes)) == bool(behind_s)


def test_none_leaves_it_unused_and_a_topic_that_is_none_is_refused(log):
    assert scanchain.open_log(log, imu_topic="none").imu is None
    assert all(scan.inertial is None for scan in scanchain.open_log(log, imu_topic="none"))
    with pytest.raises(
        InputError, match=r"log.imu_topic /odom is not a topic of sensor_msgs/Imu; these are: /imu/data"
    ):
        scanchain.open_log(log, imu_topic="/odom")


def test_of_several_none_is_used_until_one_is_chosen(log, tmp_path):
    logs = with_more(log, tmp_path, ["/camera/imu"])
    opened = scanchain.open_log(logs)
    assert opened.imu is None
    assert "several IMUs (/camera/imu, /imu/data), none is used; choose with --log.imu_topic" in opened.notes
    assert scanchain.open_log(logs, imu_topic="/camera/imu").imu.topic == "/camera/imu"


def test_without_a_transform_its_rotation_is_unknown_and_in_the_lidars_own_frame_none_is_needed(log, tmp_path):
    elsewhere = with_more(log, tmp_path, ["/a"], frame="unknown")
    assert scanchain.open_log(elsewhere, imu_topic="/a").imu.T_lidar_sensor is None
    (tmp_path / "own").mkdir()
    own = with_more(log, tmp_path / "own", ["/a"], frame="lidar")
    np.testing.assert_array_equal(scanchain.open_log(own, imu_topic="/a").imu.T_lidar_sensor, np.eye(4))


def test_that_of_a_planar_lidar_upside_down_is_as_seen_from_above():
    planar = made.log("office", seconds=3.0, imu="mems")
    usual, mirrored = (
        next(iter(scanchain.open_log(planar, upside_down=each))).inertial.T_lidar_imu for each in (False, True)
    )
    np.testing.assert_allclose(mirrored, np.diag([1.0, -1.0, -1.0, 1.0]) @ usual)


def test_a_sample_that_is_not_finite_is_left_out_and_counted(log, tmp_path):
    path = tmp_path / "bad.mcap"
    begin_ns = int(scanchain.open_log(log).expected_stamps("/points")[0])
    with LogWriter(path) as writer:
        for k, stamp_ns in enumerate((begin_ns + STAMPS_NS).tolist()):
            rates = np.full(3, np.nan if k == 5 else 0.0)
            data = pack_imu(stamp_ns, "imu_link", rates, np.zeros(3))
            writer.append("/b", "sensor_msgs/msg/Imu", data, stamp_ns)
    opened = scanchain.open_log([log, path], imu_topic="/b")
    list(opened)
    assert any("1 malformed message of /b left out" in line for line in opened.damage)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"stamps_ns": np.array([2, 1])}, "inertial.stamps_ns do not ascend"),
        ({"stamps_ns": np.array([0.1, 0.2])}, "inertial.stamps_ns holds float64"),
        ({"rates": np.zeros((3, 3))}, r"inertial.rates .* \(2, 3\)"),
        ({"accelerations": np.full((2, 3), np.nan)}, "inertial.accelerations holds NaN"),
        ({"T_lidar_imu": 2.0 * np.eye(4)}, "inertial.T_lidar_imu is not a rigid transformation"),
    ],
)
def test_samples_given_in_python_are_checked(changed, words):
    sound = scanchain.Inertial(np.array([1, 2]), np.zeros((2, 3)), np.zeros((2, 3)), np.eye(4))
    assert scanchain.Scan.of(np.ones((5, 3)), 1.0, inertial=sound).inertial.rates.shape == (2, 3)
    with pytest.raises(InputError, match=words):
        scanchain.Scan.of(np.ones((5, 3)), 1.0, inertial=sound._replace(**changed))


def test_info_says_what_it_is_used_for(log):
    said = describe([log], load_settings(3).config.log)["sensors"]
    ((place, use),) = [each.use.split("; ") for each in said if each.sensor == "IMU"]
    assert place.startswith("at x -0.090 m") and place.endswith("from the lidar")
    assert use == "predicts motions where it does so better than the scans"
    said = describe([log], LogConfig(imu_topic="none"))["sensors"]
    assert "not used; choose it with --log.imu_topic /imu/data" in [each.use for each in said]
    said = describe([log], LogConfig(), uses_imu=False)["sensors"]
    assert "not used: odometry.imu is false" in [each.use for each in said]


def test_info_does_not_ask_for_the_imu_to_be_chosen_where_the_lidar_is_not(log):
    found = describe([log], LogConfig(topic="/nowhere"))
    assert found["problem"]
    assert "predicts motions where it does so better than the scans" in [each.use for each in found["sensors"]]
