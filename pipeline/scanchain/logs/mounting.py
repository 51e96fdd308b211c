"""Transforms of a log: mountings of lidar and IMU on the robot, and wheel odometry that is only on /tf."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.config import NO_TOPIC, LogConfig
from scanchain.data import Pose
from scanchain.errors import InputError, shown
from scanchain.logs.index import Channel, FileIndex, name_of
from scanchain.logs.messages.gnss import Fix
from scanchain.logs.messages.inertial import ImuSample
from scanchain.logs.messages.poses import Frames, StampedPose, chain
from scanchain.logs.messages.readers import Read, Role, is_moving_transforms, pose_reader, reader, role
from scanchain.logs.stream import Span, sampled_messages
from scanchain.logs.topics import find_odometry, topics_of

_BASE_FRAMES = ("base_link", "base_footprint", "base")
# words in the names of world-fixed frames
_WORLD_WORDS = {"map", "odom", "odometry", "world", "earth", "global", "origin", "init"}
_TURN_RAD, _SHIFT_M = np.radians(0.2), 0.005  # largest difference of transforms that count as equal
TILTED_RAD = np.radians(10.0)  # tilt of a planar lidar above which its scans are not a floor plan


class Mounting(NamedTuple):
    """The pose of a lidar on its robot.

    base : the robot's frame, empty if the log does not state it
    T_base_lidar : (4, 4), the first one if the lidar moves; the identity if the log does not state it
    source : origin of the pose, as text
    motion : the joint that moves the lidar and how far, as text; None if the lidar does not move
    note : assumptions, or contradicting transforms; empty if there are none
    is_stated : whether the log states the pose; False if the base or the pose is assumed
    """

    base: str
    T_base_lidar: Pose
    source: str = "by static transforms"
    motion: str | None = None
    note: str = ""
    is_stated: bool = True

    @property
    def base_name(self) -> str:
        """Name of the base as text: its frame if that is not a usual one."""
        return "the base" if not self.base or self.base in _BASE_FRAMES else self.base

    def notes(self, wheels: str, dimension: int) -> list[str]:
        """Notes on the mounting of a lidar of this dimension, on a robot with this topic of wheel odometry."""
        notes = [self.note] if self.note else []
        if self.motion is not None:
            prior = f"; the wheels ({wheels}) are no prior for it" if wheels else ""
            notes.append(
                f"the lidar moves on the robot ({self.motion}): poses are the lidar's, this motion included{prior}"
            )
        if dimension == 2 and (tilted_rad := tilt_rad(self.T_base_lidar)) > TILTED_RAD:
            notes.append(
                f"the plane of the scans is tilted by {np.degrees(tilted_rad):.0f} deg on {self.base_name} "
                f"{self.source}: a floor plan needs a level one; correct the transforms, or choose another --topic"
            )
        elif dimension == 2 and is_upside_down(self.T_base_lidar):
            notes.append(f"the lidar hangs upside down {self.source}: its scans are mirrored")
        return notes


class Wheels(NamedTuple):
    """Wheel odometry: its channel, its description as text, and its two frames if it is a transform of /tf."""

    channel: Channel
    text: str
    link: Frames | None = None


def find_wheels(
    indexes: Sequence[FileIndex], frame: str, config: LogConfig, span: Span, notes: list[str]
) -> Wheels | None:
    """Wheel odometry of a log: a topic or, without one, the transform from an odometry frame to the lidar's robot.

    Not odometry: map → odom of a SLAM system, a transform to the lidar's own frame and, unless it is configured,
    a transform that never changes.
    """
    topic, wanted = find_odometry(indexes, config, notes), config.odometry_topic
    if topic is None or not is_moving_transforms(topic):
        return topic and Wheels(topic, topic.topic)
    links: dict[Frames, tuple[Channel, list[StampedPose]]] = {}
    for channel in filter(is_moving_transforms, topics_of(indexes).values()):
        for each in _sampled(indexes, channel, span) if wanted in ("", channel.topic) else ():
            links.setdefault((each.parent, each.child), (channel, []))[1].append(each)
    parents = {each.child: each.parent for each in _transforms(indexes, is_fixed=True)}
    parents |= {child: parent for parent, child in links if not is_world(parent)}
    robot = [frame, *_above(frame, parents)]
    found = [(a, b) for a, b in links if "odom" in a.lower() and not is_world(b) and b != frame]
    own = [link for link in found if link[1] in robot]
    if own or any(name.rpartition("/")[2] in _BASE_FRAMES for name in robot):
        found = own  # not those of other robots
    names = ", ".join(" → ".join(link) for link in found or links) or "nothing"
    if wanted and len(found) != 1:
        raise InputError(
            f"{name_of(indexes)}: {wanted} has no transform from an odometry's frame to the lidar's robot, as "
            f"odom → base_link, or several; it contains: {names}"
        )
    if len(found) > 1:
        notes.append(f"several odometries on /tf ({names}), none is used")
    if len(found) != 1:
        return None
    channel, poses = links[found[0]]
    if not wanted and not np.ptp([each.T_parent_child for each in poses], axis=0).any():
        notes.append(f"{names} of {channel.topic} never changes: not used as odometry")
        return None
    steps_ns = np.diff(np.unique([each.stamp_ns for each in poses]))
    rate_hz = 1e9 / float(np.median(steps_ns)) if len(steps_ns) else 0.0
    return Wheels(channel, f"{channel.topic}: {names}, {rate_hz:.3g} Hz", found[0])


class Sensor(NamedTuple):
    """An IMU or a GNSS receiver: topic, reader of its messages, and pose (4, 4) in the frame of the lidar.

    The pose is None where the log does not state it; of a receiver it is that of the antenna.
    """

    topic: str
    read: Read
    T_lidar_sensor: Pose | None

    @property
    def place(self) -> str:
        """Its pose relative to the lidar, as text."""
        T = self.T_lidar_sensor
        return f"at {place_text(T)} from the lidar" if T is not None else "without a transform, which is estimated"


def find_sensors(
    indexes: Sequence[FileIndex], config: LogConfig, frame: str, span: Span, notes: list[str]
) -> tuple[Sensor | None, Sensor | None]:
    """IMU and GNSS receiver of the configured topics, else the only ones.

    Each is None for ``NO_TOPIC``, and if there are several.
    frame : of the lidar
    Raises InputError if a configured topic is not one of that sensor.
    """
    imu = _only(indexes, "imu", config.imu_topic, notes)
    gnss = _only(indexes, "gnss", config.gnss_topic, notes)
    T_imu, T_gnss = (each and _on_lidar(indexes, each, frame, span) for each in (imu, gnss))
    for T_rotation in stated_poses(config.imu_rotation, "log.imu_rotation"):
        T_imu = np.eye(4) if T_imu is None else T_imu.copy()
        T_imu[:3, :3] = T_rotation[:3, :3]
    return imu and Sensor(imu.topic, reader(imu), T_imu), gnss and Sensor(gnss.topic, reader(gnss), T_gnss)


_SENSORS = {  # name and types
    "imu": ("IMU", "sensor_msgs/Imu"),
    "gnss": ("GNSS receiver", "sensor_msgs/NavSatFix, gps_msgs/GPSFix or foxglove.LocationFix"),
}


def _only(indexes: Sequence[FileIndex], sensor: Role, wanted: str, notes: list[str]) -> Channel | None:
    """The configured channel of a sensor, else the only one."""
    found = {each.topic: each for each in topics_of(indexes).values() if role(each) == sensor}
    if wanted in found:
        return found[wanted]
    (name, type_name), names, key = _SENSORS[sensor], ", ".join(found), f"log.{sensor}_topic"
    if wanted not in ("", NO_TOPIC):
        known = f"these are: {names or 'none'}"
        raise InputError(f"{name_of(indexes)}: {key} {wanted} is not a topic of {type_name}; {known}")
    if len(found) > 1 and not wanted:
        notes.append(f"several {name}s ({names}), none is used; choose with --{key}")
    return next(iter(found.values())) if len(found) == 1 and not wanted else None


def _on_lidar(indexes: Sequence[FileIndex], channel: Channel, frame: str, span: Span) -> Pose | None:
    """T_lidar_sensor (4, 4) by the frame of the first sample; None where the log does not state it."""
    sampled = (each.value for each in sampled_messages(indexes, channel.topic, reader(channel)))
    samples = (sample for value in sampled for sample in (value if isinstance(value, list) else [value]))
    own = next((each.frame for each in samples if isinstance(each, ImuSample | Fix)), "")
    if not own or not frame:
        return None
    return np.eye(4) if own == frame else between_frames(indexes, span, frame, own)


class MovingFrame(NamedTuple):
    """A frame and its pose (d+1, d+1) in the lidar's frame."""

    name: str
    T_lidar_frame: Pose


def find_mounting(
    indexes: Sequence[FileIndex], frame: str, wheels: Wheels | None, span: Span, config: LogConfig
) -> Mounting:
    """Mounting of the lidar with ``frame`` (empty if it has none), from the chosen part of a log."""
    base_of_wheels = wheels.link[1] if wheels and wheels.link else ""
    if wheels is not None and role(wheels.channel) == "odometry":
        stated = next(sampled_messages(indexes, wheels.channel.topic, pose_reader(wheels.channel, 3)), None)
        base_of_wheels = "" if stated is None else stated.value.child
    for T in stated_poses(config.lidar_pose, "log.lidar_pose"):
        return Mounting(base_of_wheels, T, "by log.lidar_pose")
    bases = [name for name in (base_of_wheels, *_BASE_FRAMES) if name]
    if (stated := _stated(indexes, bases, frame, span)) is not None:
        if base_of_wheels in ("", stated.base):
            return stated
        note = f"no transform states where {base_of_wheels} is, whose odometry is taken as that of {stated.base}"
        return stated._replace(note="; ".join(filter(None, [stated.note, note])))
    fixed, rivals = _fixed(indexes)
    above = {frame, *_above(frame, {each.child: each.parent for each in fixed})}
    broken = {
        f"{each.parent} → {each.child} is no pose (NaN, or a quaternion of zeros): correct it"
        for channel in (each for each in topics_of(indexes).values() if role(each) == "transforms")
        for each in _sampled(indexes, channel, span, are_poses=False)
        if each.child in above
    }
    root = _root([each for each in fixed if not is_world(each.parent)], frame)
    T_root_lidar = chain(fixed, root, frame)
    if root != frame and T_root_lidar is not None:
        note = f"the log has no transform from {bases[0]} to {frame}: {root} is used as the base"
        notes = filter(None, [note, *sorted(broken), _disagreeing(fixed, rivals, root, frame)])
        return Mounting(root, T_root_lidar, note="; ".join(notes), is_stated=False)
    mounting = "is estimated from the wheels" if wheels else "is assumed: the lidar at the robot's origin"
    note = f"no static transform from {bases[0]} to {frame or 'the lidar'}: the mounting {mounting}"
    notes = [note, *sorted(broken)] if fixed or wheels or broken else []
    return Mounting("", np.eye(4), note="; ".join(notes), is_stated=False)


def stated_poses(text: str, key: str) -> list[Pose]:
    """Poses (4, 4) of a configuration key, ``x y z qx qy qz qw`` or ``qx qy qz qw``, separated by commas."""
    poses = list[Pose]()
    for words in filter(None, text.split(",")):
        try:
            numbers = np.array([float(word) for word in words.split()])
        except ValueError:
            numbers = np.empty(0)
        if len(numbers) not in (4, 7) or not np.isfinite(numbers).all() or not numbers[-4:].any():
            raise InputError(f"{key} is {shown(words)}; wanted x y z qx qy qz qw, a rotation qx qy qz qw")
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = lie.from_quaternion(numbers[-4:]), numbers[:-4] if len(numbers) == 7 else 0.0
        poses.append(T)
    return poses


def between_frames(indexes: Sequence[FileIndex], span: Span, target: str, source: str) -> Pose | None:
    """T_target_source (4, 4) of two frames that do not move relative to each other, None if there is none."""
    stated = _stated(indexes, [target], source, span)
    return None if stated is None or stated.motion else stated.T_base_lidar


def _stated(indexes: Sequence[FileIndex], bases: Sequence[str], frame: str, span: Span) -> Mounting | None:
    """Mounting on the first of ``bases`` connected by static transforms, or else by /tf; None if none is."""
    fixed, rivals = _fixed(indexes)
    for base in bases:
        T_base_lidar = chain(fixed, base, frame)
        if T_base_lidar is not None:
            return Mounting(base, T_base_lidar, note=_disagreeing(fixed, rivals, base, frame))
    joints: dict[Frames, list[StampedPose]] = {}
    for each in _transforms(indexes, is_fixed=False, span=span):
        if not is_world(each.parent):
            joints.setdefault((each.parent, each.child), []).append(each)
    first = [*fixed, *(poses[0] for poses in joints.values())]
    for base in bases:
        T_base_lidar = chain(first, base, frame)
        if T_base_lidar is not None:
            motion = _motion(joints, first, base, frame)
            source = "by transforms of /tf" + (" that change" if motion else ", which do not change")
            return Mounting(base, T_base_lidar, source, motion)
    return None


def _fixed(indexes: Sequence[FileIndex]) -> tuple[list[StampedPose], dict[str, str]]:
    """Static transforms, the latest of each child as in tf2, and warnings, by child, about conflicting ones."""
    latest, rivals = dict[str, StampedPose](), dict[str, str]()
    for each in _transforms(indexes, is_fixed=True):
        before = latest.get(each.child, each)
        shift_m, turn_rad = lie.apart(before.T_parent_child, each.T_parent_child)
        if before.parent != each.parent or shift_m > _SHIFT_M or turn_rad > _TURN_RAD:
            each_pose = (f"{a.parent} → {a.child}: {place_text(a.T_parent_child)}" for a in (before, each))
            stated = f"/tf_static states {' and then '.join(each_pose)}"
            rivals[each.child] = f"{stated}; the latest is used, as in tf2: stop the wrong publisher"
        latest[each.child] = each
    return list(latest.values()), rivals


def _disagreeing(fixed: Sequence[StampedPose], rivals: dict[str, str], base: str, frame: str) -> str:
    """Warnings about conflicting transforms on the chain from base to lidar, as text."""
    without = {child: [each for each in fixed if each.child != child] for child in rivals}
    return "; ".join(rivals[child] for child, rest in without.items() if chain(rest, base, frame) is None)


def _motion(
    joints: dict[Frames, list[StampedPose]], first: Sequence[StampedPose], base: str, frame: str
) -> str | None:
    """The joint between base and lidar that rotates most, and how far, as text; None if none moves."""
    motion, most_rad = None, -1.0
    for joint, poses in joints.items():
        if chain([each for each in first if (each.parent, each.child) != joint], base, frame) is not None:
            continue  # not on the chain from base to lidar
        moved = [lie.apart(poses[0].T_parent_child, pose.T_parent_child) for pose in poses]
        shift_m, turn_rad = np.max(moved, axis=0)
        if (turn_rad > _TURN_RAD or shift_m > _SHIFT_M) and turn_rad > most_rad:
            most_rad = turn_rad
            shift = f" and shifts by {shift_m:.2f} m" if shift_m > _SHIFT_M else ""
            motion = f"{joint[0]} → {joint[1]} in /tf turns by up to {np.degrees(turn_rad):.0f} deg{shift}"
    return motion


def moving_frame(indexes: Sequence[FileIndex], frame: str, mounting: Mounting, *, dimension: int) -> MovingFrame:
    """Root frame of the static transforms above the lidar; the lidar's own frame if the log has none.

    Transforms of /tf between base and lidar that do not change count as static.
    """
    frame = frame or "lidar"
    transforms, _ = _fixed(indexes)
    if mounting.base and mounting.motion is None and chain(transforms, mounting.base, frame) is None:
        transforms.append(StampedPose(0, mounting.base, frame, mounting.T_base_lidar))
    root = _root(transforms, frame)
    T_root_lidar = chain(transforms, root, frame)
    T_root_lidar = np.eye(4) if T_root_lidar is None else T_root_lidar
    return MovingFrame(root, lie.inverse(in_plane(T_root_lidar) if dimension == 2 else T_root_lidar))


def _root(transforms: Sequence[StampedPose], frame: str) -> str:
    """Topmost ancestor of a frame; the frame itself if it has no parent."""
    return [frame, *_above(frame, {each.child: each.parent for each in transforms})][-1]


def _above(frame: str, parents: dict[str, str]) -> Iterator[str]:
    """Ancestors of a frame, nearest first; ``parents`` by child."""
    while frame in parents:
        frame = parents.pop(frame)  # so that a cycle ends
        yield frame


def is_world(frame: str) -> bool:
    """True if by its name a frame is fixed to the world."""
    return not _WORLD_WORDS.isdisjoint(re.split(r"[/_]", frame.lower()))


def is_upside_down(T_base_lidar: Pose) -> bool:
    """True if the lidar's z axis points downwards."""
    return bool(T_base_lidar[2, 2] < 0.0)


def tilt_rad(T: Pose) -> float:
    """Angle between the xy planes of two frames, at most π/2; turning one upside down does not change it."""
    return float(np.arccos(np.clip(abs(T[2, 2]), 0.0, 1.0)))


def angles_rad(T: Pose) -> list[float]:
    """Roll, pitch and yaw of a pose (4, 4)."""
    return [math.atan2(T[2, 1], T[2, 2]), math.asin(min(max(-T[2, 0], -1.0), 1.0)), math.atan2(T[1, 0], T[0, 0])]


def turned_by(T_base_lidar: Pose) -> str:
    """Orientation of a lidar on its base as text, by its nonzero angles; empty if there are none."""
    angles = zip(("roll", "pitch", "yaw"), np.degrees(angles_rad(lie.lift(T_base_lidar))), strict=True)
    return ", ".join(f"{name} {angle:.0f} deg" for name, angle in angles if abs(angle) > 0.5)


def place_text(T: Pose, frame: str = "") -> str:
    """A pose as text: its position, on which frame, and the nonzero angles of its orientation."""
    at = ", ".join(f"{axis} {value_m:.3f} m" for axis, value_m in zip("xyz", T[:-1, -1], strict=False))
    turned = turned_by(T)
    return f"{at}{frame and f' on {frame}'}{turned and f', turned by {turned}'}"


def in_plane(T_base_lidar: Pose) -> Pose:
    """T_base_lidar (3, 3) of a planar scanner.

    A scanner mounted upside down measures the plane mirrored; its points (y → −y) and its mounting are rotated by
    π about its own x axis, so that both are as seen from above.
    """
    if is_upside_down(T_base_lidar):
        T_base_lidar = T_base_lidar @ np.diag([1.0, -1.0, -1.0, 1.0])
    return lie.flatten(T_base_lidar)


def _transforms(indexes: Sequence[FileIndex], *, is_fixed: bool, span: Span | None = None) -> list[StampedPose]:
    """Transforms of the static topics, or of those that may change, sampled over the span."""
    found: list[StampedPose] = []
    for channel in topics_of(indexes).values():
        if role(channel) == "transforms" and is_moving_transforms(channel) != is_fixed:
            found += _sampled(indexes, channel, span)
    return found


def _sampled(
    indexes: Sequence[FileIndex], channel: Channel, span: Span | None, *, are_poses: bool = True
) -> list[StampedPose]:
    sample = sampled_messages(indexes, channel.topic, reader(channel), span)
    found = (each for message in sample for each in message.value)
    return [each for each in found if np.isfinite(each.T_parent_child).all() == are_poses]
