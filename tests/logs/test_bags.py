"""ROS 1 bags, ROS 2 bags in SQLite, and folders of the parts of a log, all written by rosbags."""

import shutil
import struct

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from tests.support import recorders
from tests.support.naive_logs import office, write
from tests.support.recorders import Ros, assert_clouds, assert_planar


def read(path, **config):
    log = open_log(path, LogConfig(**config))
    scans = list(log.scans())
    assert log.damage == []
    return log, scans


def assert_drive(log, scans):
    assert_planar(scans)
    assert (log.dimension, log.topic, log.odometry_topic, log.scan_count) == (2, "/scan", "/odom", 3)
    np.testing.assert_allclose(log.T_base_lidar, lie.pose_2d(0.25, 0.0, 0.5), atol=1e-12)
    for k, scan in enumerate(scans):
        assert scan.log_time_ns == scan.stamp_ns
        np.testing.assert_allclose(scan.T_odom_base, lie.pose_2d(0.1 * k, 0.0, 0.01 * k), atol=1e-12)


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_ros_1_bag_is_a_log(tmp_path, compression):
    drive = Ros(recorders.ROS1).drive()
    assert_drive(*read(recorders.bag1_of(tmp_path / "a.bag", drive, compression)))
    sweeps = Ros(recorders.ROS1).sweeps()
    log, scans = read(recorders.bag1_of(tmp_path / "b.bag", sweeps, compression))
    assert_clouds(scans)
    assert log.dimension == 3


@pytest.mark.parametrize("plugin", ["SQLITE3", "MCAP"])
@pytest.mark.parametrize("compression", ["NONE", "FILE", "MESSAGE"])
def test_the_folder_of_a_ros_2_bag_is_a_log(tmp_path, plugin, compression):
    drive = Ros(recorders.ROS2).drive()
    assert_drive(*read(recorders.bag2_of(tmp_path / "a", drive, plugin=plugin, compression=compression)))


def test_a_db3_alone_is_a_log(tmp_path):
    folder = recorders.bag2_of(tmp_path / "a", Ros(recorders.ROS2).drive())
    assert_drive(*read(folder / "a.db3"))


def test_parts_in_a_folder_are_one_log_in_natural_order(tmp_path):
    drive = list(Ros(recorders.ROS1).drive())
    folder = tmp_path / "parts"
    folder.mkdir()
    for name, part in (("run_2.bag", drive[:3]), ("run_10.bag", drive[3:])):
        recorders.bag1_of(folder / name, part)
    log, scans = read(folder)
    assert_drive(log, scans)
    assert [path.name for path in log.paths] == ["run_2.bag", "run_10.bag"]


def test_mcap_and_db3_parts_in_a_folder_are_one_log(tmp_path):
    said = office(20)
    folder = tmp_path / "mcap"
    folder.mkdir()
    write(folder / "0.mcap", said[:21])
    write(folder / "1.mcap", said[21:])
    assert len(read(folder)[1]) == 20
    drive = list(Ros(recorders.ROS2).drive())
    for number, part in enumerate((drive[:3], drive[3:])):
        recorders.bag2_of(tmp_path / f"part_{number}", part)
        (tmp_path / "db3").mkdir(exist_ok=True)
        shutil.move(tmp_path / f"part_{number}" / f"part_{number}.db3", tmp_path / "db3")
    assert_drive(*read(tmp_path / "db3"))


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_bag_of_many_chunks_gives_each_scan_once_in_order(tmp_path, compression):
    path, sweeps = many_chunks(tmp_path, compression)
    log, scans = read(path)
    assert len(log.indexes[0].blocks) > 10
    assert_clouds(scans, sweeps)
    log, scans = read(path, start_s=2.0, end_s=3.0)
    assert log.scan_count == len(scans) == 9
    assert_clouds(scans, sweeps[16:25])


def many_chunks(folder, compression=None):
    """Sixty sweeps, a few in each chunk."""
    sweeps, ros = recorders.clouds(60), Ros(recorders.ROS1)
    told = [("/points", "sensor_msgs/msg/PointCloud2", c.stamp_ns, ros.point_cloud(c)) for c in sweeps]
    return recorders.bag1_of(folder / "a.bag", told, compression, chunk_bytes=3000), sweeps


def test_a_db3_of_many_blocks_gives_each_scan_once_in_order(tmp_path, monkeypatch):
    monkeypatch.setattr("scanchain.logs.formats.ros2_bag._BLOCK_BYTES", 4000)
    sweeps, ros = recorders.clouds(60), Ros(recorders.ROS2)
    told = [("/points", "sensor_msgs/msg/PointCloud2", c.stamp_ns, ros.point_cloud(c)) for c in sweeps]
    log, scans = read(recorders.bag2_of(tmp_path / "a", told))
    assert len(log.indexes[0].blocks) > 10
    assert_clouds(scans, sweeps)


def test_an_empty_bag_says_so(tmp_path):
    with pytest.raises(InputError, match="no lidar topic"):
        read(recorders.bag1_of(tmp_path / "a.bag", []))


@pytest.mark.parametrize("compression", [None, "BZ2", "LZ4"])
def test_a_bag_that_was_cut_off_is_read_up_to_the_cut(tmp_path, compression):
    path, sweeps = many_chunks(tmp_path, compression)
    whole, counts = path.read_bytes(), []
    for length in range(9000, len(whole), 1511):
        path.write_bytes(whole[:length])
        log = open_log(path)
        scans = list(log.scans())
        assert_clouds(scans, sweeps[: len(scans)])
        assert "cut off" in log.damage[0] and f"{len(scans)} scans of /points were recovered" in log.damage[-1]
        counts.append(len(scans))
    assert counts == sorted(counts) and counts[0] < 9 and counts[-1] == 60


def test_a_bag_whose_recording_never_ended_is_read_whole(tmp_path):
    path, sweeps = many_chunks(tmp_path)
    whole = path.read_bytes()
    (index_at,) = struct.unpack_from("<Q", whole, whole.index(b"index_pos=") + 10)
    path.write_bytes(whole[:index_at].replace(struct.pack("<Q", index_at), bytes(8), 1))  # as in a .bag.active
    assert_clouds(read(path)[1], sweeps)


def test_a_damaged_chunk_of_a_bag_is_left_out_and_told(tmp_path):
    path, sweeps = many_chunks(tmp_path, "BZ2")
    content = bytearray(path.read_bytes())
    content[content.index(b"compression=bz2", len(content) // 2) + 300] ^= 1
    path.write_bytes(content)
    log = open_log(path)
    scans = list(log.scans())
    assert 55 <= len(scans) < 60 and len(log.damage) == 2
    assert "the chunk at byte" in log.damage[0] and "it was left out" in log.damage[0]
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
        read(path)


def test_of_a_db3_only_the_messages_that_are_damaged_are_lost(tmp_path):
    sweeps, ros = recorders.clouds(30), Ros(recorders.ROS2)
    told = [("/points", "sensor_msgs/msg/PointCloud2", c.stamp_ns, ros.point_cloud(c)) for c in sweeps]
    folder = recorders.bag2_of(tmp_path / "a", told, compression="MESSAGE")
    path = folder / "a.db3"
    frames = path.read_bytes().split(b"\x28\xb5\x2f\xfd")  # each begins with the magic of zstd
    assert len(frames) == 31
    damaged = b"\x28\xb5\x2f\xfd".join(frames[:12]) + b"\0\0\0\0" + b"\x28\xb5\x2f\xfd".join(frames[12:])
    path.write_bytes(damaged)
    log = open_log(folder)
    scans = list(log.scans())
    stamps = {scan.stamp_ns for scan in scans}
    assert len(scans) == 29
    assert_clouds(scans, [sweep for sweep in sweeps if sweep.stamp_ns in stamps])
    assert "at least 1 message from" in log.damage[0] and "29 scans" in log.damage[1]


def test_metadata_that_is_no_yaml_or_lacks_its_files_is_told(tmp_path):
    (tmp_path / "metadata.yaml").write_text("a: [")
    with pytest.raises(InputError, match=r"metadata\.yaml: is not that of a ROS 2 bag"):
        read(tmp_path)
    folder = recorders.bag2_of(tmp_path / "bag", Ros(recorders.ROS2).drive())
    (folder / "bag.db3").unlink()
    with pytest.raises(InputError, match="database files are missing"):
        read(folder)


def test_a_path_in_metadata_leads_nowhere_else(tmp_path):
    folder = recorders.bag2_of(tmp_path / "bag", Ros(recorders.ROS2).drive(), plugin="MCAP")
    outside = write(tmp_path / "outside.mcap", office(2))
    text = (folder / "metadata.yaml").read_text()
    (folder / "metadata.yaml").write_text(text.replace("bag.mcap", f"../{outside.name}"))
    with pytest.raises(InputError):
        read(folder)
