"""Logs played backward: a lidar that faces where it came from sees at every scan what no map holds yet."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
from mcap.reader import make_reader
from mcap.writer import Writer
from scipy.spatial.transform import Rotation

_STAMP = struct.Struct("<iI")  # seconds and nanoseconds, after the four bytes that begin a CDR message
_STAMPED = ("LaserScan", "PointCloud2", "Odometry", "PoseStamped", "Imu")


def play_backward(log: Path, reference: Path, out: Path) -> None:
    """Write a ROS 2 log to ``out``, the last message first, and its .tum or .relations beside it.

    Time runs backward between the first and the last message; points have no times of their own.
    """
    with log.open("rb") as file:
        messages = list(make_reader(file).iter_messages(log_time_order=False))
    times_ns = [message.log_time for _, _, message in messages]
    both_ns = min(times_ns) + max(times_ns)
    with out.open("wb") as file:
        writer = Writer(file)
        writer.start(profile="ros2")
        channels: dict[int, int] = {}
        for schema, channel, message in sorted(messages, key=lambda each: -each[2].log_time):
            if channel.id not in channels:
                known = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, known)
            data, time_ns = message.data, both_ns - message.log_time
            if schema.name.rpartition("/")[2] in _STAMPED:
                seconds, nanoseconds = _STAMP.unpack_from(data, 4)
                stamp_ns = both_ns - (seconds * 10**9 + nanoseconds)
                data = data[:4] + _STAMP.pack(*divmod(stamp_ns, 10**9)) + data[12:]
            writer.add_message(channels[channel.id], time_ns, data, time_ns)
        writer.finish()
    mirrored = _mirrored_relations if reference.suffix == ".relations" else _mirrored_poses
    np.savetxt(out.with_suffix(reference.suffix), mirrored(np.loadtxt(reference), 1e-9 * both_ns), "%.9f")


def _mirrored_poses(rows: np.ndarray, both_s: float) -> np.ndarray:
    rows[:, 0] = both_s - rows[:, 0]
    return rows[::-1]


def _mirrored_relations(rows: np.ndarray, both_s: float) -> np.ndarray:
    """From the pose that is the earlier one now: the motion is the inverse."""
    turned = Rotation.from_euler("xyz", rows[:, 5:]).inv()
    return np.hstack([both_s - rows[:, [1, 0]], -turned.apply(rows[:, 2:5]), turned.as_euler("xyz")])
