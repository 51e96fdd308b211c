"""Mounting of the lidar on the robot, by static transforms or by those of /tf, which may change."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from scanchain import lie
from scanchain.data import Matrix, Pose
from scanchain.logs.mcap.records import Channel, FileIndex
from scanchain.logs.mcap.selection import Span
from scanchain.logs.mcap.stream import first_messages, spread_messages
from scanchain.logs.messages.poses import StampedPose, chain, frames_between
from scanchain.logs.messages.readers import (
    has_transforms,
    is_odometry,
    pose_reader,
    reader,
)
from scanchain.logs.topics import topics_of

_BASE_FRAMES = ("base_link", "base_footprint", "base")
_WORLD_WORDS = {"map", "odom", "world", "earth", "global", "origin", "init"}  # in names of frames that stand still
_TURN_RAD, _SHIFT_M = np.radians(0.2), 0.005  # least turn and shift of a mount that moves
_TILT_RAD, _LIFT_M = np.radians(1.0), 0.1  # least tilt and lift of a planar lidar that leaves its plane
TILTED_RAD = np.radians(10.0)  # tilt of a planar lidar's plane from which on it is no floor plan
_TURNED_DEG = 0.5  # least turn of a lidar on its robot that is worth a word
_FULL_TURN_DEG = 360.0
_MOUNT_M = 1.0  # largest motion of a sensor on a robot; a frame that moves by more is no part of it

Edge = tuple[str, str]  # parent and child


class Motion(NamedTuple):
    """Extent of a lidar's motion on its mount since its first pose: the joint, and the lidar's axis of turn."""

    joint: Edge
    least_rad: float
    most_rad: float
    axis: str
    shift_m: float
    leaves_plane: bool

    def __str__(self) -> str:
        low, high = np.degrees((self.least_rad, self.most_rad))
        angles = f"from {low:.0f} to {high:.0f} deg" if high - low < _FULL_TURN_DEG else "round and round"
        turn = f"turns {angles} about its {self.axis} axis"
        shift = f" and shifts by {self.shift_m:.2f} m" if self.shift_m > _SHIFT_M else ""
        return f"{self.joint[0]} → {self.joint[1]} in /tf {turn}{shift}"


class Mounting(NamedTuple):
    """The pose of a lidar on its robot.

    Attributes
    ----------
    base, lidar : frames; the base's is empty where the log does not state it
    T_base_lidar : (4, 4), the first one seen where it moves; the identity where the log does not state it
    fixed : the static transforms; joints : those of /tf between base and lidar, none where all are static
    motion : None where the lidar stays where it is
    note : what was assumed, empty where nothing was
    """

    base: str
    lidar: str
    T_base_lidar: Pose
    fixed: tuple[StampedPose, ...] = ()
    joints: tuple[Edge, ...] = ()
    motion: Motion | None = None
    note: str = ""

    @property
    def base_name(self) -> str:
        """Name of the base in print: its frame where that is another than usual."""
        return "the base" if not self.base or self.base in _BASE_FRAMES else self.base

    @property
    def source(self) -> str:
        """Source of the mounting as text."""
        if self.motion is not None:
            return "by transforms of /tf that change"
        return "by transforms of /tf, which do not change" if self.joints else "by static transforms"

    @property
    def out_of_plane(self) -> list[str]:
        """Notes on a planar lidar whose plane is not that of the base as seen from above."""
        tilted_rad = tilt_rad(self.T_base_lidar)
        if tilted_rad > TILTED_RAD:
            return [
                f"the plane of the scans is tilted by {np.degrees(tilted_rad):.0f} deg on {self.base_name} "
                f"{self.source}: a floor plan takes a level one; correct the transforms, or choose another --topic"
            ]
        if is_upside_down(self.T_base_lidar):
            return [f"the lidar hangs upside down {self.source}: its scans are mirrored"]
        return []

    def at(self, joints: Sequence[StampedPose]) -> Pose:
        """T_base_lidar (4, 4) with these transforms of its joints."""
        T_base_lidar = chain([*self.fixed, *joints], self.base, self.lidar)
        return self.T_base_lidar if T_base_lidar is None else T_base_lidar


class MovingFrame(NamedTuple):
    """A frame and its pose (d+1, d+1) as seen from the lidar."""

    name: str
    T_lidar_frame: Pose


def find_mounting(indexes: Sequence[FileIndex], lidar: Channel, wheels: Channel | None, span: Span) -> Mounting:
    """The mounting of a lidar as the chosen part of a log shows it."""
    fixed = static_transforms(indexes)
    topics = joint_topics(indexes)
    if not fixed and not topics and wheels is None:
        return Mounting("", "", np.eye(4))
    frame = _frame_of(indexes, lidar)
    stated = None
    if wheels is not None and is_odometry(wheels):
        stated = next(first_messages(indexes, wheels.topic, pose_reader(wheels, 3)), None)
    bases = [name.lstrip("/") for name in ("" if stated is None else stated.child, *_BASE_FRAMES) if name]
    for base in bases:
        T_base_lidar = chain(fixed, base, frame)
        if T_base_lidar is not None:
            return Mounting(base, frame, T_base_lidar)
    worlds = {"" if stated is None else stated.parent.lstrip("/")}
    seen = _moving_transforms(indexes, topics, span)
    worlds |= {name for each in (*seen, *map(edge, fixed)) for name in each if _is_of_the_world(name)}
    moving = {joint: poses for joint, poses in seen.items() if not worlds & set(joint)}
    tree = [*fixed, *(poses[0] for poses in moving.values())]
    base = next((base for base in bases if chain(tree, base, frame) is not None), "")
    root = base or _top(fixed, moving, frame, worlds)
    if root == frame:
        why = f"no static transform from {bases[0]} to {frame or 'the lidar'}"
        note = "" if not fixed and wheels is None else f"{why}: the lidar is taken to sit at the robot's origin"
        return Mounting("", frame, np.eye(4), note=note)
    note = "" if base else f"the log has no transform from {bases[0]} to {frame}: {root} is taken as the base"
    return _seen(root, frame, fixed, moving, note)


def moving_frame(
    indexes: Sequence[FileIndex], lidar: Channel, mounting: Mounting, *, dimension: int
) -> MovingFrame:
    """The root of the fixed transforms above the lidar, the lidar's own frame where the log has none.

    Transforms of /tf that join it to the base and do not change are as good as fixed ones.
    """
    frame = _frame_of(indexes, lidar) or "lidar"
    transforms = static_transforms(indexes)
    if mounting.joints and mounting.motion is None:
        transforms.append(StampedPose(0, mounting.base, frame, mounting.T_base_lidar))
    root = root_frame(transforms, frame)
    T_root_lidar = chain(transforms, root, frame)
    T_root_lidar = np.eye(4) if T_root_lidar is None else T_root_lidar
    return MovingFrame(root, lie.inverse(in_plane(T_root_lidar) if dimension == 2 else T_root_lidar))


def joint_topics(indexes: Sequence[FileIndex]) -> dict[str, Channel]:
    """The topics of transforms that may change, by name."""
    topics = topics_of(indexes)
    return {
        name: channel
        for name, channel in topics.items()
        if has_transforms(channel) and not name.endswith("tf_static")
    }


def _moving_transforms(
    indexes: Sequence[FileIndex], topics: dict[str, Channel], span: Span
) -> dict[Edge, list[StampedPose]]:
    """Messages of each transform that may change, from parts of the log spread over it."""
    found: dict[Edge, list[StampedPose]] = {}
    for topic, channel in topics.items():
        for transforms in spread_messages(indexes, topic, reader(channel), span):
            for each in transforms:
                found.setdefault(edge(each), []).append(each)
    return found


def _is_of_the_world(frame: str) -> bool:
    """True if a frame has a name of those in which robots move: map, robot_1/odom, camera_init."""
    return bool(_WORLD_WORDS & set(re.split(r"[/_]", frame.lower())))


def _top(fixed: Sequence[StampedPose], moving: dict[Edge, list[StampedPose]], frame: str, worlds: set[str]) -> str:
    """The topmost frame above the lidar that is a part of the robot."""
    parents = {child: parent for parent, child in [edge(each) for each in fixed]}
    for (parent, child), poses in moving.items():
        if np.ptp([pose.T_parent_child[:3, 3] for pose in poses], axis=0).max() < _MOUNT_M:
            parents.setdefault(child, parent)
    seen: list[str] = []
    while frame in parents and parents[frame] not in worlds and frame not in seen:
        seen.append(frame)
        frame = parents[frame]
    return frame


def _seen(
    base: str,
    frame: str,
    fixed: Sequence[StampedPose],
    moving: dict[Edge, list[StampedPose]],
    note: str,
) -> Mounting:
    """The mounting between two frames that are joined, with the motion that its joints show."""
    first = {joint: poses[0] for joint, poses in moving.items()}
    on_path = frames_between([*fixed, *first.values()], base, frame)
    pairs = {frozenset(pair) for pair in pairwise(on_path)}
    static = {frozenset(edge(each)) for each in fixed}
    joints = tuple(joint for joint in first if frozenset(joint) in pairs - static)
    rest = Mounting(base, frame, np.eye(4), tuple(fixed), joints, note=note)
    rest = rest._replace(T_base_lidar=rest.at([first[joint] for joint in joints]))
    motions = []
    for joint in joints:
        others = [first[other] for other in joints if other != joint]
        motions.append((joint, np.array([rest.at([*others, pose]) for pose in moving[joint]])))
    moved = [motion for joint, poses in motions if (motion := _motion(joint, poses)) is not None]
    return rest._replace(motion=max(moved, key=lambda motion: motion.most_rad - motion.least_rad, default=None))


def _motion(joint: Edge, T_base_lidar: Matrix) -> Motion | None:
    """Motion of a lidar whose poses (N, 4, 4) one joint changes; None where it does not move."""
    turns = lie.log(lie.between(np.broadcast_to(T_base_lidar[0], T_base_lidar.shape), T_base_lidar))[:, 3:]
    axis = np.linalg.svd(turns)[2][0] if len(turns) > 1 else np.eye(3)[2]
    axis = axis * np.sign(axis[np.argmax(np.abs(axis))])
    angles_rad = np.unwrap(turns @ axis)
    shift_m = float(np.ptp(T_base_lidar[:, :3, 3], axis=0).max())
    if not any(is_moved(T_base_lidar[0], T) for T in T_base_lidar):
        return None
    name = "xyz"[int(np.argmax(np.abs(axis)))]
    leaves = any(leaves_plane(T_base_lidar[0], T) for T in T_base_lidar)
    return Motion(joint, float(angles_rad.min()), float(angles_rad.max()), name, shift_m, leaves)


def edge(transform: StampedPose) -> Edge:
    """The frames that a transform joins."""
    return transform.parent.lstrip("/"), transform.child.lstrip("/")


def is_moved(T_base_first: Pose, T_base_lidar: Pose) -> bool:
    """True if a lidar's pose on the robot has changed."""
    shift_m, turn_rad = lie.apart(T_base_first, T_base_lidar)
    return turn_rad > _TURN_RAD or shift_m > _SHIFT_M


def leaves_plane(T_base_first: Pose, T_base_lidar: Pose) -> bool:
    """True if a planar lidar that was in a plane has tilted or risen out of it."""
    cosine = float(T_base_first[:3, 2] @ T_base_lidar[:3, 2])
    return cosine < np.cos(_TILT_RAD) or abs(T_base_first[2, 3] - T_base_lidar[2, 3]) > _LIFT_M


def root_frame(transforms: Sequence[StampedPose], frame: str) -> str:
    """The topmost frame to which fixed transforms join a frame; the frame itself where there are none."""
    parents = {each.child.lstrip("/"): each.parent.lstrip("/") for each in transforms}
    seen: list[str] = []
    while frame in parents and frame not in seen:
        seen.append(frame)
        frame = parents[frame]
    return frame


def is_upside_down(T_base_lidar: Pose) -> bool:
    """True if the lidar's z axis points downwards."""
    return bool(T_base_lidar[2, 2] < 0.0)


def tilt_rad(T_base_lidar: Pose) -> float:
    """Angle between a planar lidar's plane and that of the base, rad, 0 of one that hangs upside down."""
    return float(np.arccos(np.clip(abs(T_base_lidar[2, 2]), 0.0, 1.0)))


def turned_by(T_base_lidar: Pose) -> str:
    """Orientation of a lidar on its base as text, by the angles that are not zero; empty without any."""
    T = lie.lift(T_base_lidar)
    pitch_rad = np.arcsin(np.clip(-T[2, 0], -1.0, 1.0))
    angles_deg = np.degrees([np.arctan2(T[2, 1], T[2, 2]), pitch_rad, lie.yaw(T)]).tolist()
    angles = zip(("roll", "pitch", "yaw"), angles_deg, strict=True)
    return ", ".join(f"{name} {angle:.0f} deg" for name, angle in angles if abs(angle) > _TURNED_DEG)


def in_plane(T_base_lidar: Pose) -> Pose:
    """T_base_lidar (3, 3) of a planar scanner.

    One that hangs upside down sees the plane mirrored; its points are turned about its own x axis (y → −y), and
    so is its mounting, so that both are as seen from above.
    """
    if is_upside_down(T_base_lidar):
        T_base_lidar = T_base_lidar @ np.diag([1.0, -1.0, -1.0, 1.0])
    return lie.flatten(T_base_lidar)


def static_transforms(indexes: Sequence[FileIndex]) -> list[StampedPose]:
    """Every transform of the topics of fixed ones."""
    found: list[StampedPose] = []
    for topic, channel in topics_of(indexes).items():
        if topic.endswith("tf_static") and has_transforms(channel):
            for transforms in first_messages(indexes, topic, reader(channel)):
                found += transforms
    return found


def _frame_of(indexes: Sequence[FileIndex], lidar: Channel) -> str:
    """The frame of a lidar's first messages, empty where they name none."""
    read = reader(lidar)
    return next(first_messages(indexes, lidar.topic, lambda data: read(data).frame), "").lstrip("/")
