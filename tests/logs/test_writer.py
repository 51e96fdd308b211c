"""What is written is what an independent decoder reads."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.errors import InputError
from scanchain.logs.writer import Link, LogWriter, pack_laser_scan, pack_odometry, pack_transforms, place
from tests.support.naive_logs import decoded

STAMP_NS = 1_700_000_000_123_456_789


def append_mounting(log, T):
    data = pack_transforms(STAMP_NS, Link("base_link", "lidar", place(T)))
    log.append("/tf_static", "tf2_msgs/msg/TFMessage", data, STAMP_NS)


def nanoseconds(message):
    return message.header.stamp.sec * 10**9 + message.header.stamp.nanosec


def test_a_laser_scan_survives(tmp_path):
    ranges = np.array([1.5, np.inf, 29.75], dtype=np.float32)
    with LogWriter(tmp_path / "a.mcap") as log:
        data = pack_laser_scan(
            STAMP_NS, "lidar", -0.5, 0.5, ranges, range_min_m=0.1, range_max_m=30.0, time_increment_s=1e-3,
            scan_time_s=0.1,
        )  # fmt: skip
        log.append("/scan", "sensor_msgs/msg/LaserScan", data, STAMP_NS)
    ((schema, channel, message, scan),) = decoded(tmp_path / "a.mcap")
    assert (schema.name, schema.encoding) == ("sensor_msgs/msg/LaserScan", "ros2msg")
    assert schema.data.decode().count("MSG: std_msgs/Header\n") == 1, "a definition brings the types it uses"
    assert (channel.topic, channel.message_encoding) == ("/scan", "cdr")
    assert message.log_time == nanoseconds(scan) == STAMP_NS and scan.header.frame_id == "lidar"
    assert np.array_equal(np.array(scan.ranges, dtype=np.float32), ranges)
    told = scan.angle_min, scan.angle_max, scan.angle_increment, scan.time_increment, scan.scan_time
    assert (*told, scan.range_min, scan.range_max) == pytest.approx((-0.5, 0.5, 0.5, 1e-3, 0.1, 0.1, 30.0))


@pytest.mark.parametrize(("count", "time_field"), [(1000, "t"), (1000, "time"), (0, "time")])
def test_a_cloud_survives_with_its_times_and_rings(tmp_path, count, time_field):
    rng = np.random.default_rng(3)
    points = rng.normal(size=(count, 3)).astype(np.float32)
    times = np.sort(rng.uniform(0.0, 0.1, count)).astype(np.float32)
    ring = rng.integers(0, 64, count).astype(np.uint16)
    written = times if time_field == "time" else np.rint(1e9 * times.astype(float)).astype(np.uint32)
    fields = {time_field: written, "ring": ring}
    with LogWriter(tmp_path / "a.mcap") as log:
        log.point_cloud("/points", STAMP_NS, "lidar", points, fields, STAMP_NS + 5)
    ((_, _, message, cloud),) = decoded(tmp_path / "a.mcap")
    assert message.log_time == STAMP_NS + 5 and nanoseconds(cloud) == STAMP_NS
    assert (cloud.height, cloud.width, cloud.is_bigendian, cloud.is_dense) == (1, count, False, True)
    assert cloud.row_step == cloud.point_step * count == len(cloud.data)
    codes = {7: "<f4", 6: "<u4", 4: "<u2"}
    names, kinds, offsets = zip(*((f.name, codes[f.datatype], f.offset) for f in cloud.fields), strict=True)
    point = {"names": names, "formats": kinds, "offsets": offsets, "itemsize": cloud.point_step}
    rows = np.frombuffer(cloud.data, np.dtype(point))
    assert np.array_equal(np.stack([rows["x"], rows["y"], rows["z"]], axis=1), points)
    assert np.array_equal(rows["ring"], ring)
    seconds = rows["t"] * 1e-9 if time_field == "t" else rows["time"]
    np.testing.assert_allclose(seconds, times, atol=1e-9)


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
