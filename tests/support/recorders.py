"""The same few scans as other people's writers record them: rosbags, the mcap packages, foxglove-sdk, open3d."""

import base64
import json
from dataclasses import dataclass

import numpy as np
from foxglove import Context, open_mcap
from foxglove import messages as fox
from foxglove.channels import LaserScanChannel, PointCloudChannel
from mcap.writer import Writer
from rosbags import rosbag1, rosbag2
from rosbags.typesys import get_types_from_msg

from scanchain.config import LogConfig
from scanchain.logs import open_log
from tests.support import naive_logs
from tests.support.naive_logs import ROS1, ROS2, SECOND, STAMP_NS, Said

FIRST_RAD, STEP_RAD = np.float32(-1.0), np.float32(0.03125)  # exact in binary, so that other formats can tell them
RANGE_MIN_M, RANGE_MAX_M = np.float32(0.25), np.float32(30.0)
POINT = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("t", "<u4")])


@dataclass
class Planar:
    """A laser scan: ranges with every kind of beam that did not return."""

    stamp_ns: int
    ranges: np.ndarray

    @property
    def returned(self):
        return (self.ranges >= RANGE_MIN_M) & (self.ranges < RANGE_MAX_M)


@dataclass
class Cloud:
    """A cloud with a time for each point, in nanoseconds after the stamp; the first point is NaN."""

    stamp_ns: int
    rows: np.ndarray


def planar(count=3, beams=65):
    rng = np.random.default_rng(1)
    scans = [Planar(STAMP_NS + k * SECOND // 8, rng.uniform(0.3, 20.0, beams).astype("f4")) for k in range(count)]
    for scan in scans:
        scan.ranges[[3, 7, 11]] = np.inf, np.nan, 0.0
    return scans


def clouds(count=3, points=50):
    rng = np.random.default_rng(2)
    told = []
    for k in range(count):
        rows = np.empty(points, POINT)
        for name in "xyz":
            rows[name] = rng.uniform(-20.0, 20.0, points)
        rows["t"] = np.linspace(0, 90_000_000, points)
        rows["x"][0] = np.nan
        told.append(Cloud(STAMP_NS + k * SECOND // 8, rows))
    return told


def read(*paths, **config):
    """A log and its scans."""
    log = open_log(list(paths), LogConfig(**config))
    return log, list(log.scans())


def read_undamaged(path, **config):
    log, scans = read(path, **config)
    assert log.damage == []
    return log, scans


def assert_planar(scans):
    """The scans are those of ``planar``, to the last bit."""
    said = planar()
    assert [scan.stamp_ns for scan in scans] == [each.stamp_ns for each in said]
    for scan, each in zip(scans, said, strict=True):
        angles = float(FIRST_RAD) + float(STEP_RAD) * np.arange(len(each.ranges))
        directions = np.column_stack([np.cos(angles), np.sin(angles)]).astype("f4")
        expected = directions[each.returned] * each.ranges[each.returned, None]
        assert scan.points.dtype == np.float32
        np.testing.assert_array_equal(scan.points, expected)
        assert scan.dropped == len(each.ranges) - np.count_nonzero(each.returned)


def assert_clouds(scans, said=None, *, timed=True):
    """The scans are those that were told, to the last bit."""
    said = clouds() if said is None else said
    assert len(scans) == len(said)
    for scan, each in zip(scans, said, strict=True):
        rows = each.rows[1:]
        np.testing.assert_array_equal(scan.points, np.column_stack([rows[name] for name in "xyz"]))
        assert scan.points.dtype == np.float32 and scan.dropped == 1
        assert scan.stamp_ns == each.stamp_ns
        if timed:
            np.testing.assert_allclose(scan.times_s, rows["t"] * 1e-9, atol=1e-9)


# ROS, by rosbags

_CUSTOM_POINT = "uint32 offset_time\nfloat32 x\nfloat32 y\nfloat32 z\nuint8 reflectivity\nuint8 tag\nuint8 line\n"
_CUSTOM = "std_msgs/Header header\nuint64 timebase\nuint32 point_num\nuint8 lidar_id\nuint8[3] rsvd\n"
for store in (ROS1, ROS2):
    for package in ("livox_ros_driver2", "livox_ros_driver"):
        store.register(get_types_from_msg(_CUSTOM_POINT, f"{package}/msg/CustomPoint"))
        store.register(get_types_from_msg(_CUSTOM + "CustomPoint[] points\n", f"{package}/msg/CustomMsg"))


class Ros(naive_logs.Ros):
    """The scans and clouds as messages."""

    def scan(self, scan, ranges=None, kind="LaserScan"):
        given = {"first": FIRST_RAD, "step": STEP_RAD, "low": RANGE_MIN_M, "high": RANGE_MAX_M, "kind": kind}
        return self.laser_scan(scan.stamp_ns, scan.ranges if ranges is None else ranges, **given)

    def multi_echo(self, scan):
        """One, two or no echo a beam; the first is the range that was told."""
        echoes = []
        for beam, value in enumerate(scan.ranges):
            echo = np.array([value, value + 1.0][: 1 + beam % 2] if np.isfinite(value) else [], "f4")
            echoes.append(self.new("sensor_msgs/msg/LaserEcho", echoes=echo))
        return self.scan(scan, echoes, "MultiEchoLaserScan")

    def livox(self, cloud, package):
        points = [
            self.new(
                f"{package}/msg/CustomPoint", offset_time=int(row["t"]), x=row["x"], y=row["y"], z=row["z"],
                reflectivity=9, tag=1, line=2,
            )
            for row in cloud.rows
        ]  # fmt: skip
        return self.new(
            f"{package}/msg/CustomMsg", header=self.header(cloud.stamp_ns, "livox_frame"), timebase=cloud.stamp_ns,
            point_num=len(points), lidar_id=1, rsvd=np.zeros(3, np.uint8), points=points,
        )  # fmt: skip

    def drive(self):
        """The planar scans with wheels and mounting: (topic, type, log time, message)."""
        mounting = self.transforms(("base_link", "laser", 0.25, 0.0, 0.5, 0.0), stamp_ns=STAMP_NS)
        yield "/tf_static", "tf2_msgs/msg/TFMessage", STAMP_NS, mounting
        for k, scan in enumerate(planar()):
            odometry = self.odometry(scan.stamp_ns, 0.1 * k, yaw=0.01 * k)
            yield "/odom", "nav_msgs/msg/Odometry", scan.stamp_ns, odometry
            yield "/scan", "sensor_msgs/msg/LaserScan", scan.stamp_ns, self.scan(scan)

    def sweeps(self, told=None):
        """Clouds: (topic, type, log time, message)."""
        for cloud in clouds() if told is None else told:
            message = self.point_cloud(cloud.stamp_ns, cloud.rows)
            yield "/points", "sensor_msgs/msg/PointCloud2", cloud.stamp_ns, message


def mcap_of(path, ros, told):
    """Messages of ROS in an MCAP that the mcap package writes."""
    said = [Said(topic, kind, time_ns, ros.serialize(message, kind)) for topic, kind, time_ns, message in told]
    rename = (lambda kind: kind.replace("/msg/", "/")) if ros.is_ros1 else str
    return naive_logs.write(path, said, ros=ros, rename=rename, chunk_size=1 << 20)


def bag1_of(path, told, compression=None, *, chunk_bytes=None):
    """A ROS 1 bag."""
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = chunk_bytes or writer.chunk_threshold
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    return _bag_of(path, writer, Ros(ROS1), told)


def bag2_of(folder, told, *, plugin="SQLITE3", compression="NONE"):
    """The folder of a ROS 2 bag."""
    writer = rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin[plugin])
    if compression != "NONE":
        writer.set_compression(rosbag2.CompressionMode[compression], rosbag2.CompressionFormat.ZSTD)
    return _bag_of(folder, writer, Ros(ROS2), told)


def _bag_of(path, writer, ros, told):
    with writer:
        connections = {}
        for topic, type_name, time_ns, message in told:
            if topic not in connections:
                connections[topic] = writer.add_connection(topic, type_name, typestore=ros.store)
            writer.write(connections[topic], time_ns, ros.serialize(message, type_name))
    return path


# Foxglove, by foxglove-sdk


def foxglove_scan(scan, pose=None):
    last = float(FIRST_RAD) + float(STEP_RAD) * (len(scan.ranges) - 1)
    return fox.LaserScan(
        timestamp=_fox_time(scan.stamp_ns), frame_id="laser", pose=pose, start_angle=float(FIRST_RAD),
        end_angle=last, ranges=scan.ranges.astype(float).tolist(),
    )  # fmt: skip


def foxglove_cloud(cloud, pose=None):
    kinds = fox.PackedElementFieldNumericType
    codes = {"x": kinds.Float32, "y": kinds.Float32, "z": kinds.Float32, "t": kinds.Uint32}
    fields = [
        fox.PackedElementField(name=name, offset=4 * k, type=code) for k, (name, code) in enumerate(codes.items())
    ]
    return fox.PointCloud(
        timestamp=_fox_time(cloud.stamp_ns), frame_id="lidar", pose=pose, point_stride=16, fields=fields,
        data=cloud.rows.tobytes(),
    )  # fmt: skip


def foxglove_protobuf(path, said, pose=None):
    """Scans or clouds in Protobuf."""
    context = Context()
    is_planar = isinstance(said[0], Planar)
    with open_mcap(path, context=context):
        kind = LaserScanChannel if is_planar else PointCloudChannel
        channel = kind("/lidar", context=context)
        for each in said:
            message = foxglove_scan(each, pose) if is_planar else foxglove_cloud(each, pose)
            channel.log(message, log_time=each.stamp_ns)
    return path


def foxglove_json(path, said, *, literal_nan=False):
    """Scans or clouds in JSON; a range that is no number is null, or the NaN that Python writes."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        name = "foxglove.LaserScan" if isinstance(said[0], Planar) else "foxglove.PointCloud"
        schema = writer.register_schema(name, "jsonschema", b'{"type": "object"}')
        channel = writer.register_channel("/lidar", "json", schema)
        for each in said:
            data = json.dumps(_as_json(each, literal_nan=literal_nan)).encode()
            writer.add_message(channel, each.stamp_ns, data, each.stamp_ns)
        writer.finish()
    return path


def _as_json(each, *, literal_nan):
    turn = {"x": 0, "y": 0, "z": 0, "w": 1}
    told = {
        "timestamp": {"sec": each.stamp_ns // SECOND, "nsec": each.stamp_ns % SECOND},
        "frame_id": "lidar",
        "pose": {"position": {"x": 0, "y": 0, "z": 0}, "orientation": turn},
    }
    if isinstance(each, Cloud):
        codes = {"x": 7, "y": 7, "z": 7, "t": 5}
        fields = [{"name": name, "offset": 4 * k, "type": code} for k, (name, code) in enumerate(codes.items())]
        return told | {"point_stride": 16, "fields": fields, "data": base64.b64encode(each.rows).decode()}
    ranges = [value if literal_nan or np.isfinite(value) else None for value in each.ranges.astype(float).tolist()]
    last = float(FIRST_RAD) + float(STEP_RAD) * (len(ranges) - 1)
    return told | {"start_angle": float(FIRST_RAD), "end_angle": last, "ranges": ranges, "intensities": []}


def _fox_time(stamp_ns):
    return fox.Timestamp(sec=stamp_ns // SECOND, nsec=stamp_ns % SECOND)
