"""Wheel odometry that is only on /tf: which transform it is, and which it is not."""

import json

import numpy as np
import pytest

from scanchain import lie
from scanchain.__main__ import main
from scanchain.errors import InputError
from scanchain.logs import open_log
from tests.support.messages import says
from tests.support.naive_logs import (
    ROS1,
    SECOND,
    STAMP_NS,
    cloud_said,
    laser_scan,
    odometry,
    odometry_said,
    point_cloud,
    scan_said,
    transforms,
    transforms_said,
    write,
)
from tests.support.recorders import Ros, bag1_of, planar, read

LASER = ("base_link", "laser", 0.2, 0.0, 0.3, 0.0)
FOOT = ("base_footprint", "base_link", 0.0, 0.0, 0.0, 0.0)


def moving(parent, child, k):
    """Where a robot is at scan k."""
    return (parent, child, 0.1 * k, 0.01 * k, 0.02 * k, 0.0)


def drive(path, links, *, fixed=(LASER,), also=lambda k: (), frame_of_scans="laser", said=(), topic="/tf"):
    """Scans at 10 Hz, transforms of ``links`` and ``also`` at 20 Hz, each link in a message of its own."""
    told = [transforms_said(STAMP_NS, transforms(*fixed)), *said] if fixed else [*said]
    for k in range(20):
        stamp_ns = STAMP_NS + k * SECOND // 20
        for parent, child in links:
            told.append(
                transforms_said(stamp_ns, transforms(moving(parent, child, 0.5 * k), stamp_ns=stamp_ns), topic)
            )
        for entry in also(0.5 * k):
            told.append(transforms_said(stamp_ns, transforms(entry, stamp_ns=stamp_ns), topic))
        if k % 2 == 0:
            scan = laser_scan(stamp_ns, [1.0, 2.0 + 0.1 * k, 3.0], frame=frame_of_scans)
            told.append(scan_said(stamp_ns, scan))
    return write(path, told)


@pytest.mark.parametrize(
    ("links", "fixed", "base", "where"),
    [
        ([("odom", "base_link")], [LASER], "base_link", (0.2, 0.0, 0.3)),
        ([("/odom", "/base_link")], [LASER], "base_link", (0.2, 0.0, 0.3)),  # as ROS 1 has it
        ([("odom_combined", "base_footprint")], [FOOT, LASER], "base_footprint", (0.2, 0.0, 0.3)),
        ([("map", "odom"), ("odom", "base_footprint")], [FOOT, LASER], "base_footprint", (0.2, 0.0, 0.3)),
        ([("odom", "chassis")], [("chassis", "laser", 0.4, 0.0, 0.0, 0.0)], "chassis", (0.4, 0.0, 0.0)),
        ([("odom", "base_link")], [], "", (0.0, 0.0, 0.0)),  # no transform to the lidar
    ],
)
def test_the_pose_of_the_robot_in_the_frame_of_an_odometry_is_that_of_wheels(tmp_path, links, fixed, base, where):
    log, scans = read(drive(tmp_path / "a.mcap", links, fixed=fixed))
    assert log.odometry_topic == "/tf" and log.mounting.base == base
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(*where), atol=1e-12)
    for k, scan in enumerate(scans):
        np.testing.assert_allclose(scan.T_odom_base, lie.pose_2d(0.1 * k, 0.01 * k, 0.02 * k), atol=1e-12)


def test_info_names_frames_and_rate(tmp_path, capfd):
    path = drive(tmp_path / "a.mcap", [("map", "odom"), ("odom", "base_footprint")], fixed=[FOOT, LASER])
    assert main(["info", str(path)]) == 0
    says(capfd.readouterr().out, "wheels    /tf: odom → base_footprint, 20 Hz")
    assert main(["info", str(path), "--json"]) == 0
    assert json.loads(capfd.readouterr().out)["odometry"] == "/tf"


@pytest.mark.parametrize(
    ("links", "options", "note"),
    [
        ([("map", "odom")], {}, ""),  # a SLAM's correction
        ([("map", "base_link")], {}, ""),
        ([("odom", "laser")], {"fixed": []}, ""),  # an odometry of the lidar's own
        ([("robot_2/odom", "robot_2/base_link")], {}, ""),
        ([("a/odom", "a/base"), ("b/odom", "b/base")], {"fixed": []}, "several odometries on /tf"),
        (
            [],
            {"also": lambda k: [("odom", "base_link", 0.0, 0.0, 0.0, 0.0)]},
            "odom → base_link of /tf never changes",
        ),
        ([("odom", "base_link")], {"topic": "/tf_static"}, ""),
    ],
    ids=["correction", "localization", "lidar", "another robot", "two robots", "fixed on /tf", "static"],
)
def test_what_is_no_odometry_of_the_robot_is_not_taken_for_wheels(tmp_path, links, options, note):
    log, scans = read(drive(tmp_path / "a.mcap", links, **options))
    assert log.odometry_topic == "" and all(scan.T_odom_base is None for scan in scans)
    others = [line for line in log.notes if not line.startswith("no point times")]
    assert any(note in line for line in others) if note else not others


def test_of_two_robots_that_of_the_lidar_is_taken(tmp_path):
    links = [("r1/odom", "r1/base_footprint"), ("r2/odom", "r2/base_footprint")]
    fixed = [(f"r{k}/base_footprint", f"r{k}/laser", 0.1 * k, 0.0, 0.0, 0.0) for k in (1, 2)]
    log, _ = read(drive(tmp_path / "a.mcap", links, fixed=fixed, frame_of_scans="r2/laser"))
    assert log.wheels == "/tf: r2/odom → r2/base_footprint, 20 Hz" and log.mounting.base == "r2/base_footprint"


def test_an_odometry_topic_comes_first_unless_tf_is_asked_for(tmp_path):
    readings = [
        odometry_said(STAMP_NS + k * SECOND // 10, odometry(STAMP_NS + k * SECOND // 10, 5.0)) for k in range(9)
    ]
    path = drive(tmp_path / "a.mcap", [("odom", "base_link")], said=readings)
    log, scans = read(path)
    assert log.odometry_topic == "/odom" and scans[2].T_odom_base[0, 2] == 5.0
    log, scans = read(path, odometry_topic="/tf")
    assert log.odometry_topic == "/tf" and scans[2].T_odom_base[0, 2] == pytest.approx(0.2)


def test_a_tf_without_odometry_that_is_asked_for_is_refused_with_what_it_holds(tmp_path):
    path = drive(tmp_path / "a.mcap", [("map", "odom")])
    with pytest.raises(
        InputError, match=r"/tf has no transform from an odometry's frame .*; it contains: map → odom"
    ):
        open_log(path, odometry_topic="/tf")


def test_a_joint_that_moves_the_lidar_leaves_the_wheels_of_tf_out_as_others(tmp_path):
    pan = lambda k: [("base_link", "laser", 0.2, 0.0, 0.1 * k, 0.0)]  # noqa: E731
    log, _ = read(drive(tmp_path / "a.mcap", [("odom", "base_link")], fixed=[], also=pan))
    assert not log.odometry_topic and not log.wheels
    says("\n".join(log.notes), "base_link → laser in /tf turns by up to", "the wheels (/tf) are no prior for it")
    rest = lambda k: [("base_link", "laser", 0.2, 0.0, 0.3, 0.0)]  # noqa: E731
    log, _ = read(drive(tmp_path / "b.mcap", [("odom", "base_link")], fixed=[], also=rest))
    assert log.odometry_topic == "/tf" and not any("/tf" in line for line in log.notes)


def test_a_transform_of_another_link_that_is_no_pose_costs_no_reading(tmp_path):
    bad = lambda k: [("base_link", "arm", float("nan"), 0.0, 0.0, 0.0)]  # noqa: E731
    log, scans = read(drive(tmp_path / "a.mcap", [("odom", "base_link")], also=bad))
    assert all(scan.T_odom_base is not None for scan in scans) and log.damage == []


def test_a_bag_of_ros_1_has_it_as_well(tmp_path):
    ros, told = Ros(ROS1), []
    for k, scan in enumerate(planar(6)):
        for entry in (moving("odom", "base_link", k), LASER):
            message = ros.transforms(entry, stamp_ns=scan.stamp_ns)
            told.append(("/tf", "tf2_msgs/msg/TFMessage", scan.stamp_ns, message))
        told.append(("/scan", "sensor_msgs/msg/LaserScan", scan.stamp_ns, ros.scan(scan)))
    log, scans = read(bag1_of(tmp_path / "a.bag", told))
    assert log.wheels == "/tf: odom → base_link, 8 Hz" and log.mounting.base == "base_link"
    assert [round(scan.T_odom_base[0, 2], 9) for scan in scans] == [0.0, 0.1, 0.2, 0.3, 0.4, 0.5]


def test_clouds_get_the_whole_pose_of_tf(tmp_path):
    said = []
    for k in range(6):
        stamp_ns = STAMP_NS + k * SECOND // 10
        entries = moving("odom", "base_link", k), ("base_link", "lidar", 0.2, 0.0, 0.0, 0.0)
        said.append(transforms_said(stamp_ns, transforms(*entries, stamp_ns=stamp_ns), "/tf"))
        rows = np.zeros(50, [(name, "f4") for name in "xyz"])
        for name in "xyz":
            rows[name] = np.random.default_rng(k).normal(size=50)
        said.append(cloud_said(stamp_ns, point_cloud(stamp_ns, rows)))
    _, scans = read(write(tmp_path / "a.mcap", said))
    T = lie.lift(lie.pose_2d(0.3, 0.03, 0.06))
    T[2, 3] = 0.5
    np.testing.assert_allclose(scans[3].T_odom_base, T, atol=1e-12)
