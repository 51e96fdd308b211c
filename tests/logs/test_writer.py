"""What is written is what an independent decoder reads."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.errors import InputError
from scanchain.logs.writer import (
    Link,
    LogWriter,
    pack_laser_scan,
    pack_odometry,
    pack_transforms,
    place,
    schema_text,
)
from tests.support.naive_logs import decoded

STAMP_NS = 1_700_000_000_123_456_789


def append_mounting(log, T):
    data = pack_transforms(STAMP_NS, Link("base_link", "lidar", place(T)))
    log.append("/tf_static", "tf2_msgs/msg/TFMessage", data, STAMP_NS)


def nanoseconds(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def columns(cloud):
    codes = {7: "<f4", 6: "<u4", 4: "<u2"}
    layout = {"names": [], "formats": [], "offsets": [], "itemsize": cloud.point_step}
    for field in cloud.fields:
        layout["names"].append(field.name)
        layout["formats"].append(codes[field.datatype])
        layout["offsets"].append(field.offset)
    return np.frombuffer(cloud.data, dtype=np.dtype(layout))


@pytest.mark.parametrize("frame", ["", "l", "la", "las", "lase", "laser"])
def test_a_laser_scan_survives_any_length_of_frame_name(tmp_path, frame):
    ranges = np.array([1.5, np.inf, 29.75], dtype=np.float32)
    with LogWriter(tmp_path / "a.mcap") as log:
        data = pack_laser_scan(
            STAMP_NS, frame, -0.5, 0.5, ranges, range_min_m=0.1, range_max_m=30.0, time_increment_s=1e-3,
            scan_time_s=0.1,
        )  # fmt: skip
        log.append("/scan", "sensor_msgs/msg/LaserScan", data, STAMP_NS)
    ((schema, channel, message, scan),) = decoded(tmp_path / "a.mcap")
    assert (schema.name, schema.encoding) == ("sensor_msgs/msg/LaserScan", "ros2msg")
    assert (channel.topic, channel.message_encoding) == ("/scan", "cdr")
    assert message.log_time == nanoseconds(scan) == STAMP_NS
    assert scan.header.frame_id == frame
    assert np.array_equal(np.array(scan.ranges, dtype=np.float32), ranges)
    assert scan.angle_min == -0.5 and scan.angle_max == 0.5 and scan.angle_increment == 0.5
    assert scan.time_increment == pytest.approx(1e-3) and scan.scan_time == pytest.approx(0.1)
    assert scan.range_min == pytest.approx(0.1) and scan.range_max == 30.0


@pytest.mark.parametrize("time_field", ["t", "time"])
def test_a_cloud_survives_with_its_times_and_rings(tmp_path, time_field):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(1000, 3)).astype(np.float32)
    times = np.sort(rng.uniform(0.0, 0.1, 1000)).astype(np.float32)
    ring = rng.integers(0, 64, 1000)
    with LogWriter(tmp_path / "a.mcap") as log:
        log.point_cloud(
            "/points",
            STAMP_NS,
            "lidar",
            points,
            times_s=times,
            time_field=time_field,
            ring=ring,
            log_time_ns=STAMP_NS + 5,
        )
    ((_, _, message, cloud),) = decoded(tmp_path / "a.mcap")
    assert message.log_time == STAMP_NS + 5 and nanoseconds(cloud) == STAMP_NS
    assert (cloud.height, cloud.width, cloud.is_bigendian, cloud.is_dense) == (1, 1000, False, True)
    assert cloud.row_step == cloud.point_step * 1000 == len(cloud.data)
    rows = columns(cloud)
    assert np.array_equal(np.stack([rows["x"], rows["y"], rows["z"]], axis=1), points)
    assert np.array_equal(rows["ring"], ring)
    seconds = rows["t"] * 1e-9 if time_field == "t" else rows["time"]
    assert np.abs(seconds - times).max() < 1e-9


def test_a_bare_cloud_has_coordinates_only(tmp_path):
    with LogWriter(tmp_path / "a.mcap") as log:
        log.point_cloud("/points", STAMP_NS, "lidar", np.zeros((0, 3)))
    ((_, _, _, cloud),) = decoded(tmp_path / "a.mcap")
    assert [field.name for field in cloud.fields] == ["x", "y", "z"]
    assert cloud.width == 0 and len(cloud.data) == 0


def test_poses_of_either_dimension_survive_as_odometry_and_static_transform(tmp_path):
    flat = lie.pose_2d(1.0, -2.0, 2.5)
    solid = lie.exp(np.array([1.0, 2.0, 3.0, 0.3, -0.8, 1.9]))
    covariance = np.arange(36.0).reshape(6, 6)
    with LogWriter(tmp_path / "a.mcap") as log:
        append_mounting(log, flat)
        data = pack_odometry(STAMP_NS, "odom", "base_link", place(solid), covariance)
        log.append("/odom", "nav_msgs/msg/Odometry", data, STAMP_NS)
    static, odometry = (contents for *_, contents in decoded(tmp_path / "a.mcap"))

    (transform,) = static.transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("base_link", "lidar")
    t, q = transform.transform.translation, transform.transform.rotation
    assert (t.x, t.y, t.z) == (1.0, -2.0, 0.0)
    assert np.allclose(lie.from_quaternion(np.array([q.x, q.y, q.z, q.w])), lie.lift(flat)[:3, :3])

    assert (odometry.header.frame_id, odometry.child_frame_id) == ("odom", "base_link")
    p, q = odometry.pose.pose.position, odometry.pose.pose.orientation
    assert np.allclose([p.x, p.y, p.z], solid[:3, 3])
    assert np.allclose(lie.from_quaternion(np.array([q.x, q.y, q.z, q.w])), solid[:3, :3])
    assert np.array_equal(np.reshape(odometry.pose.covariance, (6, 6)), covariance)
    assert np.array_equal(odometry.twist.covariance, np.zeros(36))


def test_every_definition_brings_the_types_it_uses():
    text = schema_text("nav_msgs/msg/Odometry").decode()
    for name in (
        "std_msgs/Header",
        "builtin_interfaces/Time",
        "geometry_msgs/Quaternion",
        "geometry_msgs/Vector3",
    ):
        assert text.count(f"MSG: {name}\n") == 1


def test_a_failure_leaves_no_file_that_looks_complete(tmp_path):
    with pytest.raises(ZeroDivisionError), LogWriter(tmp_path / "a.mcap") as log:
        append_mounting(log, np.eye(4))
        assert not (tmp_path / "a.mcap").exists()
        _ = 1 / 0
    assert list(tmp_path.iterdir()) == []


def test_an_existing_file_is_replaced_only_on_demand_and_a_directory_never(tmp_path):
    path = tmp_path / "a.mcap"
    path.write_bytes(b"precious")
    for taken, words in ((path, "exists"), (tmp_path, "is a directory")):
        with pytest.raises(InputError, match=words):
            LogWriter(taken)
    assert path.read_bytes() == b"precious"
    with LogWriter(path, force=True) as log:
        append_mounting(log, np.eye(4))
    assert len(list(decoded(path))) == 1


def test_a_point_before_the_stamp_does_not_fit_an_unsigned_time(tmp_path):
    with pytest.raises(InputError, match="time_field='time'"), LogWriter(tmp_path / "a.mcap") as log:
        log.point_cloud("/points", STAMP_NS, "lidar", np.zeros((2, 3)), times_s=np.array([-0.05, 0.0]))
