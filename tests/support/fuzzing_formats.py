"""Judging how damaged logs that are no MCAP are read: bags, CARMEN text, folders of sweeps."""

import bz2
import gzip
import struct
import zlib
from pathlib import Path

import lzf
import numpy as np
from rosbags import rosbag1

from scanchain.logs import open_log
from tests.support import recorders
from tests.support.fuzzing import Seed, made
from tests.support.sensor_files import BEGIN_S, PCD, PLY, flaser, kitti_odometry, kitti_raw, odom, robotlaser, xyzi

SCANS = 12
UNPACKED_AT_ONCE = 64  # bytes of packed text, which are lost with those that are damaged


def seeds(folder):
    yield from _bags(folder / "bags")
    yield from _carmen(folder / "carmen")
    yield from _clouds(folder / "clouds")
    yield from _kitti(folder / "kitti")


# bags


def _bags(folder):
    said = recorders.clouds(SCANS)
    sweeps = [[*recorders.Ros(store).sweeps(said)] for store in (recorders.ROS1, recorders.ROS2)]
    for compression in (None, "BZ2", "LZ4"):
        inside = made(folder / f"bag_{compression}")
        path = recorders.bag1_of(inside / "a.bag", sweeps[0], compression, chunk_bytes=2000)
        yield Seed(f"bag {compression}", inside, path, _by_chunk(path), tells_losses=True)
    for compression in ("NONE", "FILE", "MESSAGE"):
        inside = recorders.bag2_of(folder / f"bag2_{compression}", sweeps[1], compression=compression)
        yield Seed(f"ROS 2 bag {compression}", inside, inside, _nothing, tells_losses=True)
    inside = recorders.bag2_of(folder / "db3", sweeps[1])
    yield Seed("db3", inside, inside / "db3.db3", _nothing, tells_losses=True)


def _by_chunk(path):
    """Scans of the chunks of a ROS 1 bag that nothing has touched, where its first line and topics are whole."""
    data = path.read_bytes()
    (topics_at,) = struct.unpack_from("<Q", data, data.index(b"index_pos=") + 10)
    with rosbag1.Reader(path) as reader:
        begins = sorted(reader.chunks)
        ends = [*begins[1:], topics_at]
        times_ns = [
            {entry.time for index in reader.indexes.values() for entry in index if entry.chunk_pos == begin}
            for begin in begins
        ]

    def untouched(_, damaged):
        if any(begin < 13 or end > topics_at for begin, end in damaged.touched if end < len(data)):
            return set()
        told = (begins[0], ends[0]), (begins[-1], len(data))  # the topics: in the first chunk and behind the last
        if all(any(first < end and last > begin for first, last in damaged.touched) for begin, end in told):
            return set()
        return {
            time_ns
            for begin, end, times in zip(begins, ends, times_ns, strict=True)
            for time_ns in times
            if not any(first < end and last > begin for first, last in damaged.touched)
        }

    return untouched


def _nothing(_name, _damaged):
    return set()


# CARMEN


def _carmen(folder):
    lines = ["# CARMEN", "PARAM robot_frontlaser_offset 0.2 nohost 0"]
    for k in range(SCANS):
        scan = flaser(k) if k % 3 else robotlaser(k, np.linspace(1, 9, 12), (0.1, 0, 0), (0, 0, 0))
        lines += [odom(k, 0.1 * k), scan]
    text = "\n".join([*lines, ""]).encode()
    for name, pack in (("a.log", bytes), ("a.log.bz2", bz2.compress), ("a.log.gz", gzip.compress)):
        inside = made(folder / name.rpartition(".")[2])
        (inside / name).write_bytes(pack(text))
        yield Seed(f"CARMEN {name}", inside, inside / name, _by_line(text, name))


def _by_line(text, name):
    """Scans of the lines that nothing has touched; of packed text those that lie before the damage."""
    lines, begin = [], 0
    for line in text.splitlines(keepends=True):
        if line.startswith((b"FLASER", b"ROBOTLASER1")):
            lines.append((begin, begin + len(line), int(float(line.split()[-3]) * 1e9)))
        begin += len(line)
    assert lines[0][2] == int(BEGIN_S * 1e9)

    def untouched(_, damaged):
        touched = damaged.touched
        if damaged.what.startswith("page 0 "):  # by which the file is recognized
            return set()
        if not name.endswith(".log"):
            before = damaged.data[: max(0, min(begin for begin, _ in touched) - UNPACKED_AT_ONCE)]
            touched = [(_unpacked(before, name), len(text))]
        whole = (line for line in lines if not any(a < line[1] and b > line[0] - 1 for a, b in touched))
        return {stamp_ns for _, _, stamp_ns in whole}

    return untouched


def _unpacked(data, name):
    """How many bytes of text come out of the beginning of a packed file."""
    unpacker = bz2.BZ2Decompressor() if name.endswith("bz2") else zlib.decompressobj(zlib.MAX_WBITS | 16)
    return len(unpacker.decompress(data))


# folders


def _clouds(folder):
    said = recorders.clouds(SCANS)
    kinds = {"pcd": (PCD, ("ascii", "binary", "binary_compressed")), "bin": ("", ("raw",))}
    kinds["ply"] = PLY, ("ascii", "binary_little_endian", "binary_big_endian")
    for suffix, (head, forms) in kinds.items():
        for form in forms:
            inside = made(folder / f"{suffix}_{form}")
            stamps = {f"{cloud.stamp_ns}.{suffix}": cloud.stamp_ns for cloud in said}
            for name, cloud in zip(stamps, said, strict=True):
                (inside / name).write_bytes(_cloud(cloud, suffix, head, form))
            yield Seed(f"{suffix} {form}", inside, inside, _by_file(stamps))
    inside = made(folder / "numbered")
    for k, cloud in enumerate(said):
        xyzi(cloud).tofile(inside / f"{k:04d}.bin")
    yield Seed(
        "numbered", inside, inside, _by_file({f"{k:04d}.bin": k * 10**8 for k in range(SCANS)}), rate_hz=10.0
    )


def _cloud(cloud, suffix, head, form):
    if suffix == "bin":
        return xyzi(cloud).tobytes()
    order = ">" if "big" in form else "<"
    if suffix == "pcd":
        point = [("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("timestamp", "<u8"), ("ring", "<u2")]
    else:
        point = [("x", order + "f8"), ("y", order + "f4"), ("z", order + "f4"), ("ring", "u1")]
    rows = np.zeros(len(cloud.rows) - 1, point)
    for name in "xyz":
        rows[name] = cloud.rows[name][1:]
    if suffix == "pcd":
        rows["timestamp"] = cloud.stamp_ns + cloud.rows["t"][1:].astype(np.uint64)
    told = head.format(count=len(rows), form=form).encode()
    if form == "ascii":
        return told + b"".join(b" ".join(repr(value).encode() for value in row) + b"\n" for row in rows.tolist())
    if form == "binary_compressed":
        data = b"".join(rows[name].tobytes() for name in rows.dtype.names)
        packed = lzf.compress(data, 2 * len(data))
        return told + struct.pack("<II", len(packed), len(data)) + packed
    return told + rows.tobytes() + (b"\x03" + bytes(12) if suffix == "ply" else b"")


def _kitti(folder):
    said = recorders.clouds(SCANS)
    raw = kitti_raw(made(folder / "raw"), said)
    yield Seed("KITTI raw", folder / "raw", raw, _by_sweep(raw, "timestamps"))
    sequence = kitti_odometry(made(folder / "odometry"), said)
    yield Seed("KITTI odometry", folder / "odometry", sequence, _by_sweep(sequence, "times"))


def _by_sweep(opened, times):
    """As ``_by_file``; the sweeps' own times govern all of them, whatever tells the truth none."""
    stamps = (scan.stamp_ns for scan in open_log(opened).scans())
    files = [path.name for path in sorted(opened.rglob("*.bin"))]
    by_file = _by_file(dict(zip(files, stamps, strict=True)))

    def untouched(name, damaged):
        path = Path(name)
        return set() if path.stem == times and path.parent.name != "oxts" else by_file(name, damaged)

    return untouched


def _by_file(stamps):
    return lambda name, _: {stamp_ns for file, stamp_ns in stamps.items() if file != Path(name).name}
