"""Logs whose messages are sectors of a revolution: simulated sweeps, cut anew by the times of their points."""

from dataclasses import dataclass, replace

import numpy as np

from scanchain.logs.opening import index_files
from scanchain.logs.stream import EVERYTHING, decoded_messages
from scanchain.logs.writer import LogWriter, pack_cloud, pack_laser_scan
from scanchain.simulation import SENSORS, plan, record
from scanchain.simulation.sensors import _planar
from tests.support import made
from tests.support.naive_logs import ROS2

PERIOD_NS = 100_000_000
UNITS = {"ns": 1, "us": 1_000, "ms": 1_000_000, "s": 1_000_000_000}


@dataclass(frozen=True)
class Cut:
    """How a revolution is cut.

    width_deg : of a message; overlap_deg : of two that follow each other
    times : of points, from the "message", the "sweep", or "none"; in ``unit``, as floats where that is not ns
    stamp : of a message: its "begin", its "end", or that of its "sweep"
    dropped : numbers of messages that are missing, from 0; empty : of those without a point
    """

    width_deg: float
    times: str = "message"
    unit: str = "ns"
    stamp: str = "begin"
    overlap_deg: float = 0.0
    dropped: tuple[int, ...] = ()
    empty: tuple[int, ...] = ()


def whole(world, seconds, sensor="vlp-16", **options):
    """The simulated log that is cut: a lidar that looks all around."""
    if sensor != "all-around":
        return made.log(world, seconds=seconds, sensor=sensor, **options)

    def write(path):
        drive = plan(world, duration_s=seconds, **options)
        around = replace(SENSORS["lms-270"], rays=_planar(720, 0.5, PERIOD_NS))
        record(replace(drive, sensor=around), path, force=True)

    return made.recorded(f"{world}_around_{seconds}", write)


def cut(source, path, how):
    """A copy of a simulated log with the points of its sweeps in other messages; returns the path."""
    indexes = index_files([source])
    topics = {channel.topic for index in indexes for channel in index.channels.values()}
    messages = list(decoded_messages(indexes, dict.fromkeys(topics, bytes), EVERYTHING, damage=[]))
    lidar = next(topic for topic in ("/points", "/scan") if topic in topics)
    sectors = _clouds if lidar == "/points" else _scans
    told = [(each.log_time_ns, each.channel, each.value) for each in messages if each.channel.topic != lidar]
    channel = next(each.channel for each in messages if each.channel.topic == lidar)
    swept = [each.value for each in messages if each.channel.topic == lidar]
    told += [(log_ns, channel, data) for log_ns, data in sectors(swept, how)]
    with LogWriter(path, force=True) as log:
        for log_ns, channel, data in sorted(told, key=lambda each: each[0]):
            log.copy(channel, log_ns, data)
    return path


def _clouds(swept, how):
    stamps, times, points = [], [], []
    for data in swept:
        cloud = ROS2.deserialize_cdr(data, "sensor_msgs/msg/PointCloud2")
        dtype = np.dtype({
            "names": ["x", "y", "z", "t"], "formats": ["<f4", "<f4", "<f4", "<u4"],
            "offsets": [0, 4, 8, 12], "itemsize": cloud.point_step,
        })  # fmt: skip
        rows = np.frombuffer(cloud.data, dtype)
        stamp_ns = cloud.header.stamp.sec * 1_000_000_000 + cloud.header.stamp.nanosec
        stamps.append(stamp_ns)
        times.append(stamp_ns + rows["t"].astype(np.int64))
        points.append(np.column_stack([rows[name] for name in "xyz"]))
    times, points = np.concatenate(times), np.concatenate(points)
    order = np.argsort(times)
    in_order = times[order]
    for number, begin_ns, end_ns in _intervals(stamps, how):
        if number in how.dropped:
            continue
        ends = np.searchsorted(in_order, [begin_ns, end_ns + how.overlap_deg / 360.0 * PERIOD_NS])
        chosen = np.sort(order[slice(*ends)]) if number not in how.empty else order[:0]
        stamp_ns = _stamp(begin_ns, end_ns, stamps, how)
        origin_ns = (
            stamp_ns if how.times == "message" else stamps[0] + (begin_ns - stamps[0]) // PERIOD_NS * PERIOD_NS
        )
        columns = dict(zip("xyz", points[chosen].T, strict=True))
        if how.times != "none":
            t = times[chosen] - origin_ns
            columns["t"] = t.astype(np.int32) if how.unit == "ns" else (t / UNITS[how.unit]).astype(np.float32)
        rows = np.rec.fromarrays(list(columns.values()), dtype=[(k, v.dtype) for k, v in columns.items()])
        yield end_ns, pack_cloud(stamp_ns, "lidar", rows)


def _scans(swept, how):
    scans = [ROS2.deserialize_cdr(data, "sensor_msgs/msg/LaserScan") for data in swept]
    first = scans[0]
    beams = len(first.ranges)
    stamps = [scan.header.stamp.sec * 1_000_000_000 + scan.header.stamp.nanosec for scan in scans]
    ranges = np.concatenate([scan.ranges for scan in scans])
    beam_ns = PERIOD_NS / beams
    for number, begin_ns, end_ns in _intervals(stamps, how):
        if number in how.dropped:
            continue
        start, end = (int(np.ceil((each - stamps[0]) / beam_ns - 1e-3)) for each in (begin_ns, end_ns))
        end = min(end + round(how.overlap_deg / 360.0 * beams), len(ranges))
        part = ranges[start:end]
        yield end_ns, pack_laser_scan(
            _stamp(begin_ns, end_ns, stamps, how), "lidar",
            first.angle_min + first.angle_increment * (start % beams), first.angle_increment,
            np.full_like(part, np.inf) if number in how.empty else part,
            range_min_m=first.range_min, range_max_m=first.range_max,
            time_increment_s=1e-9 * beam_ns if how.times != "none" else 0.0,
        )  # fmt: skip


def _intervals(stamps, how):
    step_ns = how.width_deg / 360.0 * PERIOD_NS
    count = int((stamps[-1] - stamps[0] + PERIOD_NS) / step_ns + 1e-6)
    for number in range(count):
        if not any(stamp <= stamps[0] + round(number * step_ns) < stamp + PERIOD_NS for stamp in stamps):
            continue  # in a dropout
        yield number, stamps[0] + round(number * step_ns), stamps[0] + round((number + 1) * step_ns)


def _stamp(begin_ns, end_ns, stamps, how):
    of_sweep = stamps[0] + (begin_ns - stamps[0]) // PERIOD_NS * PERIOD_NS
    return {"begin": begin_ns, "end": end_ns, "sweep": of_sweep}[how.stamp]
