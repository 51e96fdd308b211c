"""Bad input: one line that says what, where and what to do; damage: recovered, counted and told."""

import cProfile
import gzip
import pstats
import re
import struct

import numpy as np
import pytest
import zstandard

from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from tests.support.fuzzing import within_bounds
from tests.support.messages import says
from tests.support.naive_logs import (
    SECOND,
    STAMP_NS,
    cloud_said,
    laser_scan,
    odometry,
    odometry_said,
    office,
    point_cloud,
    scan_said,
    write,
)
from tests.support.scenes import shared_data


def complaint(*paths, **config):
    """The one line that opening and reading ends with."""
    with pytest.raises(InputError) as caught:
        list(open_log(list(paths), LogConfig(**{"max_bad_scans_percent": 0.0} | config)).scans())
    text = str(caught.value)
    assert "\n" not in text and str(paths[-1]) in text, text
    return text


def records_of(content):
    """Records of an MCAP file up to the end of its data."""
    at = 8
    while content[at] != 15:
        end = at + 9 + struct.unpack_from("<Q", content, at + 1)[0]
        yield content[at:end]
        at = end


@pytest.mark.parametrize("opcode", [1, 2, 3, 4, 7, 8, 9, 10, 11, 12, 13, 14, 0x90])
def test_a_chunk_whose_opcode_is_damaged_is_read_all_the_same_and_told(tmp_path, opcode):
    whole = write(tmp_path / "a.mcap", office(40)).read_bytes()
    header, *chunks = [record for record in records_of(whole) if record[0] in (1, 6)]
    assert len(chunks) > 2
    before = b"".join([whole[:8], header, *chunks[:-2]])
    (tmp_path / "b.mcap").write_bytes(before + bytes([opcode]) + chunks[-2][1:] + chunks[-1])
    log = open_log([tmp_path / "b.mcap"])
    assert len(list(log.scans())) == 40
    says(" ".join(log.damage), f"at byte {len(before)} is marked as another record")


# bad input


@pytest.mark.parametrize("content", [b"x", b"\x89MCAP", b"\x89MCAP0\r", b"{}", b"\0" * 100])
def test_a_file_that_is_no_log(tmp_path, content):
    (tmp_path / "a.mcap").write_bytes(content)
    says(complaint(tmp_path / "a.mcap"), "is not a recognized log", repr(content[:8]), "give MCAP")


@pytest.mark.parametrize("name", ["README.md", "a.log", "a.log.gz"])
def test_a_text_that_is_no_log_is_not_called_a_carmen_log(tmp_path, name):
    text = b"# A title\n\nSome words.\n"
    (tmp_path / name).write_bytes(gzip.compress(text) if name.endswith(".gz") else text)
    says(
        complaint(tmp_path / name), f"{name}: is not a recognized log (text without a line of FLASER", "give MCAP"
    )


@pytest.mark.parametrize(
    "first", ["VERTEX_SE2 0 0 0 0", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "EDGE2 0 1 1 0 0", "FIX 0"]
)
def test_a_pose_graph_is_sent_to_optimize(tmp_path, first):
    (tmp_path / "a.g2o").write_text(f"{first}\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    says(complaint(tmp_path / "a.g2o"), "a.g2o: is a pose graph, no log; give it to scanchain optimize")


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"#ROSBAG V2.0\n", "holds: none"),
        (b"#ROSBAG V2.0\n" * 10, "damaged to its end, at byte 13"),
        (b"#ROSBAG V1.2\n", "rosbag migrate"),
        (b"SQLite format 3\0", "cannot be read as a ROS bag"),
    ],
)
def test_a_bag_that_is_none(tmp_path, content, said):
    (tmp_path / "a.mcap").write_bytes(content)
    says(complaint(tmp_path / "a.mcap"), said)


def test_the_magic_and_nothing_else(tmp_path):
    (tmp_path / "a.mcap").write_bytes(b"\x89MCAP0\r\n")
    says(complaint(tmp_path / "a.mcap"), "no lidar topic")


def test_a_second_file_that_is_bad_is_the_one_named(tmp_path):
    good = write(tmp_path / "good.mcap", office(2))
    says(complaint(good, tmp_path / "absent.mcap"), "no such file")


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    from pathlib import Path

    path = write(tmp_path / "a.mcap", office(2))

    def refuse(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(Path, "open", refuse)
    says(complaint(path), "Permission denied")


def test_no_files_at_all():
    with pytest.raises(InputError, match="no "):
        open_log([], LogConfig())


def test_a_log_without_lidar_lists_what_it_holds(tmp_path):
    path = write(tmp_path / "a.mcap", [odometry_said(STAMP_NS, odometry(STAMP_NS, 0.0, 0.0))])
    says(complaint(path), "lidar", "/odom", "nav_msgs/Odometry")


def test_a_log_without_messages(tmp_path):
    says(complaint(write(tmp_path / "a.mcap", [])), "no lidar topic")
    says(complaint(write(tmp_path / "b.mcap", [], announced=[scan_said(0, b"")])), "/scan")


def test_a_topic_that_is_absent_lists_what_there_is(tmp_path):
    path = write(tmp_path / "a.mcap", office(2))
    says(complaint(path, topic="/velodyne"), "/velodyne", "log__topic", "/scan", "sensor_msgs/LaserScan")


def test_a_topic_that_is_no_lidar_says_what_it_is(tmp_path):
    path = write(tmp_path / "a.mcap", office(2))
    says(complaint(path, topic="/odom"), "/odom", "nav_msgs/Odometry", "/scan")


def test_several_lidars_are_listed(tmp_path):
    said = [*office(2), scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0]), "/rear")]
    path = write(tmp_path / "a.mcap", said)
    says(complaint(path), "log__topic", "/scan", "/rear")
    log = open_log([path], LogConfig(topic="/rear"))
    assert len(list(log.scans())) == log.scan_count == 1


def test_several_logs_with_a_lidar_each_are_all_named_with_their_topics(tmp_path):
    paths = [
        write(tmp_path / f"{name}.mcap", [scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0]), f"/{name}")])
        for name in ("front", "rear", "top")
    ]
    says(complaint(*paths[:2]), f"{paths[0]} and {paths[1]}, read as one log: has several lidar topics")
    says(complaint(*paths[:2]), "/front (sensor_msgs/LaserScan) in front.mcap, /rear", ") in rear.mcap")
    for config, complained in (
        ({"topic": "/nope"}, "has no topic /nope"),
        ({"odometry_topic": "/nope", "topic": "/top"}, "/nope"),
    ):
        with pytest.raises(InputError, match=f"{paths[0]} and 2 more files, read as one log: .*{complained}"):
            open_log(paths, LogConfig(**config))


def test_an_odometry_topic_that_is_absent_is_named(tmp_path):
    path = write(tmp_path / "a.mcap", office(2))
    says(complaint(path, odometry_topic="/wheels"), "/wheels", "odometry_topic", "/odom")


def test_a_scan_of_another_encoding_is_no_lidar(tmp_path):
    path = write(tmp_path / "a.mcap", office(2), message_encoding="cbor", encoding="ros2msg")
    says(complaint(path), "lidar", "/scan", "cbor", "sensor_msgs/LaserScan")


def test_a_part_of_the_log_without_scans_says_so(tmp_path):
    path = write(tmp_path / "a.mcap", office(10))
    says(complaint(path, start_s=100.0), "/scan", "start")


XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4")]
ROWS = np.ones(6, XYZ)


def bad_cloud(folder, rows=ROWS, **lies):
    good = cloud_said(STAMP_NS, point_cloud(STAMP_NS, ROWS))
    bad = cloud_said(STAMP_NS + 1, point_cloud(STAMP_NS, rows, **lies))
    text = complaint(write(folder / "a.mcap", [good, bad]))
    says(text, "scan 1", "/points")
    return text


def test_a_cloud_without_z_lists_its_fields(tmp_path):
    says(bad_cloud(tmp_path, np.ones(6, [("x", "f4"), ("y", "f4"), ("intensity", "f4")])), " z", "intensity")


def test_a_cloud_with_too_little_data(tmp_path):
    says(bad_cloud(tmp_path, data=ROWS.tobytes()[:-1]), "71", "72")


def test_rows_with_too_little_data(tmp_path):
    says(bad_cloud(tmp_path, height=2, padding=4, data=bytes(75)), "75", "76")


def test_a_row_step_shorter_than_its_points(tmp_path):
    says(bad_cloud(tmp_path, height=2, row_step=35), "row_step 35", "36")


def test_a_field_beyond_the_point(tmp_path):
    fields = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 9, 7, 1)]
    says(bad_cloud(tmp_path, fields=fields), "z", "13", "point_step", "12")


def test_a_time_field_beyond_the_point(tmp_path):
    fields = [("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1), ("t", 12, 6, 1)]
    says(bad_cloud(tmp_path, fields=fields), "t", "16", "point_step", "12")


def test_a_field_of_an_unknown_type(tmp_path):
    fields = [("x", 0, 7, 1), ("y", 4, 9, 1), ("z", 8, 7, 1)]
    says(bad_cloud(tmp_path, fields=fields), "y", "9")


def test_a_point_step_of_zero(tmp_path):
    says(bad_cloud(tmp_path, step=0), "point_step")


def test_a_cloud_of_undefined_points_says_why(tmp_path):
    rows = np.zeros(6, XYZ)
    rows["x"][:2] = np.nan
    says(bad_cloud(tmp_path, rows), "no valid point", "2", "4", "NaN")


def test_an_empty_cloud(tmp_path):
    says(bad_cloud(tmp_path, np.ones(0, XYZ)), "no valid point")


def test_a_laser_scan_without_a_return_says_why(tmp_path):
    data = laser_scan(STAMP_NS, [np.nan, np.inf, 0.0, 40.0])
    text = complaint(write(tmp_path / "a.mcap", [scan_said(STAMP_NS, data)]))
    says(text, "scan 0", "/scan", "no valid point", "4", "30")


def test_a_laser_scan_that_claims_more_beams_than_it_has(tmp_path):
    said = [*office(2), scan_said(STAMP_NS + SECOND, laser_scan(STAMP_NS, [1.0] * 5, declared=1_000_000_000))]
    says(complaint(write(tmp_path / "a.mcap", said)), "scan 2", "/scan", "malformed")


@pytest.mark.parametrize("length", [0, 1, 3, 4, 7, 12, 20, 47])
def test_a_laser_scan_cut_short(tmp_path, length):
    data = laser_scan(STAMP_NS, [1.0] * 5)[:length] or b"\0"
    says(complaint(write(tmp_path / "a.mcap", [*office(2), scan_said(STAMP_NS + SECOND, data)])), "scan 2")


def test_a_malformed_odometry_message_is_no_reason_to_stop_but_is_told(tmp_path):
    said = [*office(5), odometry_said(STAMP_NS + SECOND, b"\0\1\0\0short")]
    log = open_log([write(tmp_path / "a.mcap", said)], LogConfig())
    assert len(list(log.scans())) == 5
    assert any("/odom" in line for line in log.damage)


# damage


def recover(path, **config):
    """Scans got from a damaged file and the damage told, or an InputError's text."""
    try:
        log = open_log([path], LogConfig(**config))
        scans = list(log.scans())
    except InputError as error:
        assert "\n" not in str(error) and str(path) in str(error)
        return [], [str(error)]
    return scans, list(log.damage)


def assert_true(scans):
    """Every recovered scan is one of those written, in order."""
    numbers = [round((scan.stamp_ns - STAMP_NS) / (SECOND // 10)) for scan in scans]
    assert numbers == sorted(set(numbers))
    for number, scan in zip(numbers, scans, strict=True):
        assert np.linalg.norm(scan.points[0]) == pytest.approx(1.0 + number / 100, abs=1e-5)


@pytest.mark.parametrize(
    ("chunked", "compression"), [(True, "none"), (True, "lz4"), (True, "zstd"), (False, "none")]
)
@pytest.mark.parametrize("summary", [True, False])
def test_a_file_cut_off_anywhere_is_read_up_to_the_cut(tmp_path, chunked, compression, summary):
    whole = write(
        tmp_path / "whole.mcap", office(), chunked=chunked, compression=compression, summary=summary
    ).read_bytes()
    path = tmp_path / "cut.mcap"
    counts = []
    for length in sorted(np.random.default_rng(5).integers(1, len(whole), 60)):
        path.write_bytes(whole[:length])
        scans, damage = recover(path)
        assert damage, f"cut at {length} of {len(whole)} and nothing told"
        if scans:
            assert_true(scans)
            assert any(re.search(rf"\b{len(scans)} scans?", line) for line in damage), damage
        counts.append(len(scans))
    assert counts == sorted(counts) and counts[-1] > 30


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_what_lies_before_the_cut_in_a_cut_chunk_is_recovered(tmp_path, compression):
    rng = np.random.default_rng(2)
    said = []
    for k in range(40):
        stamp_ns = STAMP_NS + k * SECOND // 10
        ranges = np.concatenate([[1.0 + k / 100], rng.uniform(1.0, 2.0, 4000)])
        said.append(scan_said(stamp_ns, laser_scan(stamp_ns, ranges, step=1e-4)))
    path = write(tmp_path / "a.mcap", said, compression=compression, chunk_size=100_000_000)
    whole = path.read_bytes()
    path.write_bytes(whole[: int(0.75 * len(whole))])
    scans, damage = recover(path)
    assert_true(scans)
    assert 10 <= len(scans) < 40 and damage
    if compression == "none":
        assert len(scans) >= 28


LIES = [2**63, 2**40, 2**31 - 1, 2**64 - 1, 0]


@pytest.mark.parametrize("chunked", [True, False])
def test_lengths_that_lie_never_ask_for_memory(tmp_path, chunked):
    whole = write(tmp_path / "whole.mcap", office(), chunked=chunked, compression="none", crcs=False).read_bytes()
    path = tmp_path / "changed.mcap"
    rng = np.random.default_rng(11)
    for at in rng.integers(8, len(whole) - 8, 150):
        changed = bytearray(whole)
        changed[at : at + 8] = struct.pack("<Q", LIES[rng.integers(len(LIES))])
        path.write_bytes(changed)
        bad, _ = within_bounds(lambda: recover(path))
        assert not bad, f"at {at}: {bad}"


def chunk_at(data, number=1):
    """Byte of a chunk's body in a file, and its length; the first chunk holds only the mounting."""
    chunks, offset = [], 8
    while len(chunks) <= number:
        length = struct.unpack_from("<Q", data, offset + 1)[0]
        chunks += [(offset + 9, length)] if data[offset] == 0x06 else []
        offset += 9 + length
    return chunks[number]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_chunk_with_a_wrong_crc_is_left_out_and_told(tmp_path, compression):
    path = write(tmp_path / "a.mcap", office(), compression=compression)
    whole = bytearray(path.read_bytes())
    begin, _ = chunk_at(whole)
    whole[begin + 24] ^= 1
    path.write_bytes(whole)
    scans, damage = recover(path)
    assert_true(scans)
    assert 20 < len(scans) < 40
    assert any("CRC" in line for line in damage)
    assert any(f"{len(scans)} scan" in line for line in damage)


def test_a_mounting_in_a_damaged_chunk_is_told(tmp_path):
    path = write(tmp_path / "a.mcap", office())
    whole = bytearray(path.read_bytes())
    begin, _ = chunk_at(whole, 0)
    whole[begin + 24] ^= 1
    path.write_bytes(whole)
    log = open_log([path], LogConfig())
    assert len(list(log.scans())) == 40
    np.testing.assert_array_equal(log.T_base_lidar, np.eye(3))
    assert any("CRC" in line for line in log.damage) and any("static transform" in note for note in log.notes)


def test_a_chunk_that_lies_about_its_size_is_rejected_before_memory_is_asked_for(tmp_path):
    path = write(tmp_path / "a.mcap", office(), crcs=False)
    whole = bytearray(path.read_bytes())
    begin, _ = chunk_at(whole)
    whole[begin + 16 : begin + 24] = struct.pack("<Q", 1 << 40)
    path.write_bytes(whole)
    scans, damage = recover(path)
    assert 20 < len(scans) < 40 and damage


def test_a_frame_that_lies_about_its_size_is_rejected_before_memory_is_asked_for(tmp_path):
    path = write(tmp_path / "a.mcap", office(), crcs=False)
    whole = path.read_bytes()
    begin, length = chunk_at(whole)
    bomb = zstandard.ZstdCompressor().compress(bytes(1 << 31))
    head = whole[begin : begin + 32] + b"zstd" + struct.pack("<Q", len(bomb))
    chunk = head + bomb
    path.write_bytes(whole[: begin - 8] + struct.pack("<Q", len(chunk)) + chunk + whole[begin + length :])
    import resource

    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    scans, damage = recover(path)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 500_000  # kilobytes
    assert 20 < len(scans) < 40 and damage


def test_an_unknown_compression_is_named(tmp_path):
    path = write(tmp_path / "a.mcap", office(), compression="zstd")
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", 4) + b"zstd", struct.pack("<I", 4) + b"zlib"))
    _, damage = recover(path)
    says(" ".join(damage), "zlib")


def test_a_real_cloud_log_cut_off_gives_the_sweeps_before_the_cut(tmp_path):
    whole = shared_data("3d/kitti_0005_first60.mcap").read_bytes()
    path = tmp_path / "cut.mcap"
    path.write_bytes(whole[:10_000_000])
    scans, damage = recover(path)
    assert 6 <= len(scans) <= 9
    assert "cut off at byte 10000000" in damage[0] and not any("is damaged" in line for line in damage)
    assert any(f"{len(scans)} scan" in line for line in damage)


def test_malformed_messages_cost_no_more_than_good_ones(tmp_path):
    rows = np.ones(1, [("x", "f4"), ("y", "f4"), ("z", "f4")])
    good = point_cloud(STAMP_NS, rows)
    paths = [
        write(
            tmp_path / f"{length}.mcap",
            [cloud_said(STAMP_NS + k, good[: length if k else None]) for k in range(3000)],
        )
        for length in (len(good), 90)
    ]
    calls = []
    for path in (*paths, *paths):  # the first time to import what is needed
        with cProfile.Profile() as profile:
            scans, _ = recover(path, max_bad_scans_percent=100.0)
        calls.append(pstats.Stats(profile).total_calls)
    assert len(scans) == 1
    assert calls[3] < 1.5 * calls[2]
