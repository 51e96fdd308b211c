"""A log: one or several MCAP files, read as a stream of scans."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence
from itertools import islice
from pathlib import Path
from time import perf_counter

import numpy as np

from pipeline import lie
from pipeline.config import LogConfig
from pipeline.data import Pose, Scan, Trajectory
from pipeline.errors import InputError
from pipeline.logs.blocks import DamagedBlockError, Message, read_block
from pipeline.logs.cdr import CdrReader, MalformedMessageError
from pipeline.logs.index import Block, FileIndex, index_file
from pipeline.logs.laser_scan import LaserScanDecoder, Returns
from pipeline.logs.limits import RangeLimits
from pipeline.logs.mounting import in_plane, is_upside_down, mounting
from pipeline.logs.point_cloud import PointCloudDecoder
from pipeline.logs.poses import StampedPose, decode_odometry, decode_transforms
from pipeline.logs.stream import Decoded, decoded_messages
from pipeline.logs.topics import LASER_SCAN, ODOMETRY, TRANSFORMS, find_lidar, find_odometry, kind
from pipeline.logs.wheels import WheelTrack

_PEEK_BLOCKS = 8  # read at opening to learn the frames
_HOLD_NS = 500_000_000  # log time that a scan waits for the wheel reading behind it
_HOLD_SCANS = 32


def open_log(paths: Sequence[Path], config: LogConfig) -> Log:
    """The files as one log, topics chosen. Raises InputError for what cannot be read or chosen."""
    indexes = [index_file(path, number) for number, path in enumerate(paths)]
    for index in indexes:
        if index.blocks and not index.has_summary:
            _learn_channels(index)
    return Log(indexes, config)


class Log:
    """An opened log; ``scans`` can be iterated any number of times.

    Attributes
    ----------
    topic, dimension : the lidar's topic; 2 for LaserScan, 3 for PointCloud2
    T_base_lidar : (d+1, d+1) mounting from /tf_static, the identity where the log does not say
    scan_count : scans to expect after start, end and every, by the index
    duration_s : from the first message to the last
    has_odometry : whether scans carry the wheels' pose
    notes : what was chosen or assumed; damage : what could not be read, complete once ``scans`` is through
    """

    def __init__(self, indexes: list[FileIndex], config: LogConfig) -> None:
        self.config = config
        self.indexes = indexes
        self.paths = tuple(index.path for index in indexes)
        self.notes: list[str] = []
        self.damage: list[str] = [line for index in indexes for line in index.damage]
        self.lidar = find_lidar(indexes, config.topic)
        self.odometry = find_odometry(indexes, config.odometry_topic, config.ground_truth_topic, self.notes)
        self.topic = self.lidar.topic
        self.dimension = 2 if kind(self.lidar) == LASER_SCAN else 3
        self.has_odometry = self.odometry is not None
        self.blocks = [block for index in indexes for block in index.blocks]
        self.start_ns = min(block.start_ns for block in self.blocks)
        self.duration_s = (max(block.end_ns for block in self.blocks) - self.start_ns) * 1e-9
        T_base_lidar = self._mounting()
        self.mirrored = self.dimension == 2 and is_upside_down(T_base_lidar)
        self.T_base_lidar: Pose = in_plane(T_base_lidar) if self.dimension == 2 else T_base_lidar
        self.truth: list[StampedPose] = []

    @property
    def scan_count(self) -> int:
        """Scans to expect, from the index; an estimate where a part of the log is chosen."""
        total = sum(
            index.counts.get(number, 0)
            for index in self.indexes
            for number, channel in index.channels.items()
            if channel.topic == self.topic
        )
        start_s, end_s = self.config.start_s, min(self.config.end_s, self.duration_s)
        share = (end_s - start_s) / self.duration_s if self.duration_s else 1.0
        return -(-round(total * min(max(share, 0.0), 1.0)) // self.config.every)

    def scans(self) -> Iterator[Scan]:
        """Scans in the order of log time, each with the wheels' pose at its stamp.

        Raises InputError where a scan is malformed or has no valid point at all; damaged chunks are left out and
        named in ``damage``.
        """
        self.truth = []
        found = len(self.damage)
        count = 0
        asked = perf_counter()
        for message, T_odom_base in self._with_wheels():
            returns = self._checked(message, count)
            count += 1
            if (count - 1) % self.config.every:
                continue
            points = returns.points * np.array([1.0, -1.0], np.float32) if self.mirrored else returns.points
            yield Scan(
                index=(count - 1) // self.config.every,
                stamp_ns=returns.stamp_ns,
                log_time_ns=message.log_time_ns,
                points=points,
                times_s=returns.times_s,
                dropped=returns.dropped,
                T_odom_base=T_odom_base,
                waited_s=perf_counter() - asked,
            )
            asked = perf_counter()
        if not count:
            raise InputError(f"{self.paths[0]}: no scan of {self.topic} could be read; see scanchain info")
        if len(self.damage) > found or any(index.damage for index in self.indexes):
            self.damage.append(f"{count} scans of {self.topic} were recovered")

    def ground_truth(self) -> Trajectory | None:
        """Poses of ``log.ground_truth_topic`` met by ``scans`` so far; None where there are none."""
        if not self.truth:
            return None
        poses = np.array([pose.T_parent_child for pose in self.truth])
        stamps_ns = np.array([pose.stamp_ns for pose in self.truth], np.int64)
        return Trajectory(stamps_ns, lie.flatten(poses) if self.dimension == 2 else poses)

    def _with_wheels(self) -> Iterator[tuple[Decoded[Returns | StampedPose], Pose | None]]:
        """Lidar messages with the wheel pose at their stamp; they wait a little for the reading behind them."""
        track = WheelTrack()
        waiting: deque[Decoded[Returns | StampedPose]] = deque()
        for message in self._messages():
            if message.channel.topic == self.topic:
                waiting.append(message)
            elif isinstance(message.value, StampedPose):
                if message.channel.topic == self.config.ground_truth_topic:
                    self.truth.append(message.value)
                else:
                    pose = message.value.T_parent_child
                    track.add(message.value.stamp_ns, lie.flatten(pose) if self.dimension == 2 else pose)
            while waiting and self._settled(waiting, message, track):
                yield waiting[0], self._wheels_at(track, waiting.popleft())
        while waiting:
            yield waiting[0], self._wheels_at(track, waiting.popleft())

    def _settled(
        self, waiting: deque[Decoded[Returns | StampedPose]], latest: Decoded[Returns | StampedPose], track: WheelTrack
    ) -> bool:
        first = waiting[0].value
        if not self.has_odometry or not isinstance(first, Returns) or len(waiting) > _HOLD_SCANS:
            return True
        return track.covers(first.stamp_ns) or latest.log_time_ns - waiting[0].log_time_ns > _HOLD_NS

    @staticmethod
    def _wheels_at(track: WheelTrack, message: Decoded[Returns | StampedPose]) -> Pose | None:
        return track.at(message.value.stamp_ns) if isinstance(message.value, Returns) else None

    def _messages(self) -> Iterator[Decoded[Returns | StampedPose]]:
        begin_ns = self.start_ns + round(self.config.start_s * 1e9)
        end_ns = self.start_ns + round(min(self.config.end_s, 1e9) * 1e9)
        blocks = [block for block in self.blocks if block.end_ns >= begin_ns and block.start_ns <= end_ns]
        limits = RangeLimits(self.config.min_range_m, self.config.max_range_m)
        decoder = LaserScanDecoder(limits) if self.dimension == 2 else PointCloudDecoder(limits)
        poses = {self.config.ground_truth_topic}
        if self.odometry is not None:
            poses.add(self.odometry.topic)

        def decode(message: Message) -> Returns | StampedPose | None:
            if not begin_ns <= message.log_time_ns <= end_ns:
                return None
            if message.channel.topic == self.topic:
                return decoder.decode(message.data)
            if message.channel.topic in poses and kind(message.channel) == ODOMETRY:
                return decode_odometry(message.data)
            return None

        return decoded_messages(
            self.indexes, blocks, decode, ahead=self.config.prefetch_chunks, damage=self.damage
        )

    def _checked(self, message: Decoded[Returns | StampedPose], number: int) -> Returns:
        path = self.indexes[message.channel.key[0]].path
        if isinstance(message.value, MalformedMessageError):
            raise InputError(f"{path}: scan {number} of {self.topic} is malformed: {message.value}; record it again")
        assert isinstance(message.value, Returns)
        if not len(message.value.points):
            raise InputError(
                f"{path}: scan {number} of {self.topic} has no valid point ({message.value.why}); "
                "skip it with --start/--end, or widen log.min_range_m and log.max_range_m"
            )
        return message.value

    def _mounting(self) -> Pose:
        """T_base_lidar (4, 4), from the first blocks, which hold the latched static transforms."""
        transforms: list[StampedPose] = []
        base, lidar = "", ""
        ordered = sorted(self.blocks, key=lambda block: block.start_ns)
        for message in islice(_peek(self.indexes, ordered[:_PEEK_BLOCKS]), 100_000):
            topic = message.channel.topic
            try:
                if kind(message.channel) == TRANSFORMS and topic.endswith("tf_static"):
                    transforms += decode_transforms(message.data)
                elif self.odometry is not None and topic == self.odometry.topic and not base:
                    base = decode_odometry(message.data).child
                elif topic == self.topic and not lidar:
                    lidar = _frame(message)
            except MalformedMessageError:
                continue
            if transforms and lidar and (base or self.odometry is None):
                break
        if not transforms and not self.has_odometry:
            return np.eye(4)
        return mounting(transforms, base, lidar, self.notes)


def _peek(indexes: Sequence[FileIndex], blocks: Sequence[Block]) -> Iterator[Message]:
    for block in blocks:
        try:
            yield from read_block(indexes[block.file], block)
        except DamagedBlockError:
            continue


def _frame(message: Message) -> str:
    return CdrReader(message.data).header()[1]


def _learn_channels(index: FileIndex) -> None:
    """Count the messages of a file without summary, meeting the channels inside its chunks on the way."""
    index.counts.clear()
    for block in index.blocks:
        try:
            for message in read_block(index, block):
                number = message.channel.key[1]
                index.counts[number] = index.counts.get(number, 0) + 1
        except DamagedBlockError:
            continue
