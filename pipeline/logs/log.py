"""A log: files or folders of any format that is known, read as a stream of scans."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator, Sequence

import numpy as np

from pipeline.clock import working_s
from pipeline.config import LogConfig
from pipeline.data import Pose, Scan, Trajectory
from pipeline.errors import InputError
from pipeline.logs.first_messages import first_messages
from pipeline.logs.laser_scan import LaserScanDecoder
from pipeline.logs.limits import RangeLimits, Returns
from pipeline.logs.mounting import find_mounting, in_plane, is_upside_down
from pipeline.logs.opening import index_files
from pipeline.logs.point_cloud import PointCloudDecoder
from pipeline.logs.point_times import PointTimes
from pipeline.logs.readers import cloud_reader, is_scan, pose_reader, scan_reader
from pipeline.logs.records import FileIndex
from pipeline.logs.selection import chosen_span, count_scans, whole_span
from pipeline.logs.stream import Decoded, Decoders, decoded_messages
from pipeline.logs.tally import Tally, most_bad_scans
from pipeline.logs.told_poses import ToldPoses
from pipeline.logs.topics import find_ground_truth, find_lidar, find_odometry
from pipeline.logs.wheels import WheelTrack
from pipeline.source import Source, source_of
from pipeline.words import counted

_DEFAULTS = LogConfig()
_HOLD_NS = 500_000_000  # log time that a scan waits for the wheel reading behind it
_HOLD_SCANS = 32


def open_log(sources: Source | str | Sequence[Source | str], config: LogConfig = _DEFAULTS) -> Log:
    """A file, folder or address, or several as one log, topics chosen. Raises InputError for what is no log."""
    named = [sources] if isinstance(sources, Source | str) else sources
    return Log(index_files([source_of(each) for each in named], config.rate_hz), config)


class Log:
    """An opened log; ``scans`` can be iterated any number of times.

    Attributes
    ----------
    paths : its files
    topic, dimension : the lidar's topic; 2 for laser scans, 3 for clouds
    T_base_lidar : (d+1, d+1) mounting from /tf_static, the identity where the log does not say
    scan_count : scans to expect after start, end and every, by the index
    duration_s : from the first message to the last
    odometry_topic : whose poses the scans carry, empty where there is none
    notes : what was chosen or assumed
    damage : what could not be read; complete once ``scans`` is through
    """

    def __init__(self, indexes: Sequence[FileIndex], config: LogConfig) -> None:
        self.config = config
        self.indexes = indexes
        self.paths = tuple(index.path for index in indexes)
        self.notes: list[str] = [line for index in indexes for line in index.notes]
        lidar = find_lidar(indexes, config.topic)
        wheels = find_odometry(indexes, config.odometry_topic, config.ground_truth_topic, self.notes)
        truth = find_ground_truth(indexes, config.ground_truth_topic, _DEFAULTS.ground_truth_topic)
        self.topic = lidar.topic
        self.odometry_topic = "" if wheels is None else wheels.topic
        self.ground_truth_topic = "" if truth is None else truth.topic
        self.lidar = lidar
        self.dimension = 2 if is_scan(lidar) else 3
        whole = whole_span(indexes)
        self.duration_s = whole.duration_s
        self.span = chosen_span(whole, config)
        self.scan_count = count_scans(indexes, self.topic, whole, config)
        T_base_lidar = find_mounting(indexes, lidar, wheels, self.notes)
        self.is_mirrored = self.dimension == 2 and is_upside_down(T_base_lidar)
        self.T_base_lidar: Pose = in_plane(T_base_lidar) if self.dimension == 2 else T_base_lidar
        self.damage: list[str] = [line for index in indexes for line in index.damage]
        self.pose_decoders: Decoders = {
            channel.topic: pose_reader(channel, self.dimension)
            for channel in (wheels, truth)
            if channel is not None
        }
        self._opening_notes = tuple(self.notes)
        self._truth: Trajectory | None = None

    @property
    def has_odometry(self) -> bool:
        """Whether scans carry the wheels' pose."""
        return self.odometry_topic != ""

    def scans(self) -> Iterator[Scan]:
        """Scans in the order of log time, each with the wheels' pose at its stamp.

        A scan that is malformed or has no valid point at all is counted in ``damage`` and left out, like damaged
        chunks. Raises InputError when there are more of them than ``log.max_bad_scans_percent`` allows.
        """
        self.damage = [line for index in self.indexes for line in index.damage]
        self.notes = list(self._opening_notes)
        poses, tally = (
            ToldPoses(self.odometry_topic, self.ground_truth_topic),
            Tally(self.topic, self.odometry_topic),
        )
        times = PointTimes(self.config)
        count, index, asked = 0, 0, working_s()
        for message, T_odom_base in self._with_wheels(poses, times):
            count += 1
            if (count - 1) % self.config.every:
                continue
            complaint = self._complaint(message, count - 1)
            if complaint:
                tally.skip(complaint)
                self._check_bad(tally.bad, complaint)
                continue
            scan = self._scan(index, message, T_odom_base, waited_s=working_s() - asked)
            tally.take(scan)
            yield scan
            index += 1
            asked = working_s()
        self._truth = poses.ground_truth()
        self.damage += [*tally.losses(), *poses.complaints()]
        self.notes += [*([times.assumed] if self.dimension == 3 else []), *tally.notes()]
        if not index:
            raise InputError(f"{self.paths[0]}: no scan of {self.topic} could be read: {'; '.join(self.damage)}")
        if self.damage:
            scans = counted(count - tally.bad, "scan")
            self.damage.append(f"{scans} of {self.topic} {'was' if scans == '1 scan' else 'were'} recovered")

    def _scan(self, index: int, message: Decoded, T_odom_base: Pose | None, *, waited_s: float) -> Scan:
        returns = message.value
        assert isinstance(returns, Returns)
        return Scan(
            index=index,
            stamp_ns=returns.stamp_ns,
            log_time_ns=message.log_time_ns,
            points=returns.points * np.array([1.0, -1.0], np.float32) if self.is_mirrored else returns.points,
            times_s=returns.times_s,
            dropped=returns.dropped,
            T_odom_base=T_odom_base,
            waited_s=waited_s,
        )

    def assumed_point_times(self) -> str:
        """What a run assumes about per-point times, by the first scan that has returns; empty for a planar log."""
        times = PointTimes(self.config)
        if self.dimension == 3:
            returns = first_messages(self.indexes, self.topic, self.decoder(times).decode)
            next((each for each in returns if len(each.points)), None)
        return times.assumed if self.dimension == 3 else ""

    def ground_truth(self) -> Trajectory | None:
        """Poses of ``log.ground_truth_topic``, None where there are none; read by itself if before ``scans``."""
        if self._truth is None and self.ground_truth_topic:
            poses = ToldPoses("", self.ground_truth_topic)
            decoder = self.pose_decoders[self.ground_truth_topic]
            for message in self._messages({self.ground_truth_topic: decoder}, []):
                poses.take(message)
            self._truth = poses.ground_truth()
        return self._truth

    def _with_wheels(self, poses: ToldPoses, times: PointTimes) -> Iterator[tuple[Decoded, Pose | None]]:
        """Lidar messages with the wheels' pose at their stamp; they wait a little for the reading behind them."""
        decoders = {self.topic: self.decoder(times).decode, **self.pose_decoders}
        waiting: deque[Decoded] = deque()
        for message in self._messages(decoders, self.damage):
            if message.channel.topic == self.topic:
                waiting.append(message)
            else:
                poses.take(message)
            while waiting and self._may_go(waiting, message.log_time_ns, poses.wheels):
                yield waiting[0], poses.wheels_at(waiting.popleft())
        while waiting:
            yield waiting[0], poses.wheels_at(waiting.popleft())

    def decoder(self, times: PointTimes) -> LaserScanDecoder | PointCloudDecoder:
        """What makes points of the lidar's messages; ``times`` learns what it assumes about theirs."""
        limits = RangeLimits(self.config.min_range_m, self.config.max_range_m)
        if self.dimension == 2:
            return LaserScanDecoder(limits, scan_reader(self.lidar))
        return PointCloudDecoder(limits, times, cloud_reader(self.lidar))

    def _may_go(self, waiting: deque[Decoded], now_ns: int, wheels: WheelTrack) -> bool:
        first = waiting[0].value
        if not self.odometry_topic or not isinstance(first, Returns) or len(waiting) > _HOLD_SCANS:
            return True
        return wheels.covers(first.stamp_ns) or now_ns - waiting[0].log_time_ns > _HOLD_NS

    def _messages(self, decoders: Decoders, damage: list[str]) -> Iterator[Decoded]:
        ahead = self.config.prefetch_chunks
        return decoded_messages(self.indexes, decoders, self.span, ahead=ahead, damage=damage)

    def _check_bad(self, bad: int, complaint: str) -> None:
        """Refuse more bad scans than are allowed."""
        if bad > most_bad_scans(self.scan_count, self.config):
            raise InputError(
                f"{complaint}; with it {bad} of {counted(self.scan_count, 'scan')} cannot be used, more than "
                f"log.max_bad_scans_percent ({self.config.max_bad_scans_percent:g}) allows; raise it, or choose "
                "another --topic"
            )

    def _complaint(self, message: Decoded, number: int) -> str:
        """What is wrong with a scan, empty where it is good."""
        if isinstance(message.value, Returns) and len(message.value.points):
            return ""
        where = f"{self.indexes[message.channel.key[0]].path}: scan {number} of {self.topic}"
        if isinstance(message.value, Returns):
            return f"{where} has no valid point ({message.value.why})"
        return f"{where} is malformed: {message.value}"
