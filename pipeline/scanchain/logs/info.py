"""Contents of a log, as ``scanchain info`` prints them."""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from scanchain.config import LogConfig
from scanchain.errors import InputError, grouped
from scanchain.files import Source
from scanchain.logs.files import size_of
from scanchain.logs.index import FileIndex
from scanchain.logs.log import Log
from scanchain.logs.messages.readers import has_poses, kind
from scanchain.logs.opening import index_files
from scanchain.logs.stream import ends_of, whole_span
from scanchain.logs.topics import find_ground_truth, find_odometry, other_sensors, topics_of


def describe(sources: Sequence[Source], config: LogConfig, *, uses_imu: bool = True) -> dict[str, Any]:
    """Files and topics of a log, the topics that a run would use, and problems. Raises InputError if it is no log.

    ``lidar`` is empty if a run could not choose a topic; ``problem`` is the reason. ``sensors`` are those other
    than lidar and wheels. Units are in the names, lengths in meters; ``T_base_lidar`` is a list of rows, of the
    first pose if the lidar moves (``mount_motion``); ``base_frame`` is empty if the log does not state it.
    uses_imu : odometry.imu
    """
    indexes = index_files(sources, config)
    whole = whole_span(indexes)
    notes, (wheels, truth) = [line for index in indexes for line in index.notes], ("", "")
    with suppress(InputError):  # Log raises it too: see ``problem``
        channels = find_odometry(indexes, config, notes), find_ground_truth(indexes, config.ground_truth_topic)
        wheels, truth = (channel.topic if channel and has_poses(channel) else "" for channel in channels)
    try:
        log, problem = Log(indexes, config), ""
    except InputError as error:
        log, problem = None, error.text
    return {
        "files": [str(source) for source in sources],
        "size_bytes": sum(size_of(source) for source in sources),
        "start_ns": whole.begin_ns,
        "duration_s": whole.duration_s,
        "topics": [_topic(indexes, topic, whole.duration_s) for topic in topics_of(indexes)],
        "lidar": log.topics if log else "",
        "dimension": log.dimension if log else 0,
        "scans": log.scan_count if log else 0,
        "odometry": log.odometry_topic if log else wheels,
        "wheels": log.wheels if log else wheels,
        "sensors": other_sensors(
            indexes, wheels=wheels, truth=truth, placed=log.placed if log else None, uses_imu=uses_imu
        ),
        "point_times": log.assumed_point_times() if log else "",
        "T_base_lidar": log.T_base_lidar.tolist() if log else [],
        "base_frame": log.mounting.base if log else "",
        "mount_motion": (log.mounting.motion or "") if log else "",
        "notes": log.notes if log else notes,
        "damage": grouped(line for index in indexes for line in index.damage),
        "problem": problem,
    }


def _topic(indexes: Sequence[FileIndex], topic: str, duration_s: float) -> dict[str, Any]:
    """Facts of a topic, its messages counted over all files; the rate is 0 for a single message."""
    channel = topics_of(indexes)[topic]
    messages = sum(index.counts.get(number, 0) for index in indexes for number in index.numbers_of(topic))
    span_s = (ends_of(indexes, topic).duration_s if messages > 1 else 0.0) or duration_s
    return {
        "topic": topic,
        "type_name": kind(channel),
        "encoding": channel.encoding,
        "messages": messages,
        "rate_hz": (messages - 1) / span_s if span_s > 0.0 and messages > 1 else 0.0,
    }
