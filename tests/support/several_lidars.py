"""Simulated logs as recorded otherwise: by two lasers that publish on one topic, or played several times."""

import numpy as np

from scanchain.logs import open_log, stream
from scanchain.logs.messages.readers import reader
from scanchain.logs.topics import topics_of
from scanchain.logs.writer import Link, LogWriter, pack_laser_scan, pack_transforms, place
from tests.support.naive_logs import SECOND

# frames and places of two lasers: x, y, yaw, roll
LEFT, RIGHT = ("base_link", "left", 0.3, 0.1, 0.5, 0.0), ("base_link", "right", -0.2, -0.1, -2.0, 0.0)


def two_lasers(source, path, *, width_deg, is_flipped=False, yaws_deg=(90.0, -90.0)):
    """The scans of a laser that looks around as those of two that look aside, in turn; the second upside down."""
    log = open_log(source)
    frames, flips, number = ("left", "right"), (False, is_flipped), 0
    with LogWriter(path) as writer:
        links = []
        for frame, yaw_deg, flip in zip(frames, yaws_deg, flips, strict=True):
            T = log.mounting.T_base_lidar @ turned(np.radians(yaw_deg), flip=flip)
            links.append(Link("base_link", frame, place(T)))
        begin_ns = stream.whole_span(log.indexes).begin_ns
        writer.append("/tf_static", "tf2_msgs/msg/TFMessage", pack_transforms(begin_ns, *links), begin_ns)
        for message in recorded(log):
            if message.channel.topic == "/scan":
                which, number = number % 2, number + 1
                scan = reader(log.lidar)(memoryview(message.value)).message
                width_rad, sense = np.radians(width_deg), -1.0 if flips[which] else 1.0
                azimuth = scan.angle_min + scan.angle_increment * np.arange(len(scan.ranges))
                own = (azimuth - np.radians(yaws_deg[which]) + np.pi) % (2.0 * np.pi) - np.pi
                beams = np.flatnonzero(np.abs(own) <= 0.5 * width_rad)
                beams = beams[np.argsort(own[beams])]
                stamp_ns = scan.header.stamp.sec * SECOND + scan.header.stamp.nanosec
                stamp_ns += round(SECOND * scan.time_increment * int(beams[0]))
                data = pack_laser_scan(
                    stamp_ns, frames[which], sense * own[beams[0]], sense * scan.angle_increment,
                    scan.ranges[beams], range_min_m=scan.range_min, range_max_m=scan.range_max,
                    time_increment_s=scan.time_increment, scan_time_s=0.1,
                )  # fmt: skip
                logged_ns = stamp_ns + round(SECOND * scan.time_increment * len(beams))
                writer.append("/scan", "sensor_msgs/msg/LaserScan", data, stamp_ns, logged_ns)
            elif message.channel.topic == "/ground_truth":
                writer.copy(message.channel, message.log_time_ns, message.value)
    return path


def turned(yaw_rad, *, flip):
    c, s = np.cos(yaw_rad), np.sin(yaw_rad)
    T = np.array([[c, -s, 0.0, 0.0], [s, c, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    return T @ np.diag([1.0, -1.0, -1.0, 1.0]) if flip else T


def looped(source, path, *, laps, pause_s=0.3):
    """A log without wheels, played several times and recorded again: log times go on, stamps begin again."""
    log = open_log(source)
    span = stream.whole_span(log.indexes)
    with LogWriter(path) as writer:
        for lap in range(laps):
            later_ns = lap * (span.end_ns - span.begin_ns + round(pause_s * SECOND))
            for message in recorded(log):
                if message.channel.topic != "/odom" and (message.channel.topic != "/ground_truth" or not lap):
                    writer.copy(message.channel, message.log_time_ns + later_ns, message.value)
    return path


def recorded(log):
    """All messages of a log as they are."""
    decoders = dict.fromkeys(topics_of(log.indexes), bytes)
    return stream.decoded_messages(log.indexes, decoders, stream.EVERYTHING, damage=[])


def on_own_topics(source, path):
    """A log of several publishers on one topic with a topic for each, named after its frame."""
    log = open_log(source)
    with LogWriter(path) as writer:
        for message in recorded(log):
            if message.channel.topic == log.topic:
                head = reader(log.lidar)(memoryview(message.value)).message.header
                stamp_ns = head.stamp.sec * SECOND + head.stamp.nanosec
                name = "sensor_msgs/msg/LaserScan"
                writer.append(f"/{head.frame_id}", name, message.value, stamp_ns, message.log_time_ns)
            else:
                writer.copy(message.channel, message.log_time_ns, message.value)
    return path
