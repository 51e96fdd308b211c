"""Judging how a damaged log is read: in time, in bounded memory, InputErrors alone, all that is whole kept."""

from __future__ import annotations

import resource
import signal
import tempfile
import traceback
from collections import Counter
from contextlib import contextmanager
from functools import partial
from pathlib import Path

import numpy as np
from mcap.reader import make_reader

from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.logs.mcap.records import Channel
from scanchain.logs.messages.laser_scan import LaserScanDecoder
from scanchain.logs.messages.point_cloud import PointCloudDecoder
from scanchain.logs.messages.readers import (
    has_poses,
    has_transforms,
    is_cloud,
    is_scan,
    pose_reader,
    reader,
)
from scanchain.logs.messages.returns import PointTimes, RangeLimits
from scanchain.logs.messages.ros import MalformedMessageError
from tests.support import recorders
from tests.support.mutations import CHUNK, Seed, cut_and_flipped, cut_at, mutant, mutated_message
from tests.support.naive_logs import STAMP_NS, cloud_said, odometry, odometry_said, office, point_cloud, write
from tests.support.scenes import shared_data

LONGEST_S = 5.0  # of CPU, so that a busy machine makes no difference
LONGEST_WAIT_S = 120.0
MOST_BYTES = 500_000_000


class Hang(BaseException):
    """A case that took too long."""


def seeds(folder):
    """Small healthy files of every make: chunked and not, compressed, summarized, with and without CRCs."""
    clouds = [
        cloud_said(cloud.stamp_ns, point_cloud(cloud.stamp_ns, cloud.rows)) for cloud in recorders.clouds(8, 20)
    ]
    clouds += [odometry_said(STAMP_NS + k, odometry(STAMP_NS, k, 0.0)) for k in range(4)]
    makes = [
        ("office", office(16), {"compression": compression, "summary": summary, "crcs": crcs})
        for compression in ("none", "lz4", "zstd")
        for summary, crcs in ((True, True), (False, True), (True, False))
    ]
    makes += [("loose", office(12), {"chunked": False, "summary": summary}) for summary in (True, False)]
    makes += [("clouds", clouds, {"compression": compression}) for compression in ("none", "zstd")]
    for number, (name, said, options) in enumerate(makes):
        path = write(folder / f"{name}_{number}.mcap", said, chunk_size=1500, **options)
        yield seed_of(path, f"{name} {options}", has_crcs=options.get("crcs", name != "loose"))


REAL = {
    "2d/intel.mcap": 900_000,
    "2d/mit_csail.mcap": 700_000,
    "3d/kitti_0001_first54.mcap": 10_000_000,
    "3d/kitti_0005_first60.mcap": 10_000_000,
}  # and how many bytes of them are read


def real_complaints(name, folder, rng, count):
    """Real logs cut off, with bits flipped before the cut: (what was done, what is wrong)."""
    seed = seed_of(shared_data(name), name, has_crcs=True)
    for _ in range(count):
        damaged = cut_and_flipped(seed.data, rng, REAL[name])
        wrong = complaint(seed, damaged, folder / "damaged.mcap")
        if wrong:
            yield damaged, wrong


def seed_of(path, name, *, has_crcs):
    log = open_log(path)
    scans = {scan.log_time_ns: _content(scan) for scan in log.scans()}
    return Seed(name, path.read_bytes(), scans, log.lidar.key[1], has_crcs)


def mutants(seed, rng, count):
    """Cuts at every boundary of its records and beside them, then ``count`` random ones."""
    for record in seed.records:
        for length in (record.begin, record.begin + 1, record.begin + 9, record.end - 1):
            yield cut_at(seed.data, length)
    for _ in range(count):
        yield mutant(seed, rng)


def complaint(seed, damaged, path):
    """What is wrong with how a damaged file is read, empty where nothing is."""
    path.write_bytes(damaged.data)
    problem, answer = within_bounds(lambda: read(path))
    return problem or _verdict(seed, damaged, *answer)


def within_bounds(act):
    """What was wrong with how something was done, empty where nothing was, and what came of it."""
    before = peak_bytes()
    try:
        with at_most(LONGEST_S):
            answer = act()
    except Hang:
        return f"takes more than {LONGEST_S} s", None
    except Exception:
        return traceback.format_exc(), None
    more = peak_bytes() - before
    return (f"took {more >> 20} MB more" if more > MOST_BYTES else ""), answer


def read(path):
    """The scans recovered, as (stamp, points), and the lines told about what was not."""
    scans = []
    try:
        log = open_log(path, LogConfig(max_bad_scans_percent=100.0))
        for scan in log.scans():
            scans.append((scan.log_time_ns, _content(scan)))
    except InputError as error:
        assert "\n" not in str(error) and str(path) in str(error), f"no line of ours: {error}"
        return scans, [str(error)]
    return scans, log.damage


def _verdict(seed, damaged, scans, told):
    expected = seed.expected(damaged.touched)
    counted = Counter(scans)
    missing = sorted(time_ns for time_ns in expected if not counted[time_ns, seed.scans[time_ns]])
    if missing:
        return f"{len(missing)} of {len(expected)} untouched scans are missing ({missing[:3]}); told: {told}"
    invented = [time_ns for time_ns, content in counted if seed.scans.get(time_ns) != content]
    if invented and seed.has_crcs and not _is_cut_inside_damage(seed, damaged):
        return f"{len(invented)} scans are not those of the file ({invented[:3]}); told: {told}"
    lost = [time_ns for time_ns, content in seed.scans.items() if not counted[time_ns, content]]
    if lost and not told and seed.has_crcs and not damaged.is_seamless:
        return f"{len(lost)} scans are missing or changed and nothing is told"
    return ""


def _is_cut_inside_damage(seed, damaged):
    """Whether the chunk that the file ends in, whose CRC cannot be checked, was changed before its cut."""
    end = len(damaged.data)
    cut_chunk = next((r for r in seed.records if r.opcode == CHUNK and r.begin < end < r.end), None)
    return cut_chunk is not None and cut_chunk.is_touched([t for t in damaged.touched if t[0] < end])


def payload_complaints(folder, rng, count):
    """What decoders do with damaged messages other than decode them or call them malformed."""
    said = list(_messages(folder))
    for number in range(count):
        channel, data, decode = said[number % len(said)]
        changed = mutated_message(data, rng)
        problem, told = within_bounds(partial(_decode, decode, changed))
        if problem or told:
            yield f"{channel.type_name} in {channel.encoding}: {problem or told}: {changed!r}"


def _decode(decode, data):
    """What is wrong with how a message is called malformed, empty where it is not or that is one line."""
    try:
        with np.errstate(all="ignore"):
            decode(memoryview(data))
    except MalformedMessageError as error:
        return f"more than a line: {error}" if "\n" in str(error) else ""
    return ""


def _messages(folder):
    """One or several messages of every type and encoding that is understood, each with its decoder."""
    for path in _recorded(folder):
        with path.open("rb") as stream:
            for schema, channel, message in make_reader(stream).iter_messages():
                known = Channel(
                    (0, channel.id), channel.topic, channel.message_encoding, schema.id, schema.name,
                    schema.encoding, schema.data,
                )  # fmt: skip
                yield known, message.data, decoder_of(known)


def decoder_of(channel):
    limits = RangeLimits(0.0, float("inf"))
    if is_scan(channel):
        return LaserScanDecoder(limits, reader(channel)).decode
    if is_cloud(channel):
        return PointCloudDecoder(limits, PointTimes(LogConfig()), reader(channel)).decode
    if has_transforms(channel):
        return reader(channel)
    assert has_poses(channel), channel
    return pose_reader(channel, 2)


def _recorded(folder):
    for name, store in (("ros1", recorders.ROS1), ("ros2", recorders.ROS2)):
        ros = recorders.Ros(store)
        livox, echoes = "livox_ros_driver2/msg/CustomMsg", "sensor_msgs/msg/MultiEchoLaserScan"
        told = [*ros.drive(), *ros.sweeps()]
        told += [
            ("/livox", livox, cloud.stamp_ns, ros.livox(cloud, "livox_ros_driver2"))
            for cloud in recorders.clouds(1)
        ]
        told += [("/echoes", echoes, scan.stamp_ns, ros.multi_echo(scan)) for scan in recorders.planar(1)]
        yield recorders.mcap_of(folder / f"{name}.mcap", ros, told)
    for name, said in (("scan", recorders.planar(1)), ("cloud", recorders.clouds(1))):
        yield recorders.foxglove_protobuf(folder / f"protobuf_{name}.mcap", said)
        yield recorders.foxglove_json(folder / f"json_{name}.mcap", said)


@contextmanager
def at_most(seconds):
    """Raise Hang in what takes more CPU time, or waits for long."""

    def ring(*_):
        raise Hang

    timers = {
        signal.SIGPROF: (signal.ITIMER_PROF, seconds), signal.SIGALRM: (signal.ITIMER_REAL, LONGEST_WAIT_S)
    }  # fmt: skip
    before = {number: signal.signal(number, ring) for number in timers}
    for timer, limit_s in timers.values():
        signal.setitimer(timer, limit_s)
    try:
        yield
    finally:
        for number, (timer, _) in timers.items():
            signal.setitimer(timer, 0)
            signal.signal(number, before[number])


def _content(scan):
    return scan.stamp_ns, scan.points.tobytes()


def peak_bytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def file_complaints(seed, rng, count):
    """Each damaged file that is read badly: (what was done, what is wrong)."""
    with tempfile.TemporaryDirectory() as folder:
        for damaged in mutants(seed, rng, count):
            wrong = complaint(seed, damaged, Path(folder) / "damaged.mcap")
            if wrong:
                yield damaged, wrong
