"""Conversion to MCAP: the same scans out of it as out of the source, and what can go wrong."""

import json
from dataclasses import replace

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros1.decoder import DecoderFactory as Ros1Factory
from mcap_ros2.decoder import DecoderFactory as Ros2Factory

from scanchain.__main__ import main
from scanchain.config import LogConfig
from scanchain.logs import open_log
from tests.support import recorders
from tests.support.naive_logs import office, write
from tests.support.sectors import Cut, cut, whole
from tests.support.sensor_files import flaser, kitti_odometry, kitti_raw, odom, save, xyzi


def carmen(folder):
    return save(
        folder / "a.log",
        *[line for k in range(600) for line in (odom(k, 1.0), flaser(k, np.linspace(1.0, 2.0 + 0.01 * k, 180)))],
    )


def clouds(folder):
    folder = folder / "clouds"
    folder.mkdir()
    for cloud in recorders.clouds():
        xyzi(cloud).tofile(folder / f"{cloud.stamp_ns}.bin")
    return folder


def parts(folder):
    folder = folder / "parts"
    folder.mkdir()
    said = office(30)
    write(folder / "0.mcap", said[:31])
    write(folder / "1.mcap", said[31:])
    return folder


SOURCES = {
    "carmen": carmen,
    "kitti raw": lambda folder: kitti_raw(folder, recorders.clouds()),
    "kitti odometry": lambda folder: kitti_odometry(folder, recorders.clouds()),
    "clouds": clouds,
    "ros 1 bag": lambda folder: recorders.bag1_of(folder / "a.bag", recorders.Ros(recorders.ROS1).drive()),
    "ros 2 bag": lambda folder: recorders.bag2_of(folder / "bag", recorders.Ros(recorders.ROS2).sweeps()),
    "parts": parts,
}


def assert_same_log(ours, theirs):
    np.testing.assert_array_equal(ours.T_base_lidar, theirs.T_base_lidar)
    one, other = ((log.topic, log.odometry_topic, log.dimension, log.scan_count) for log in (ours, theirs))
    assert one == other and ours.scan_count > 0
    for one, other in zip(ours.scans(), theirs.scans(), strict=True):
        assert (one.stamp_ns, one.log_time_ns, one.dropped) == (other.stamp_ns, other.log_time_ns, other.dropped)
        assert one.points.tobytes() == other.points.tobytes() and one.times_s.tobytes() == other.times_s.tobytes()
        assert np.array_equal(one.T_odom_base, other.T_odom_base) or one.T_odom_base is other.T_odom_base is None
    assert ours.damage == theirs.damage == []
    one, other = ours.ground_truth(), theirs.ground_truth()
    assert (one is None) == (other is None)
    if one is not None:
        np.testing.assert_array_equal(one.poses, other.poses)


@pytest.mark.parametrize("source", SOURCES)
def test_a_converted_log_is_the_same_as_its_source_to_the_last_bit(tmp_path, capfd, source):
    path = SOURCES[source](tmp_path)
    assert main(["convert", str(path), str(tmp_path / "out.mcap")]) == 0
    said = capfd.readouterr().out
    assert said.startswith(f"{tmp_path / 'out.mcap'}: ")
    assert_same_log(open_log(tmp_path / "out.mcap"), open_log(path))


def test_messages_of_a_bag_stay_as_they_are_and_others_can_decode_them(tmp_path):
    for store, factory, name in ((recorders.ROS1, Ros1Factory, "ros1"), (recorders.ROS2, Ros2Factory, "ros2")):
        ros = recorders.Ros(store)
        bag = recorders.bag1_of(tmp_path / "a.bag", ros.drive()) if ros.is_ros1 else tmp_path / "bag"
        if not ros.is_ros1:
            recorders.bag2_of(bag, ros.drive())
        assert main(["convert", str(bag), str(tmp_path / f"{name}.mcap")]) == 0
        with (tmp_path / f"{name}.mcap").open("rb") as stream:
            reader = make_reader(stream, decoder_factories=[factory()])
            assert reader.get_header().profile == name
            read = list(reader.iter_decoded_messages())
        assert sorted({channel.topic for _, channel, _, _ in read}) == ["/odom", "/scan", "/tf_static"]
        told = [ros.serialize(message, kind) for _, kind, _, message in ros.drive()]
        assert sorted(message.data for _, _, message, _ in read) == sorted(told)


def test_a_rate_gives_stamps_to_files_that_are_only_numbered_and_what_cannot_be_read_is_told(tmp_path, capfd):
    (tmp_path / "scans").mkdir()
    for k, cloud in enumerate(recorders.clouds()):
        xyzi(cloud).tofile(tmp_path / "scans" / f"{k}.bin")
    words = ["convert", str(tmp_path / "scans"), str(tmp_path / "out.mcap")]
    assert main(words) == 2 and "--log.rate_hz 10" in capfd.readouterr().err
    assert main([*words, "--rate", "-1"]) == 2 and "--rate: log.rate_hz is -1" in capfd.readouterr().err
    assert not (tmp_path / "out.mcap").exists()
    assert main([*words, "--log.rate_hz", "4", "--json"]) == 0
    said = json.loads(capfd.readouterr().out)
    assert said["messages"] == {"/points": 3} and said["damage"] == []
    assert_same_log(open_log(tmp_path / "out.mcap"), open_log(tmp_path / "scans", LogConfig(rate_hz=4.0)))
    (tmp_path / "scans" / "3.bin").write_bytes(b"xyz")
    assert main([*words, "--rate", "4", "--force"]) == 0
    said = capfd.readouterr()
    assert "3 /points" in said.out and "warning: " in said.err and "3.bin" in said.err


@pytest.mark.parametrize(
    ("keys", "flags"),
    [
        (
            {"topic": "/rear", "start_s": 0.5, "end_s": 1.5, "every": 3},
            ["--log.topic=/rear", "--log.start_s=0.5", "--log.end_s=1.5", "--log.every=3"],
        ),
        ({"topic": "/scan", "start_s": 1.0, "every": 2}, ["--topic", "/scan", "--start", "1", "--every", "2"]),
    ],
)
def test_a_part_of_a_log_is_written_by_the_keys_that_a_run_takes(tmp_path, capfd, keys, flags):
    said = [*office(20), *(replace(each, topic="/rear") for each in office(20) if each.topic == "/scan")]
    source, cut = write(tmp_path / "in.mcap", sorted(said, key=lambda each: each.log_ns)), tmp_path / "out.mcap"
    assert main(["convert", str(source), str(cut), *flags]) == 0
    assert ("/rear" in capfd.readouterr().out) == (keys["topic"] == "/rear")
    assert_same_log(open_log(cut), open_log(source, LogConfig(**keys)))
    before = cut.read_bytes()
    assert main(["convert", str(source), str(cut), "--start", "99", "--force"]) == 2
    assert "no message lies after --start 99 s; the log is " in capfd.readouterr().err
    assert cut.read_bytes() == before


@pytest.mark.parametrize(
    ("words", "complaint"),
    [
        (["in.mcap", "out.mcap"], "is MCAP already"),
        (["a.log", "out.bag"], "does not end in .mcap"),
        (["absent", "out.mcap"], "no such file"),
        (["empty", "out.mcap"], "is a folder without a recognized log"),
        (["a.log", "taken.mcap"], "exists"),
        (["bad.log", "out.mcap"], "no readable message"),
        (
            ["a.log", "out.mcap", "--log.min_range_m", "1"],
            "--log.min_range_m has no meaning for convert; its keys are log.format, log.rate_hz",
        ),
    ],
)
def test_what_cannot_be_converted_is_one_line_and_leaves_nothing(tmp_path, capfd, monkeypatch, words, complaint):
    monkeypatch.chdir(tmp_path)
    write(tmp_path / "in.mcap", office(2))
    save(tmp_path / "a.log", flaser(0))
    save(tmp_path / "bad.log", f"FLASER 180 1 2 3 {1e9:.6f} nohost 0")
    (tmp_path / "empty").mkdir()
    (tmp_path / "taken.mcap").write_text("mine")
    before = sorted(tmp_path.rglob("*"))
    assert main(["convert", *words]) == 2
    said = capfd.readouterr()
    assert complaint in said.err and said.err.count("\n") == 1 and said.out == ""
    assert sorted(tmp_path.rglob("*")) == before and (tmp_path / "taken.mcap").read_text() == "mine"


def test_columns_of_bin_files_are_a_flag_of_convert_as_of_a_run(tmp_path):
    (tmp_path / "scans").mkdir()
    for k, cloud in enumerate(recorders.clouds()):
        np.column_stack([xyzi(cloud), np.zeros(len(xyzi(cloud)), "f4")]).tofile(
            tmp_path / "scans" / f"{k + 1}.0.bin"
        )
    assert main(["convert", str(tmp_path / "scans"), str(tmp_path / "out.mcap"), "--log.bin_columns", "5"]) == 0
    assert_same_log(open_log(tmp_path / "out.mcap"), open_log(tmp_path / "scans", LogConfig(bin_columns=5)))


def test_every_nth_of_messages_that_are_sectors_is_refused_as_it_leaves_holes(tmp_path, capfd):
    path = cut(whole("office", 3, "all-around"), tmp_path / "cut.mcap", Cut(90.0))
    assert main(["convert", str(path), str(tmp_path / "out.mcap"), "--every", "2"]) == 2
    assert "the messages of /scan are sectors of revolutions" in capfd.readouterr().err
    assert main(["convert", str(path), str(tmp_path / "out.mcap"), "--start", "1"]) == 0
