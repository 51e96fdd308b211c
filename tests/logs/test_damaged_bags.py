"""Bags of ROS with damage that nothing else tells of: what is there is read, what is lost is told."""

import sqlite3
import struct
import subprocess
import sys
from contextlib import closing
from itertools import pairwise

import numpy as np
import pytest
import zstandard

from scanchain.errors import InputError
from scanchain.logs import open_log
from tests.support import recorders
from tests.support.messages import says
from tests.support.naive_logs import ROS1, ROS2
from tests.support.recorders import Ros

SCANS = 12
HEADER, INDEX, CHUNK, CHUNK_INFO = 3, 4, 5, 6


@pytest.fixture(params=[None, "BZ2"])
def bag(request, tmp_path):
    """A ROS 1 bag of a few chunks, each with scans and odometry."""
    ros, said = Ros(ROS1), recorders.clouds(SCANS)
    messages = [*ros.sweeps(said)]
    messages += [("/odom", "nav_msgs/msg/Odometry", c.stamp_ns + 9, ros.odometry(c.stamp_ns, 0.1)) for c in said]
    messages.sort(key=lambda each: each[2])
    return recorders.bag1_of(tmp_path / "a.bag", messages, request.param, chunk_bytes=2000)


def records(data, offset=13, end=None):
    """(opcode, begin, begin of the data, end) of each record."""
    while offset < (len(data) if end is None else end):
        (head,) = struct.unpack_from("<I", data, offset)
        (size,) = struct.unpack_from("<I", data, offset + 4 + head)
        begin = offset + 8 + head
        opcode = data[data.index(b"op=", offset, begin) + 3]
        yield opcode, offset, begin, begin + size
        offset = begin + size


def of(data, opcode):
    return [(begin, body, end) for each, begin, body, end in records(data) if each == opcode]


def read(path, data):
    """How many scans are read of a bag that is damaged, and what is told."""
    path.write_bytes(data)
    log, scans = recorders.read(path, max_bad_scans_percent=100.0)
    assert all("\n" not in line for line in log.damage)
    return len(scans), log.damage


def changed(data, at, *values):
    return data[:at] + bytes(values) + data[at + len(values) :]


@pytest.mark.parametrize("opcode", [0, 4, 7, 13])
def test_a_chunk_or_an_index_whose_opcode_is_another_is_read_all_the_same(bag, opcode):
    data = bag.read_bytes()
    for begin, body, _ in [*of(data, CHUNK)[::3], *of(data, INDEX)[::7]]:
        count, told = read(bag, changed(data, data.index(b"op=", begin, body) + 3, opcode))
        assert count == SCANS and (told or opcode == INDEX)


@pytest.mark.parametrize("value", [1, 200])
@pytest.mark.parametrize("field", [b"conn=", "entry", CHUNK_INFO])
def test_an_index_that_lies_about_connections_or_counts_loses_no_scan(bag, field, value):
    data = bag.read_bytes()
    for begin, body, end in of(data, INDEX if field != CHUNK_INFO else CHUNK_INFO)[::3]:
        if field == "entry":  # one less, or more of them: the record is a whole one
            rest = data[body:end][: 12 * ((end - body) // 12 - 1)] if value == 1 else data[body:end] * value
            told_count = changed(data[begin:body], body - begin - 4, *struct.pack("<I", len(rest)))
            lying = data[:begin] + told_count + rest + data[end:]
        else:
            at = body if field == CHUNK_INFO else data.index(b"conn=", begin, body) + 5
            lying = changed(data, at, data[at] ^ value)
        count, told = read(bag, lying)
        assert count == SCANS and told


def test_chunks_that_are_gone_without_a_trace_are_told(bag):
    data = bag.read_bytes()
    begins = [begin for begin, _, _ in of(data, CHUNK)]
    for first, behind in pairwise(begins[1:]):
        count, told = read(bag, data[:first] + data[behind:])
        assert 0 < count < SCANS and told
    for end in begins[2:]:  # a copy that broke off between two records
        count, told = read(bag, data[:end])
        assert 0 < count <= SCANS and any(f"of {len(begins)} chunks" in line for line in told)


def test_behind_a_damaged_message_reading_goes_on_in_its_chunk(tmp_path):
    said = recorders.clouds(SCANS)
    path = recorders.bag1_of(tmp_path / "a.bag", [*Ros(ROS1).sweeps(said)])
    data = path.read_bytes()
    ((_, body, end),) = of(data, CHUNK)
    for place, (opcode, begin, message, _) in enumerate(records(data, body, end)):
        if opcode == 2:
            for lying in (
                changed(data, begin, 0xFF, 0xFF), changed(data, message - 4, 0xFF, 0xFF),
                changed(data, data.index(b"conn=", begin) + 5, 9), changed(data, begin, *bytes(message - begin)),
            ):  # fmt: skip
                count, told = read(path, lying)
                assert count >= SCANS - 1 and told, place
            assert read(path, changed(data, data.index(b"op=", begin) + 3, 9))[0] == SCANS


def test_a_healthy_bag_is_undamaged_and_none_of_its_chunks_is_unpacked_to_be_counted(bag, monkeypatch):
    monkeypatch.setattr("scanchain.logs.formats.ros1_bag.messages_of", None)
    log, scans = recorders.read_undamaged(bag)
    assert len(scans) == log.scan_count == SCANS


# ROS 2


def bag2(folder, count=40, **options):
    """A bag in SQLite with clouds of several pages, and odometry."""
    ros, said = Ros(ROS2), recorders.clouds(count, 700)
    messages = [*ros.sweeps(said)]
    messages += [("/odom", "nav_msgs/msg/Odometry", c.stamp_ns + 9, ros.odometry(c.stamp_ns, 0.1)) for c in said]
    return recorders.bag2_of(folder, sorted(messages, key=lambda each: each[2]), **options)


PAGE = 4096


FILLS = [b"\xff" * PAGE, np.random.default_rng(1).bytes(PAGE)]


@pytest.mark.parametrize("fill", [bytes(PAGE), *(pytest.param(fill, marks=pytest.mark.slow) for fill in FILLS)])
@pytest.mark.parametrize("is_folder", [True, False])
def test_of_a_database_with_one_page_destroyed_all_other_messages_are_read(tmp_path, fill, is_folder):
    folder = bag2(tmp_path / "a")
    path, opened = folder / "a.db3", folder if is_folder else folder / "a.db3"
    data = path.read_bytes()
    with closing(sqlite3.connect(path)) as base:
        sought = "SELECT rootpage FROM sqlite_master WHERE name IN ('topics', 'messages')"
        vital = {0, *(page - 1 for (page,) in base.execute(sought))}  # without which SQLite finds nothing
    healthy = {scan.stamp_ns: scan.points for scan in open_log(opened).scans()}
    tables = {at // PAGE for at in range(0, len(data), PAGE) if data[at] in (5, 10, 13)}
    for page in sorted({*tables, *range(0, len(data) // PAGE, 9)} - vital):
        path.write_bytes(data[: page * PAGE] + fill + data[(page + 1) * PAGE :])
        log = open_log(opened, max_bad_scans_percent=100.0)
        scans = {scan.stamp_ns: scan.points for scan in log.scans()}
        whole = [stamp for stamp, points in scans.items() if np.array_equal(points, healthy[stamp])]
        assert len(whole) >= len(healthy) - 1 - 3 * (page in tables), (page, log.damage)
        if log.damage or len(scans) < len(healthy):
            says(log.damage[0], "of 80 messages lost in damaged pages", "the others are read row by row")
            lost = int(log.damage[0].removeprefix(f"{opened}: ").split()[0])
            assert len(healthy) - len(scans) <= lost <= 8
    for page in vital:
        path.write_bytes(data[: page * PAGE] + fill + data[(page + 1) * PAGE :])
        with pytest.raises(InputError, match=r"cannot be read as a ROS bag .*; copy it again; sqlite3 \.recover"):
            open_log(opened)


def test_a_healthy_database_is_not_read_row_by_row(tmp_path, monkeypatch):
    monkeypatch.setattr("scanchain.logs.formats.ros2_bag._copy_rows", None)
    assert len(recorders.read_undamaged(bag2(tmp_path / "a"))[1]) == 40


@pytest.mark.parametrize("cut", [0.3, 0.9])
def test_a_packed_file_that_is_cut_off_is_read_up_to_there(tmp_path, cut):
    folder = bag2(tmp_path / "a", compression="FILE")
    (path,) = folder.glob("*.zstd")
    path.write_bytes(path.read_bytes()[: int(cut * path.stat().st_size)])
    log, scans = recorders.read(folder, max_bad_scans_percent=100.0)
    assert 40 * cut - 10 < len(scans) < 40 and "messages lost" in log.damage[0]


def zeros(count, **options):
    """Zeros, packed chunk by chunk or with their number stated."""
    packer = zstandard.ZstdCompressor(level=1).compressobj(**options)
    return b"".join([*(packer.compress(bytes(1 << 20)) for _ in range(count >> 20)), packer.flush()])


@pytest.mark.parametrize("size", [-1, 1 << 30])
def test_a_message_that_unpacks_without_end_is_counted_as_damaged_in_bounded_memory(tmp_path, size):
    folder = bag2(tmp_path / "a", 12, compression="MESSAGE")
    connection = sqlite3.connect(folder / "a.db3")
    connection.execute("UPDATE messages SET data = ? WHERE id IN (3, 9)", (zeros(1 << 30, size=size),))
    connection.commit()
    connection.close()
    code = f"""
import resource
from scanchain.logs import open_log
before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
log = open_log({str(folder)!r}, max_bad_scans_percent=100.0)
print(len(list(log.scans())), *log.damage, sep="\\n")
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) // 1024)"""
    output = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    count, damage, *_, more_mib = output.splitlines()
    assert int(count) == 10 and int(more_mib) < 400
    says(damage, "2 of 12 scans of /points were left out", "decompress")


def test_a_packed_file_that_unpacks_without_end_is_refused(tmp_path):
    folder = bag2(tmp_path / "a", 3, compression="FILE")
    (path,) = folder.glob("*.zstd")
    path.write_bytes(zeros(1 << 30))
    with pytest.raises(InputError, match=r"db3.zstd: decompresses to more than [\d,]+ bytes; is it a ROS 2 bag"):
        open_log(folder)
