"""Judging how a damaged log is read: in time, in bounded memory, InputErrors alone, all that is whole kept."""

from __future__ import annotations

import resource
import shutil
import signal
import traceback
import warnings
from contextlib import contextmanager
from functools import partial

import numpy as np
from mcap.reader import make_reader

from scanchain.config import LogConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.logs.index import Channel
from scanchain.logs.messages.lidar import decode_cloud, decode_laser_scan
from scanchain.logs.messages.point_times import PointTimes
from scanchain.logs.messages.readers import (
    has_poses,
    is_lidar,
    is_scan,
    pose_reader,
    reader,
    role,
)
from scanchain.logs.messages.ros import MalformedMessageError
from tests.support import recorders
from tests.support.mutations import (
    CHUNK,
    DATA_END,
    MESSAGE,
    STATISTICS,
    any_mutant,
    cut_and_flipped,
    cut_at,
    mutant,
    mutated_message,
    records_of,
)
from tests.support.naive_logs import STAMP_NS, cloud_said, odometry, odometry_said, office, point_cloud, write
from tests.support.scenes import shared_data

LONGEST_S = 5.0  # of CPU, so that a busy machine makes no difference
LONGEST_WAIT_S = 120.0
MOST_BYTES = 500_000_000


REAL = {
    "2d/intel.mcap": 900_000,
    "2d/mit_csail.mcap": 700_000,
    "3d/kitti_0001_first54.mcap": 10_000_000,
    "3d/kitti_0005_first60.mcap": 10_000_000,
}  # and how many bytes of them are read


class Hang(BaseException):
    """A case that took too long."""


class Seed:
    """A healthy log: the folder it lies in, what of it is opened, its files, and its scans by time.

    ``untouched`` tells from a damaged file, by its path in the folder, which scans must still be there.
    """

    key = "stamp_ns"  # by which its scans are told apart

    def __init__(self, name, folder, opened, untouched, *, rate_hz=0.0, tells_losses=False):
        self.name, self.folder, self.opened, self.rate_hz = name, folder, opened, rate_hz
        self.tells_losses = tells_losses
        self.untouched = untouched
        scans, told = read(self)
        assert told == [], told
        self.scans = dict(scans)
        files = (path for path in sorted(folder.rglob("*")) if path.is_file())
        self.files = {str(path.relative_to(folder)): path.read_bytes() for path in files}

    def mutants(self, rng, count):
        """So many damaged files: (which one, what became of it)."""
        names = list(self.files)
        for _ in range(count):
            name = names[rng.integers(len(names))]
            yield name, any_mutant(self.files[name], rng)

    def suspicion(self, damaged, scans, told):
        """What is wrong with scans that were read, or with what was told, though nothing untouched is missing."""
        lost = len(self.scans) - len(scans) if self.tells_losses and not told else 0
        return f"{lost} scans are lost and nothing is told" if lost > 0 else ""


class McapSeed(Seed):
    """A healthy MCAP file, whose records tell which scans a damage has touched."""

    key = "log_time_ns"

    def __init__(self, name, path, *, has_crcs):
        super().__init__(name, path.parent, path, self._untouched)
        self.has_crcs, self.data = has_crcs, self.files[path.name]
        self.records = list(records_of(self.data, open_log(path).lidar.key[1]))

    @property
    def is_summarized(self):
        return any(record.opcode == STATISTICS for record in self.records)

    def mutants(self, rng, count):
        """Cuts at every boundary of its records and beside them, then random ones."""
        for record in self.records:
            for length in (record.begin, record.begin + 1, record.begin + 9, record.end - 1):
                yield self.opened.name, cut_at(self.data, length)
        for _ in range(count):
            yield self.opened.name, mutant(self, rng)

    def _untouched(self, _, damaged):
        """Log times of the scans that lie in records, and are described by others, which nothing has touched."""
        if not self._is_described(damaged.touched):
            return set()
        whole = [r for r in self.records if r.opcode in (CHUNK, MESSAGE) and not r.is_touched(damaged.touched)]
        return {time_ns for record in whole for time_ns in record.times_ns} & set(self.scans)

    def _is_described(self, touched):
        """Whether the channels are told in the summary or the data, and no other telling can be false unseen."""
        end = next(r.begin for r in self.records if r.opcode == DATA_END)
        groups = (
            [r for r in self.records if r.defines and r.begin < end],
            [r for r in self.records if r.begin >= end],
        )
        sound = [not any(r.is_touched(touched) for r in group) for group in groups]
        told = [any(r.defines for r in group) for group in groups]
        said = [good for good, there in zip(sound, told, strict=True) if there]
        return any(said) if self.has_crcs and any(r.opcode == CHUNK for r in self.records) else all(said)

    def suspicion(self, damaged, scans, told):
        if not self.has_crcs:
            return ""
        invented = [time_ns for time_ns, content in scans if self.scans.get(time_ns) != content]
        if invented and not self._is_cut_inside_damage(damaged):
            return f"{len(invented)} scans are not those of the file ({invented[:3]}); told: {told}"
        lost = self.scans.items() - scans
        if lost and not told and not damaged.is_seamless:
            return f"{len(lost)} scans are missing or changed and nothing is told"
        return ""

    def _is_cut_inside_damage(self, damaged):
        """Whether the chunk that the file ends in, whose CRC cannot be checked, was changed before its cut."""
        end = len(damaged.data)
        cut_chunk = next((r for r in self.records if r.opcode == CHUNK and r.begin < end < r.end), None)
        return cut_chunk is not None and cut_chunk.is_touched([t for t in damaged.touched if t[0] < end])


class RealSeed(McapSeed):
    """A real log, of whose mutants so many bytes are left at most, with bits flipped before the cut."""

    def __init__(self, name, path, longest):
        super().__init__(name, path, has_crcs=True)
        self.longest = longest

    def mutants(self, rng, count):
        for _ in range(count):
            yield self.opened.name, cut_and_flipped(self.data, rng, self.longest)


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
        path = made(folder / f"{name}_{number}") / "a.mcap"
        write(path, said, chunk_size=1500, **options)
        yield McapSeed(f"{name} {options}", path, has_crcs=options.get("crcs", name != "loose"))


def real_seeds(folder, names=None):
    """Copies of real logs."""
    for name in names or REAL:
        path = made(folder / name.replace("/", "_")) / "a.mcap"
        shutil.copyfile(shared_data(name), path)
        yield RealSeed(name, path, REAL[name])


def complaints(seed, rng, count):
    """Each damaged log that is read badly: (the file, what was done to it, what is wrong)."""
    for name, damaged in seed.mutants(rng, count):
        path = seed.folder / name
        path.write_bytes(damaged.data)
        wrong = _complaint(seed, name, damaged)
        if len(seed.files) > 1:
            path.write_bytes(seed.files[name])
        if wrong:
            yield name, damaged, wrong


def _complaint(seed, name, damaged):
    """What is wrong with how a damaged log is read, empty where nothing is."""
    problem, answer = within_bounds(partial(read, seed))
    if problem:
        return problem
    scans, told = answer
    read_well, untouched = set(scans), seed.untouched(name, damaged)
    missing = sorted(time_ns for time_ns in untouched if (time_ns, seed.scans[time_ns]) not in read_well)
    if missing:
        return f"{len(missing)} of {len(untouched)} untouched scans are missing ({missing[:3]}); told: {told}"
    return seed.suspicion(damaged, read_well, told)


def within_bounds(act, seconds=LONGEST_S):
    """What was wrong with how something was done, empty where nothing was, and what came of it."""
    before = peak_bytes()
    try:
        with at_most(seconds):
            answer = act()
    except Hang:
        return f"takes more than {seconds} s", None
    except Exception:
        return traceback.format_exc(), None
    more = peak_bytes() - before
    return (f"took {more >> 20} MB more" if more > MOST_BYTES else ""), answer


def read(seed):
    """The scans recovered, as (time, content), and the lines told about what was not; no warning is heard."""
    scans = []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        warnings.simplefilter("ignore", ResourceWarning)
        try:
            log = open_log(seed.opened, LogConfig(max_bad_scans_percent=100.0, rate_hz=seed.rate_hz))
            for scan in log.scans():
                scans.append((getattr(scan, seed.key), (scan.stamp_ns, scan.points.tobytes())))
            log.ground_truth()
            told = log.damage
        except InputError as error:
            assert str(seed.opened) in str(error), f"no line of ours: {error}"
            told = [str(error)]
    assert not [line for line in told if "\n" in line], told
    return scans, told


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
    if is_scan(channel):
        return partial(decode_laser_scan, read=reader(channel), config=LogConfig())
    if is_lidar(channel):
        return partial(decode_cloud, read=reader(channel), times=PointTimes(LogConfig()))
    if role(channel) == "transforms":
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


def peak_bytes():
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def made(folder):
    """A new folder."""
    folder.mkdir(parents=True)
    return folder
