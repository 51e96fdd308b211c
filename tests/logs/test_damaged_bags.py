"""Bags of ROS with damage that nothing else tells of: what is there is read, what is lost is told."""

import struct
from itertools import pairwise

import pytest

from tests.support import recorders
from tests.support.naive_logs import ROS1
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
