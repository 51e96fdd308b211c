"""Contents of a log, from its index alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from scanchain.config import LogConfig
from scanchain.errors import InputError, grouped
from scanchain.files import Source
from scanchain.logs.files import size_of
from scanchain.logs.log import Log
from scanchain.logs.mcap.records import FileIndex
from scanchain.logs.mcap.stream import times_of, whole_span
from scanchain.logs.messages.readers import kind
from scanchain.logs.opening import index_files
from scanchain.logs.topics import OtherSensor, find_ground_truth, find_odometry, other_sensors, topics_of


@dataclass(frozen=True, slots=True)
class TopicInfo:
    """A topic: message type, encoding, number of messages, mean rate.

    The rate is that between the first and the last of them, 0 where there is one alone.
    """

    topic: str
    type_name: str
    encoding: str
    messages: int
    rate_hz: float


@dataclass(frozen=True, slots=True)
class LogInfo:
    """A log: files, topics, those that a run would use, and problems.

    ``sensors`` are those beside lidar and wheels.
    ``lidar`` is empty where a run could not choose a topic, for the reason in ``problem``. Meters, radians,
    nanoseconds; ``T_base_lidar`` row by row, the first one where the lidar moves (``mount_motion``);
    ``base_frame`` is empty where the log does not state it.
    """

    files: tuple[str, ...]
    size_bytes: int
    start_ns: int
    duration_s: float
    topics: tuple[TopicInfo, ...]
    lidar: str = ""
    dimension: int = 0
    scans: int = 0
    odometry: str = ""
    sensors: tuple[OtherSensor, ...] = ()
    point_times: str = ""
    T_base_lidar: tuple[tuple[float, ...], ...] = ()
    base_frame: str = ""
    mount_motion: str = ""
    notes: tuple[str, ...] = ()
    damage: tuple[str, ...] = ()
    problem: str = ""


def describe(sources: Sequence[Source], config: LogConfig | None = None) -> LogInfo:
    """Contents of the files as one log. Raises InputError only for a file that is no MCAP file."""
    config = config or LogConfig()
    indexes = index_files(sources, config)
    whole = whole_span(indexes)
    wheels, truth, notes = _pose_topics(indexes, config)
    found = LogInfo(
        files=tuple(str(source) for source in sources),
        size_bytes=sum(size_of(source) for source in sources),
        start_ns=whole.begin_ns,
        duration_s=whole.duration_s,
        topics=_topics(indexes, whole.duration_s),
        odometry=wheels,
        sensors=tuple(other_sensors(indexes, wheels=wheels, truth=truth)),
        notes=tuple(notes),
        damage=tuple(grouped(line for index in indexes for line in index.damage)),
    )
    try:
        log = Log(indexes, config)
    except InputError as error:
        return replace(found, problem=error.text)
    return replace(
        found,
        lidar=log.topic,
        dimension=log.dimension,
        scans=log.scan_count,
        point_times=log.assumed_point_times(),
        T_base_lidar=tuple(tuple(row) for row in log.T_base_lidar.tolist()),
        base_frame=log.mounting.base,
        mount_motion=log.mounting.motion or "",
        notes=tuple(log.notes),
    )


def _pose_topics(indexes: Sequence[FileIndex], config: LogConfig) -> tuple[str, str, list[str]]:
    """Topics of wheels and ground truth, whichever lidar is chosen, and notes; empty where the log has none."""
    notes = [line for index in indexes for line in index.notes]
    try:
        wheels = find_odometry(indexes, config.odometry_topic, config.ground_truth_topic, notes)
        truth = find_ground_truth(indexes, config.ground_truth_topic, LogConfig().ground_truth_topic)
    except InputError:  # which is the problem of the log as well
        return "", "", notes
    return wheels.topic if wheels else "", truth.topic if truth else "", notes


def _topics(indexes: Sequence[FileIndex], duration_s: float) -> tuple[TopicInfo, ...]:
    """Every topic, its messages added up over the files."""
    result = []
    for topic, channel in topics_of(indexes).items():
        messages, first_ns, last_ns = times_of(indexes, topic)
        span_s = (last_ns - first_ns) * 1e-9 or duration_s
        rate_hz = (messages - 1) / span_s if span_s > 0.0 and messages > 1 else 0.0
        result.append(TopicInfo(topic, kind(channel), channel.encoding, messages, rate_hz))
    return tuple(result)
