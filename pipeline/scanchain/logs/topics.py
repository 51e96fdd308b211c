"""Choice of a log's lidar and wheel odometry topics, and its other sensors."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from scanchain.config import NO_TOPIC, LogConfig
from scanchain.errors import InputError
from scanchain.logs.index import Channel, FileIndex, damage_of, name_of
from scanchain.logs.messages.readers import LIDAR_TYPES, has_poses, is_lidar, is_moving_transforms, kind, role

_MOST_LISTED = 8  # largest number of topics in an error
_USUAL_TRUTH = LogConfig().ground_truth_topic
_TRUTH_WORDS = {"truth", "groundtruth", "gt", "mocap", "vicon", "optitrack"}  # of topics with true poses
_USES = {
    "imu": ("IMU", "predicts motions where it does so better than the scans"),
    "gnss": ("GNSS", "its fixes give the place on Earth, and correct drift where they show any"),
}
_NOT_READ = "nmea_msgs/Sentence", "foxglove.LocationFixes"  # of GNSS


def topics_of(indexes: Sequence[FileIndex]) -> dict[str, Channel]:
    """One channel of each topic, by name."""
    channels: dict[str, Channel] = {}
    for index in indexes:
        for channel in index.channels.values():
            channels.setdefault(channel.topic, channel)
    return dict(sorted(channels.items()))


def find_lidars(indexes: Sequence[FileIndex], wanted: str) -> list[Channel]:
    """The lidars' channels: of the configured topics, else of the only lidar. Raises InputError if not unique."""
    topics = [wanted] if wanted in topics_of(indexes) else [topic.strip() for topic in wanted.split(",")]
    return [_lidar(indexes, topic) for topic in dict.fromkeys(topics)]


def _lidar(indexes: Sequence[FileIndex], wanted: str) -> Channel:
    channels = topics_of(indexes)
    name = name_of(indexes)
    lidars = [channel for channel in channels.values() if is_lidar(channel)]
    found = [channel for channel in lidars if wanted in ("", channel.topic)]
    if len(found) == 1:
        return found[0]
    if not lidars:
        absent = f"topic {wanted}, nor any other" if wanted and wanted not in channels else "lidar topic"
        raise InputError(
            f"{name}: has no {absent} of a supported type ({LIDAR_TYPES}); "
            f"it contains: {_listed(channels.values())}{damage_of(indexes)}"
        )
    if wanted:
        is_other = f"topic {_listed([channels[wanted]])} is not of a lidar" if wanted in channels else ""
        why = is_other or f"has no topic {wanted}"
        raise InputError(f"{name}: {why}; choose --topic from: {_listed(lidars)}")
    raise InputError(
        f"{name}: has several lidar topics; choose one with --topic, or several, which are then combined: "
        f"{_listed(lidars, indexes)}"
    )


def find_odometry(indexes: Sequence[FileIndex], config: LogConfig, notes: list[str]) -> Channel | None:
    """The wheel odometry's channel: the configured topic, else the only one that is not of true poses.

    None if there are several. Without any, the first topic of moving transforms, which may contain it.
    """
    moving = [each for each in topics_of(indexes).values() if is_moving_transforms(each)]
    if named := [each for each in moving if each.topic == config.odometry_topic]:
        return named[0]
    if config.odometry_topic:
        return _chosen(indexes, config.odometry_topic, "log.odometry_topic")
    found = [each for each in topics_of(indexes).values() if role(each) == "odometry"]
    found = [each for each in found if each.topic != config.ground_truth_topic and not _is_truth(each.topic)]
    if len(found) > 1:
        names = ", ".join(channel.topic for channel in found)
        notes.append(f"several odometry topics ({names}), none is used; choose with --log.odometry_topic")
        return None
    return next(iter([*found, *moving]), None)


def _is_truth(topic: str) -> bool:
    return not _TRUTH_WORDS.isdisjoint(re.split(r"[/_]", topic.lower()))


def find_ground_truth(indexes: Sequence[FileIndex], wanted: str) -> Channel | None:
    """The ground truth's channel, None for ``NO_TOPIC``; only the default topic may be missing."""
    if wanted == NO_TOPIC:
        return None
    usual = topics_of(indexes).get(_USUAL_TRUTH)
    if wanted == _USUAL_TRUTH and not (usual and has_poses(usual)):
        return None
    return _chosen(indexes, wanted, "log.ground_truth_topic")


@dataclass(frozen=True, slots=True)
class OtherSensor:
    """A topic other than those of lidar and wheels: its sensor, and its use by a run."""

    sensor: str
    topic: str
    use: str


def other_sensors(
    indexes: Sequence[FileIndex],
    *,
    wheels: str,
    truth: str,
    placed: Mapping[str, str] | None,
    uses_imu: bool = True,
) -> list[OtherSensor]:
    """Ground truth, IMU, GNSS and other poses of a log.

    wheels, truth : topics that are used; placed : those of IMU and GNSS, and where the sensors are; None where
        they cannot be chosen yet, since the lidar is not
    uses_imu : odometry.imu
    """
    found = []
    for topic, channel in topics_of(indexes).items():
        if topic == truth:
            found.append(OtherSensor("ground truth", topic, "evaluates the result, is not used for it"))
        elif (key := role(channel)) in _USES:
            sensor, use = _USES[key]
            if key == "imu" and not uses_imu:
                use = "not used: odometry.imu is false"
            elif placed is not None:
                unused = f"not used; choose it with --log.{key}_topic {topic}"
                use = f"{placed[topic]}; {use}" if topic in placed else unused
            found.append(OtherSensor(sensor, topic, use))
        elif kind(channel) in _NOT_READ:
            found.append(OtherSensor("GNSS", topic, f"not used: {kind(channel)} is not read"))
        elif has_poses(channel) and topic != wheels:
            use = f"--gt {topic} uses them as ground truth, --log.odometry_topic {topic} as wheels"
            found.append(OtherSensor("poses", topic, f"not used; {use}"))
    return found


def _chosen(indexes: Sequence[FileIndex], wanted: str, key: str) -> Channel:
    channels = {topic: channel for topic, channel in topics_of(indexes).items() if has_poses(channel)}
    if wanted in channels:
        return channels[wanted]
    on_tf = " or of transforms" if key == "log.odometry_topic" else ""
    raise InputError(
        f"{name_of(indexes)}: {key} {wanted} is not a topic of nav_msgs/Odometry or of stamped poses{on_tf}"
        f"; these are: {_listed(channels.values())}"
    )


def _listed(channels: Iterable[Channel], indexes: Sequence[FileIndex] = ()) -> str:
    """Channels as text, with their types and, if there are several files, the first that contains each."""
    names = []
    for channel in channels:
        unusual = "" if channel.encoding == "cdr" else f" in {channel.encoding or 'an unnamed encoding'}"
        file = f" in {indexes[channel.key[0]].path.name}" if len(indexes) > 1 else ""
        names.append(f"{channel.topic} ({kind(channel) or 'no schema'}{unusual}){file}")
    if len(names) > _MOST_LISTED:
        names[_MOST_LISTED:] = [f"{len(names) - _MOST_LISTED} more, see scanchain info"]
    return ", ".join(names) or "none"
