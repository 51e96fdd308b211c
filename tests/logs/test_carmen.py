"""CARMEN logs: the published Intel log, and small ones that hold what it does not."""

import bz2
import gzip
import tracemalloc
from itertools import islice, zip_longest

import numpy as np
import pytest

from scanchain import lie
from scanchain.errors import InputError
from scanchain.logs import open_log
from tests.support.recorders import read
from tests.support.scenes import shared_data
from tests.support.sensor_files import BEGIN_S, flaser, odom, robotlaser, save


def points(ranges, first=-np.pi / 2, step=np.pi / 180):
    angles = float(np.float32(first)) + float(np.float32(step)) * np.arange(len(ranges))
    directions = np.column_stack([np.cos(angles), np.sin(angles)]).astype("f4")
    return directions * np.asarray(ranges, "f4")[:, None]


def assert_same(ours, theirs):
    assert ours.stamp_ns == theirs.stamp_ns and ours.log_time_ns == theirs.log_time_ns
    assert ours.points.tobytes() == theirs.points.tobytes() and ours.dropped == theirs.dropped
    assert ours.T_odom_base.tobytes() == theirs.T_odom_base.tobytes()


@pytest.mark.slow
def test_the_published_intel_log_is_the_same_as_its_mcap_to_the_last_bit():
    text = open_log(shared_data("2d/intel.clf.bz2"))
    mcap = open_log(shared_data("2d/intel.mcap"))
    assert text.scan_count == mcap.scan_count == 13_631
    np.testing.assert_array_equal(text.T_base_lidar, mcap.T_base_lidar)
    count = 0
    for ours, theirs in islice(zip_longest(text.scans(), mcap.scans()), 3000):
        assert_same(ours, theirs)
        count += 1
    assert count == 3000


@pytest.mark.parametrize("pack", [bytes, bz2.compress, gzip.compress], ids=["plain", "bz2", "gz"])
def test_a_log_may_be_packed_whatever_its_name(tmp_path, pack):
    path = tmp_path / "a.txt"
    path.write_bytes(pack(save(tmp_path / "b.log", *[flaser(k) for k in range(5)]).read_bytes()))
    log, scans = read(path)
    assert (log.dimension, log.topic, log.odometry_topic, log.scan_count) == (2, "/scan", "/odom", 5)
    for k, scan in enumerate(scans):
        assert scan.stamp_ns == scan.log_time_ns == int((BEGIN_S + 0.25 * k) * 1e9)
        np.testing.assert_array_equal(scan.points, points(np.linspace(1.0, 5.0, 180).round(2)))
        np.testing.assert_allclose(scan.T_odom_base, lie.pose_2d(0.1 * k, 0.02 * k, 0.01 * k), atol=1e-6)


@pytest.mark.parametrize(
    ("beams", "first", "step"),
    [
        (180, -90, 1), (181, -90, 1), (360, -90, 0.5), (361, -90, 0.5), (401, -50, 0.25), (541, -135, 0.5),
        (682, -340.5 * 360 / 1024, 360 / 1024), (1081, -135, 0.25), (91, -90, 2),
    ],
)  # fmt: skip
def test_the_number_of_beams_tells_their_angles(tmp_path, beams, first, step):
    log, (scan,) = read(save(tmp_path / "a.log", flaser(0, np.full(beams, 2.0))))
    assert ("state no angles: 91 beams are taken as those of 180 deg" in str(log.notes)) == (beams == 91)
    np.testing.assert_allclose(
        scan.points, points(np.full(beams, 2.0), np.radians(first), np.radians(step)), atol=1e-5
    )


def test_a_parameter_tells_the_step_of_an_unusual_number_of_beams(tmp_path):
    lines = ["PARAM laser_front_laser_resolution 0.5 nohost 0", flaser(0, np.full(201, 2.0))]
    log, (scan,) = read(save(tmp_path / "a.log", *lines))
    expected = points(np.full(201, 2.0), np.radians(-50.0), np.radians(0.5))
    np.testing.assert_allclose(scan.points, expected, atol=1e-5)
    assert "angles" not in str(log.notes)


def test_the_codes_of_a_sick_for_no_return_are_dropped(tmp_path):
    ranges = np.full(180, 81.82)
    ranges[:4] = 81.83, 81.9, 81.91, 0.0
    _, (scan,) = read(save(tmp_path / "a.log", flaser(0, ranges)))
    assert scan.dropped == 4
    reach = "PARAM robot_front_laser_max 50.0 nohost 0"
    _, (scan,) = read(save(tmp_path / "b.log", reach, flaser(0, np.linspace(49.0, 51.0, 180))))
    assert scan.dropped == 90


def test_wheels_mounting_and_truth_of_a_log(tmp_path):
    """Wheels are the raw odometry, not the corrected pose, that of lines between scans, too."""
    scan = flaser(1, pose=(50.0, 60.0, 1.0), odometry=(1.0, 2.0, 0.5))
    lines = ["PARAM robot_frontlaser_offset 0.35 nohost 0", odom(0, 7.0), scan, odom(2, 9.0)]
    lines += [f"TRUEPOS {k}.5 2.0 0.25 0 0 0 {BEGIN_S + 0.25 * k:.6f} nohost 0" for k in range(3)]
    log, (scan,) = read(save(tmp_path / "a.log", *lines))
    np.testing.assert_allclose(scan.T_odom_base, lie.pose_2d(1.0, 2.0, 0.5), atol=1e-12)
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.35, 0.0, 0.0), atol=1e-12)
    assert log.indexes[0].counts[log.indexes[0].numbers_of("/odom").pop()] == 3
    np.testing.assert_allclose(
        log.ground_truth().poses,  # of the lidar, 0.35 m ahead of the robot's center, which TRUEPOS states
        [lie.pose_2d(k + 0.5, 2.0, 0.25) @ log.T_base_lidar for k in range(3)],
        atol=1e-9,
    )
    assert "/ground_truth: poses of base_link, moved to the lidar, at" in str(log.notes)


def test_the_place_of_a_laser_on_its_robot_has_a_side_and_an_angle(tmp_path):
    lines = [
        f"PARAM robot_frontlaser_{name}offset {value} nohost 0"
        for name, value in (("", 0.35), ("side_", -0.1), ("angular_", 0.5))
    ]
    log, _ = read(save(tmp_path / "a.log", *lines, flaser(0)))
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.35, -0.1, 0.5), atol=1e-12)


def test_a_robotlaser_line_tells_angles_reach_wheels_and_mounting_itself(tmp_path):
    robot = lie.pose_2d(3.0, 4.0, 1.0)
    laser = robot @ lie.pose_2d(0.2, 0.1, 0.5)
    x, y, yaw = laser[0, 2], laser[1, 2], 1.5
    ranges = [1.0, 2.0, 31.0, 4.0, 30.0]
    line = robotlaser(0, ranges, (x, y, yaw), (3.0, 4.0, 1.0), remissions=(7, 8))
    log, (scan,) = read(save(tmp_path / "a.log", line))
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.2, 0.1, 0.5), atol=1e-9)
    np.testing.assert_allclose(scan.T_odom_base, robot, atol=1e-12)
    np.testing.assert_allclose(scan.points, points(ranges, -1.0, 0.25)[[0, 1, 3]], atol=1e-6)
    assert scan.dropped == 2


def test_scans_stay_in_the_order_of_the_file_where_stamps_step_back(tmp_path):
    stamps_s = [BEGIN_S, BEGIN_S + 1.0, BEGIN_S + 0.5, BEGIN_S + 0.25, BEGIN_S + 2.0]
    lines = [flaser(k, np.full(180, 1.0 + k), stamp_s=stamp) for k, stamp in enumerate(stamps_s)]
    _, scans = read(save(tmp_path / "a.log", *lines))
    assert [scan.stamp_ns for scan in scans] == [int(stamp * 1e9) for stamp in stamps_s]
    assert [round(float(np.linalg.norm(scan.points[0]))) for scan in scans] == [1, 2, 3, 4, 5]
    logged = [scan.log_time_ns - int(BEGIN_S * 1e9) for scan in scans]
    assert logged == [0, 1_000_000_000, 1_000_100_000, 1_000_200_000, 2_000_000_000]


def test_lines_that_are_malformed_or_of_other_kinds_are_counted(tmp_path):
    broken = [flaser(1).replace("1.000000", "x", 1), "FLASER 180 1 2 3", flaser(2)[:200], "ODOM a b c", ""]
    path = save(tmp_path / "a.log", flaser(0), *broken, "SYNC tag 1 2 3", "SYNC tag 1 2 3", flaser(5))
    log, scans = read(path)
    assert len(scans) == 2
    told = " ".join(log.damage)
    assert "line 3" in told and "malformed" in told
    assert "2 SYNC" in " ".join(log.notes)


@pytest.mark.parametrize("text", [b"\0", b"FLASER 0".ljust(1023) + b"\n"], ids=["zeros", "lines"])
def test_a_bomb_takes_no_more_memory_than_a_log_of_its_size_could(tmp_path, text):
    (tmp_path / "bomb.clf").write_bytes(100 * bz2.compress(text * ((1 << 20) // len(text))))
    tracemalloc.start()
    with pytest.raises(InputError, match=r"bomb.clf: decompresses to more than [\d,]+ bytes"):
        open_log(tmp_path / "bomb.clf")
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 50 << 20
