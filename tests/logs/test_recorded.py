"""Logs as other people's writers record them: messages of every kind in MCAP, bags of ROS 1 and 2, their parts."""

import json
import shutil
import struct

import numpy as np
import pytest
from foxglove import Channel, Schema
from foxglove import messages as fox
from foxglove.channels import FrameTransformsChannel, PoseInFrameChannel
from mcap.writer import Writer

from scanchain import lie
from scanchain.errors import InputError
from scanchain.logs import open_log
from tests.support import recorders
from tests.support.naive_logs import office, write
from tests.support.recorders import (
    ROS1,
    ROS2,
    SECOND,
    STAMP_NS,
    Ros,
    assert_clouds,
    assert_planar,
    read,
    read_undamaged,
)


def assert_drive(log, scans):
    assert_planar(scans)
    assert (log.dimension, log.topic, log.odometry_topic, log.scan_count) == (2, "/scan", "/odom", 3)
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.25, 0.0, 0.5), atol=1e-12)
    for k, scan in enumerate(scans):
        assert scan.log_time_ns == scan.stamp_ns
        np.testing.assert_allclose(scan.T_odom_base, lie.pose_2d(0.1 * k, 0.0, 0.01 * k), atol=1e-12)


@pytest.mark.parametrize("store", [ROS1, ROS2], ids=["ros1", "ros2"])
def test_scans_clouds_wheels_and_mounting_of_either_ros_are_read(tmp_path, store):
    ros = Ros(store)
    assert_drive(*read_undamaged(recorders.mcap_of(tmp_path / "drive.mcap", ros, ros.drive())))
    log, scans = read_undamaged(recorders.mcap_of(tmp_path / "sweeps.mcap", ros, ros.sweeps()))
    assert log.dimension == 3
    assert_clouds(scans)
    for package in ("livox_ros_driver2", "livox_ros_driver"):
        kind = f"{package}/msg/CustomMsg"
        told = [("/livox", kind, cloud.stamp_ns, ros.livox(cloud, package)) for cloud in recorders.clouds()]
        log, scans = read_undamaged(recorders.mcap_of(tmp_path / f"{package}.mcap", ros, told))
        assert log.dimension == 3 and "offset_time" in " ".join(log.notes)
        assert_clouds(scans)
    kind = "sensor_msgs/msg/MultiEchoLaserScan"
    told = [("/echoes", kind, scan.stamp_ns, ros.multi_echo(scan)) for scan in recorders.planar()]
    assert_planar(read_undamaged(recorders.mcap_of(tmp_path / "echoes.mcap", ros, told))[1])


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_ros_1_bag_is_a_log(tmp_path, compression):
    assert_drive(*read_undamaged(recorders.bag1_of(tmp_path / "a.bag", Ros(ROS1).drive(), compression)))


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("compression", ["NONE", "FILE", "MESSAGE"])
def test_the_folder_of_a_ros_2_bag_and_its_db3_alone_are_logs(tmp_path, plugin, compression):
    folder = recorders.bag2_of(tmp_path / "a", Ros(ROS2).drive(), plugin=plugin, compression=compression)
    assert_drive(*read_undamaged(folder))
    if (plugin, compression) == ("SQLITE3", "NONE"):
        assert_drive(*read_undamaged(folder / "a.db3"))
    if compression == "MESSAGE":
        with pytest.raises(InputError, match="is compressed: give the folder of the bag"):
            read_undamaged(folder / ("a.db3" if plugin == "SQLITE3" else "a.mcap"))


@pytest.mark.parametrize(
    ("said", "dimension", "check", "limits"),
    [
        (recorders.planar(), 2, assert_planar, {"min_range_m": 0.25, "max_range_m": 30.0}),  # Foxglove tells none
        (recorders.clouds(), 3, assert_clouds, {}),
    ],
    ids=["scans", "clouds"],
)
@pytest.mark.parametrize("make", ["protobuf", "json", "python"])
def test_foxglove_messages_are_the_same_in_protobuf_and_json(tmp_path, make, said, dimension, check, limits):
    write_log = recorders.foxglove_protobuf if make == "protobuf" else recorders.foxglove_json
    path = write_log(tmp_path / "a.mcap", said, **({"literal_nan": True} if make == "python" else {}))
    log, scans = read_undamaged(path, **limits)
    assert (log.dimension, log.topic) == (dimension, "/lidar")
    check(scans)


def test_a_foxglove_cloud_is_moved_to_where_its_pose_says(tmp_path):
    half = np.sqrt(0.5)
    pose = fox.Pose(
        position=fox.Vector3(x=1.0, y=2.0, z=3.0), orientation=fox.Quaternion(x=0, y=0, z=half, w=half)
    )
    _, scans = read_undamaged(recorders.foxglove_protobuf(tmp_path / "a.mcap", recorders.clouds(), pose))
    for scan, cloud in zip(scans, recorders.clouds(), strict=True):
        rows = cloud.rows[1:]
        expected = np.column_stack([1.0 - rows["y"], 2.0 + rows["x"], 3.0 + rows["z"]])
        np.testing.assert_allclose(scan.points, expected, atol=1e-5)
    _, scans = read_undamaged(recorders.foxglove_protobuf(tmp_path / "b.mcap", recorders.planar(), pose))
    _, plain = read_undamaged(recorders.foxglove_protobuf(tmp_path / "c.mcap", recorders.planar()))
    expected = np.column_stack([1.0 - plain[0].points[:, 1], 2.0 + plain[0].points[:, 0]])
    np.testing.assert_allclose(scans[0].points, expected, atol=1e-5)


@pytest.mark.parametrize("form", ["protobuf", "json"])
def test_foxglove_poses_and_transforms_are_wheels_and_mounting(tmp_path, form):
    path = tmp_path / "a.mcap"
    half = np.sin(0.25), np.cos(0.25)
    place, turn = {"x": 0.25, "y": 0.0, "z": 0.0}, {"x": 0.0, "y": 0.0, "z": half[0], "w": half[1]}
    context = recorders.Context()
    with recorders.open_mcap(path, context=context):
        recorders.LaserScanChannel("/lidar", context=context).log(
            recorders.foxglove_scan(recorders.planar(1)[0]), log_time=STAMP_NS
        )
        if form == "protobuf":
            position, orientation = fox.Vector3(**place), fox.Quaternion(**turn)
            pose = fox.Pose(position=position, orientation=orientation)
            stamp = fox.Timestamp(sec=STAMP_NS // SECOND, nsec=0)
            wheels = fox.PoseInFrame(timestamp=stamp, frame_id="odom", pose=pose)
            PoseInFrameChannel("/wheels", context=context).log(wheels, log_time=STAMP_NS)
            transform = fox.FrameTransform(
                timestamp=stamp, parent_frame_id="base_link", child_frame_id="laser",
                translation=position, rotation=orientation,
            )  # fmt: skip
            tree = fox.FrameTransforms(transforms=[transform])
            FrameTransformsChannel("/tf_static", context=context).log(tree, log_time=STAMP_NS)
        else:
            stamp = {"sec": STAMP_NS // SECOND, "nsec": 0}
            told = {"timestamp": stamp, "frame_id": "odom", "pose": {"position": place, "orientation": turn}}
            json_channel("foxglove.PoseInFrame", "/wheels", context).log(told, log_time=STAMP_NS)
            told = {"timestamp": stamp, "parent_frame_id": "base_link", "child_frame_id": "laser"}
            told |= {"translation": place, "rotation": turn}
            json_channel("foxglove.FrameTransform", "/tf_static", context).log(told, log_time=STAMP_NS)
    log, (scan,) = read_undamaged(path, odometry_topic="/wheels")
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.25, 0.0, 0.5), atol=1e-12)
    np.testing.assert_allclose(scan.T_odom_base, lie.pose_2d(0.25, 0.0, 0.5), atol=1e-12)


def test_a_foxglove_transform_that_is_no_pose_is_named(tmp_path):
    told = {"timestamp": {"sec": 5, "nsec": 0}, "parent_frame_id": "base_link", "child_frame_id": "laser"}
    told |= {"translation": {"x": np.nan, "y": 0.0, "z": 0.0}, "rotation": dict(x=0.0, y=0.0, z=0.0, w=1.0)}
    context = recorders.Context()
    with recorders.open_mcap(tmp_path / "a.mcap", context=context):
        scan = recorders.foxglove_scan(recorders.planar(1)[0])
        recorders.LaserScanChannel("/lidar", context=context).log(scan, log_time=STAMP_NS)
        json_channel("foxglove.FrameTransform", "/tf_static", context).log(told, log_time=STAMP_NS)
    log = open_log(tmp_path / "a.mcap")
    assert log.stated_mounting is None and "base_link → laser is no pose" in log.notes[0]


def json_channel(name, topic, context):
    schema = Schema(name=name, encoding="jsonschema", data=b'{"type": "object"}')
    return Channel(topic, schema=schema, message_encoding="json", context=context)


def test_every_foxglove_number_type_has_its_own_code(tmp_path):
    """Foxglove counts unsigned first, PointField signed first; a mix-up turns 200 into -56."""
    row = np.dtype([("x", "<i1"), ("y", "<u1"), ("z", "<i2"), ("t", "<u2"), ("a", "<i4"), ("b", "<f8")])
    kinds = fox.PackedElementFieldNumericType
    codes = [kinds.Int8, kinds.Uint8, kinds.Int16, kinds.Uint16, kinds.Int32, kinds.Float64]
    fields = [
        fox.PackedElementField(name=name, offset=row.fields[name][1], type=code)
        for name, code in zip(row.names, codes, strict=True)
    ]
    rows = np.array([(-100, 200, -30000, 60000, 1, 1.0), (100, 250, 30000, 0, 2, 2.0)], row)
    cloud = fox.PointCloud(
        timestamp=fox.Timestamp(sec=5, nsec=0), point_stride=row.itemsize, fields=fields, data=rows.tobytes()
    )
    context = recorders.Context()
    with recorders.open_mcap(tmp_path / "a.mcap", context=context):
        recorders.PointCloudChannel("/c", context=context).log(cloud, log_time=5 * SECOND)
    (scan,) = read_undamaged(tmp_path / "a.mcap", point_times="us")[1]
    np.testing.assert_array_equal(scan.points, [[-100, 200, -30000], [100, 250, 30000]])
    np.testing.assert_allclose(scan.times_s, [0.06, 0.0])


def one_message(path, name, language, encoding, data, definition=b""):
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        channel = writer.register_channel("/x", encoding, writer.register_schema(name, language, definition))
        writer.add_message(channel, STAMP_NS, data, STAMP_NS)
        writer.finish()
    return path


@pytest.mark.parametrize(
    ("name", "language", "encoding"),
    [
        ("velodyne_msgs/msg/VelodyneScan", "ros2msg", "cdr"),
        ("foxglove.LaserScan", "flatbuffer", "flatbuffer"),
        ("sensor_msgs/LaserScan", "jsonschema", "json"),
    ],
)
def test_a_type_that_is_unknown_is_named(tmp_path, name, language, encoding):
    path = one_message(tmp_path / "a.mcap", name, language, encoding, b"x")
    with pytest.raises(InputError) as error:
        open_log(path)
    text = str(error.value)
    assert "/x" in text and name.replace("/msg/", "/") in text and "foxglove.PointCloud" in text
    assert encoding == "cdr" or f"in {encoding}" in text


@pytest.mark.parametrize(
    ("language", "encoding", "data", "complaint"),
    [
        ("jsonschema", "json", b"{", "not JSON"),
        ("jsonschema", "json", b'{"ranges": "no"}', "does not match its type"),
        ("jsonschema", "json", b"[" * 100_000, "does not match its type"),
        ("protobuf", "protobuf", b"\xff\xff\xff", r"its schema foxglove\.LaserScan is broken"),
        ("ros1msg", "ros1", b"\xff" * 40, ""),
    ],
)
def test_a_message_that_is_malformed_is_refused_in_one_line(tmp_path, language, encoding, data, complaint):
    name = "sensor_msgs/LaserScan" if encoding == "ros1" else "foxglove.LaserScan"
    path = one_message(tmp_path / "a.mcap", name, language, encoding, data, b"\xffno schema")
    with pytest.raises(InputError, match=f"scan 0 of /x is malformed: .*{complaint}"):
        list(open_log(path).scans())


@pytest.mark.parametrize("kind", ["bag", "mcap", "db3"])
def test_parts_in_a_folder_are_one_log_in_natural_order(tmp_path, kind):
    ros = Ros(ROS1 if kind == "bag" else ROS2)
    drive, folder = list(ros.drive()), tmp_path / "parts"
    folder.mkdir()
    for name, part in (("run_2", drive[:3]), ("run_10", drive[3:])):
        path = folder / f"{name}.{kind}"
        if kind == "bag":
            recorders.bag1_of(path, part)
        elif kind == "mcap":
            recorders.mcap_of(path, ros, part)
        else:
            shutil.move(recorders.bag2_of(tmp_path / name, part) / path.name, path)
    log, scans = read_undamaged(folder)
    assert_drive(log, scans)
    assert [path.stem for path in log.paths] == ["run_2", "run_10"]


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_bag_of_many_chunks_gives_each_scan_once_in_order(tmp_path, compression):
    path, sweeps = many_chunks(tmp_path, compression)
    log, scans = read_undamaged(path)
    assert len(log.indexes[0].blocks) > 10
    assert_clouds(scans, sweeps)
    log, scans = read_undamaged(path, start_s=2.0, end_s=3.0)
    assert log.scan_count == len(scans) == 9
    assert_clouds(scans, sweeps[16:25])


def many_chunks(folder, compression=None):
    """Sixty sweeps, a few in each chunk."""
    sweeps, ros = recorders.clouds(60), Ros(ROS1)
    told = ros.sweeps(sweeps)
    return recorders.bag1_of(folder / "a.bag", told, compression, chunk_bytes=3000), sweeps


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_bag_that_was_cut_off_is_read_up_to_the_cut(tmp_path, compression):
    path, sweeps = many_chunks(tmp_path, compression)
    whole, counts = path.read_bytes(), []
    for length in range(9000, len(whole), 1511):
        path.write_bytes(whole[:length])
        log = open_log(path)
        scans = list(log.scans())
        assert_clouds(scans, sweeps[: len(scans)])
        assert "truncated" in log.damage[0] and f"{len(scans)} scans of /points were recovered" in log.damage[-1]
        counts.append(len(scans))
    assert counts == sorted(counts) and counts[0] < 9 and counts[-1] == 60


def test_a_bag_whose_recording_never_ended_is_read_whole(tmp_path):
    path, sweeps = many_chunks(tmp_path)
    whole = path.read_bytes()
    (index_at,) = struct.unpack_from("<Q", whole, whole.index(b"index_pos=") + 10)
    path.write_bytes(whole[:index_at].replace(struct.pack("<Q", index_at), bytes(8), 1))  # as in a .bag.active
    assert_clouds(read_undamaged(path)[1], sweeps)


def test_a_damaged_chunk_of_a_bag_is_left_out_and_told(tmp_path):
    path, sweeps = many_chunks(tmp_path, "BZ2")
    content = bytearray(path.read_bytes())
    content[content.index(b"compression=bz2", len(content) // 2) + 300] ^= 1
    path.write_bytes(content)
    log = open_log(path)
    scans = list(log.scans())
    assert 55 <= len(scans) < 60 and len(log.damage) == 2
    assert "the chunk at byte" in log.damage[0] and "it is skipped" in log.damage[0]
    assert {scan.stamp_ns for scan in scans} <= {cloud.stamp_ns for cloud in sweeps}


def test_a_chunk_of_a_bag_that_claims_to_be_huge_is_not_believed(tmp_path):
    path, _ = many_chunks(tmp_path, "BZ2")
    content = bytearray(path.read_bytes())
    place = content.index(b"size=", 5000) + 5
    content[place : place + 4] = struct.pack("<I", 2**32 - 1)
    path.write_bytes(content)
    log = open_log(path)
    assert 50 <= len(list(log.scans())) < 60 and "4294967295 bytes, more than is accepted" in log.damage[0]


def test_an_encrypted_bag_says_so(tmp_path):
    path, _ = many_chunks(tmp_path)
    content = path.read_bytes()
    field = struct.pack("<I", 21) + b"encryptor=rosbag/aes\0"
    (size,) = struct.unpack_from("<I", content, 13)
    head = struct.pack("<I", size + len(field)) + field
    path.write_bytes(content[:13] + head + content[17:])
    with pytest.raises(InputError, match="is encrypted"):
        read_undamaged(path)


def test_of_packed_messages_only_the_one_that_is_damaged_is_lost(tmp_path, monkeypatch):
    monkeypatch.setattr("scanchain.logs.formats.ros2_bag._BLOCK_BYTES", 4000)
    sweeps, ros = recorders.clouds(30), Ros(ROS2)
    folder = recorders.bag2_of(tmp_path / "a", ros.sweeps(sweeps), compression="MESSAGE")
    log, scans = read_undamaged(folder)
    assert_clouds(scans, sweeps)
    assert len(log.indexes[0].blocks) > 5
    path, magic = folder / "a.db3", b"\x28\xb5\x2f\xfd"  # of zstd, with which each message begins
    frames = path.read_bytes().split(magic)
    assert len(frames) == 31
    path.write_bytes(magic.join(frames[:12]) + b"\0\0\0\0" + magic.join(frames[12:]))
    log = open_log(folder)
    scans = list(log.scans())
    stamps = {scan.stamp_ns for scan in scans}
    assert len(scans) == 29
    assert_clouds(scans, [sweep for sweep in sweeps if sweep.stamp_ns in stamps])
    assert "1 of 30 scans" in log.damage[0] and "cannot be decompressed" in log.damage[0]


def test_metadata_that_is_no_yaml_or_lacks_its_files_is_told(tmp_path):
    (tmp_path / "metadata.yaml").write_text("a: [")
    with pytest.raises(InputError, match=r"metadata\.yaml: is not that of a ROS 2 bag"):
        read_undamaged(tmp_path)
    folder = recorders.bag2_of(tmp_path / "bag", Ros(ROS2).drive())
    (folder / "bag.db3").unlink()
    with pytest.raises(InputError, match="database files are missing"):
        read_undamaged(folder)


def test_a_path_in_metadata_leads_nowhere_else(tmp_path):
    folder = recorders.bag2_of(tmp_path / "bag", Ros(ROS2).drive(), plugin="MCAP")
    outside = write(tmp_path / "outside.mcap", office(2))
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("bag.mcap", f"../{outside.name}"))
    with pytest.raises(InputError):
        read_undamaged(folder)


def test_nanoseconds_of_a_foxglove_stamp_in_json_have_the_name_of_ros_too(tmp_path):
    path = recorders.foxglove_json(tmp_path / "a.mcap", recorders.planar())
    stamps_ns = [scan.stamp_ns for scan in read(path)[1]]
    path.write_bytes(b"")
    dumps = json.dumps
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorders.json, "dumps", lambda told: dumps(told).replace('"nsec"', '"nanosec"'))
        _, scans = read(recorders.foxglove_json(path, recorders.planar()))
    assert [scan.stamp_ns for scan in scans] == stamps_ns and any(stamp_ns % SECOND for stamp_ns in stamps_ns)
