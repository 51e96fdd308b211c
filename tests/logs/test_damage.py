"""Bad input: one line that says what, where and what to do; damage: recovered, counted and told."""

import gzip
import struct

import numpy as np
import pytest

from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
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


def complaint(*paths, **config):
    """The one line that opening and reading ends with."""
    with pytest.raises(InputError) as caught:
        list(open_log(list(paths), LogConfig(**{"max_bad_scans_percent": 0.0} | config)).scans())
    text = str(caught.value)
    assert "\n" not in text and str(paths[-1]) in text, text
    return text


# bad input


def said(*messages, **options):
    """Makes a log of these messages in a folder."""
    return lambda folder: write(folder / "a.mcap", messages, **options)


def file_of(content, name="a.mcap"):
    """Makes a file of these bytes in a folder."""

    def make(folder):
        (folder / name).write_bytes(content)
        return folder / name

    return make


def rear():
    return scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0]), "/rear")


SCAN = scan_said(STAMP_NS + SECOND, laser_scan(STAMP_NS, [1.0] * 5, declared=1_000_000_000))
BLIND = scan_said(STAMP_NS, laser_scan(STAMP_NS, [np.nan, np.inf, 0.0, 40.0]))
TEXT = b"# A title\n\nSome words.\n"
EDGE = "\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n"
NO_LOG, NO_CARMEN = "is not a recognized log", "is not a recognized log (text without a line of FLASER"
GRAPH = "is a pose graph, not a log; use scanchain optimize"


@pytest.mark.parametrize(
    ("make", "config", "words"),
    [
        *((file_of(each), {}, [NO_LOG, repr(each), "give MCAP"]) for each in (b"x", b"\x89MCAP", b"{}", bytes(8))),
        (file_of(TEXT, "README.md"), {}, ["README.md: " + NO_CARMEN, "give MCAP"]),
        (file_of(gzip.compress(TEXT), "a.log.gz"), {}, ["a.log.gz: " + NO_CARMEN, "give MCAP"]),
        *(
            (file_of((first + EDGE).encode(), "a.g2o"), {}, [GRAPH])
            for first in ("VERTEX_SE2 0 0 0 0", "VERTEX_SE3:QUAT 0 0 0 0 0 0 0 1", "EDGE2 0 1 1 0 0", "FIX 0")
        ),
        (file_of(b"#ROSBAG V2.0\n"), {}, ["contains: none"]),
        (file_of(b"#ROSBAG V2.0\n" * 10), {}, ["damaged to its end, at byte 13"]),
        (file_of(b"#ROSBAG V1.2\n"), {}, ["rosbag migrate"]),
        (file_of(b"SQLite format 3\0"), {}, ["cannot be read as a ROS bag"]),
        (file_of(b"\x89MCAP0\r\n"), {}, ["no lidar topic"]),
        (lambda folder: folder / "absent.mcap", {}, ["no such file"]),
        (said(), {}, ["no lidar topic"]),
        (said(announced=[scan_said(0, b"")]), {}, ["/scan"]),
        (said(odometry_said(STAMP_NS, odometry(STAMP_NS, 0.0, 0.0))), {}, ["lidar", "/odom", "nav_msgs/Odometry"]),
        (said(*office(2)), {"topic": "/nope"}, ["/nope", "log__topic", "/scan", "sensor_msgs/LaserScan"]),
        (said(*office(2)), {"topic": "/odom"}, ["/odom", "nav_msgs/Odometry", "/scan"]),
        (said(*office(2)), {"odometry_topic": "/wheels"}, ["/wheels", "odometry_topic", "/odom"]),
        (said(*office(2)), {"ground_truth_topic": "/nope"}, ["/nope", "/odom"]),
        (said(*office(9)), {"start_s": 100.0}, ["/scan", "start"]),
        (said(*office(2), rear()), {}, ["log__topic", "/scan", "/rear"]),
        (
            said(*office(2), message_encoding="cbor", encoding="ros2msg"), {},
            ["lidar", "/scan", "cbor", "sensor_msgs/LaserScan"],
        ),
        (said(BLIND), {}, ["scan 0", "/scan", "no valid point", "4", "30"]),
        (said(*office(2), SCAN), {}, ["scan 2", "/scan", "malformed"]),
        *(
            (said(*office(2), scan_said(STAMP_NS + SECOND, laser_scan(STAMP_NS, [1.0])[:length])), {}, ["scan 2"])
            for length in (1, 3, 4, 7, 12, 20, 47)
        ),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_refused_in_one_line(tmp_path, make, config, words):
    says(complaint(make(tmp_path), **config), *words)


def test_a_second_file_that_is_bad_is_the_one_named(tmp_path):
    says(complaint(said(*office(2))(tmp_path), tmp_path / "absent.mcap"), "no such file")


def test_a_file_that_may_not_be_read(tmp_path, monkeypatch):
    path = write(tmp_path / "a.mcap", office(2))

    def refuse(*_args, **_options):
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("pathlib.Path.open", refuse)
    says(complaint(path), "Permission denied")


def test_several_logs_with_a_lidar_each_are_all_named_with_their_topics(tmp_path):
    paths = [
        write(tmp_path / f"{name}.mcap", [scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0]), f"/{name}")])
        for name in ("front", "rear", "top")
    ]
    says(complaint(*paths[:2]), f"{paths[0]} and {paths[1]}, read as one log: has several lidar topics")
    says(complaint(*paths[:2]), "/front (sensor_msgs/LaserScan) in front.mcap, /rear", ") in rear.mcap")
    with pytest.raises(InputError, match=f"{paths[0]} and 2 more files, read as one log: .*has no topic /nope"):
        open_log(paths, LogConfig(topic="/nope"))
    assert len(list(open_log(paths, LogConfig(topic="/rear")).scans())) == 1


XYZ = [("x", "f4"), ("y", "f4"), ("z", "f4")]
ROWS = np.ones(6, XYZ)
UNDEFINED = np.array([(np.nan, 0, 0)] * 2 + [(0, 0, 0)] * 4, XYZ)
X, Y, Z = ("x", 0, 7, 1), ("y", 4, 7, 1), ("z", 8, 7, 1)


@pytest.mark.parametrize(
    ("rows", "lies", "words"),
    [
        (np.ones(6, [("x", "f4"), ("y", "f4"), ("intensity", "f4")]), {}, [" z", "intensity"]),
        (ROWS, {"data": ROWS.tobytes()[:-1]}, ["71", "72"]),
        (ROWS, {"height": 2, "padding": 4, "data": bytes(75)}, ["75", "76"]),
        (ROWS, {"height": 2, "row_step": 35, "data": bytes(80)}, ["row_step 35", "36"]),
        (ROWS, {"fields": [X, Y, ("z", 9, 7, 1)]}, ["z", "13", "point_step", "12"]),
        (ROWS, {"fields": [X, Y, Z, ("t", 12, 6, 1)]}, ["t", "16", "point_step", "12"]),
        (ROWS, {"fields": [X, ("y", 4, 11, 1), Z]}, ["y", "11"]),
        (ROWS, {"step": 0}, ["point_step"]),
        (ROWS, {"step": 1 << 31}, ["point_step", "2147483648"]),
        (UNDEFINED, {}, ["no valid point", "2", "4", "NaN"]),
        (ROWS[:0], {}, ["no valid point"]),
    ],
)
def test_a_cloud_that_contradicts_itself_says_where(tmp_path, rows, lies, words):
    good = cloud_said(STAMP_NS, point_cloud(STAMP_NS, ROWS))
    bad = cloud_said(STAMP_NS + 1, point_cloud(STAMP_NS, rows, **lies))
    says(complaint(write(tmp_path / "a.mcap", [good, bad])), "scan 1", "/points", *words)


def test_a_malformed_odometry_message_is_no_reason_to_stop_but_is_told(tmp_path):
    log = open_log(said(*office(5), odometry_said(STAMP_NS + SECOND, b"\0\1\0\0short"))(tmp_path))
    assert len(list(log.scans())) == 5
    assert any("/odom" in line for line in log.damage)


# damage


def assert_true(scans):
    """Every recovered scan is one of those written, in order."""
    numbers = [round((scan.stamp_ns - STAMP_NS) / (SECOND // 10)) for scan in scans]
    assert numbers == sorted(set(numbers))
    for number, scan in zip(numbers, scans, strict=True):
        assert np.linalg.norm(scan.points[0]) == pytest.approx(1.0 + number / 100, abs=1e-5)


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
    log = open_log(path)
    scans = list(log.scans())
    assert_true(scans)
    assert (28 if compression == "none" else 10) <= len(scans) < 40 and log.damage
    assert log.duration_s == pytest.approx(0.1 * (len(scans) - 1), abs=0.11)  # not that of the whole chunk


def chunks_of(data):
    """Byte of the record of each chunk of a file; the first chunk holds only the mounting."""
    offset = 8
    while data[offset] != 15:
        if data[offset] == 6:
            yield offset
        offset += 9 + struct.unpack_from("<Q", data, offset + 1)[0]


@pytest.mark.parametrize("compression", ["none", "lz4", "zstd"])
def test_a_chunk_with_a_wrong_crc_is_left_out_and_told(tmp_path, compression):
    path = write(tmp_path / "a.mcap", office(), compression=compression)
    whole = bytearray(path.read_bytes())
    for begin in [*chunks_of(whole)][:2]:  # that of the mounting, and one of scans
        whole[begin + 33] ^= 1
    path.write_bytes(whole)
    log = open_log(path)
    scans = list(log.scans())
    assert_true(scans)
    np.testing.assert_array_equal(log.T_base_lidar, np.eye(3))
    assert 20 < len(scans) < 40 and any("static transform" in note for note in log.notes)
    says(" ".join(log.damage), "CRC", f"{len(scans)} of 40 scans")


@pytest.mark.parametrize("opcode", [1, 7, 0x90])
def test_a_chunk_whose_opcode_is_damaged_is_read_all_the_same_and_told(tmp_path, opcode):
    whole = bytearray(write(tmp_path / "a.mcap", office(40), summary=False).read_bytes())
    begin = [*chunks_of(whole)][-2]
    whole[begin] = opcode
    (tmp_path / "a.mcap").write_bytes(whole)
    log = open_log(tmp_path / "a.mcap")
    assert len(list(log.scans())) == 40
    says(" ".join(log.damage), f"at byte {begin} has another opcode")


def test_an_unknown_compression_is_named(tmp_path):
    path = write(tmp_path / "a.mcap", office(), compression="zstd")
    path.write_bytes(path.read_bytes().replace(struct.pack("<I", 4) + b"zstd", struct.pack("<I", 4) + b"zlib"))
    says(complaint(path), "zlib")


def test_scans_of_a_damaged_chunk_are_counted_among_those_that_the_index_states(tmp_path):
    path = write(tmp_path / "a.mcap", office(30), chunk_size=8_000)
    data = bytearray(path.read_bytes())
    data[len(data) // 2] ^= 0x10
    path.write_bytes(data)
    log = open_log(path)
    read = len(list(log.scans()))
    assert read < 30 and "CRC is wrong" in log.damage[0]
    assert log.damage[-1] == f"{read} of 30 scans of /scan were recovered"
