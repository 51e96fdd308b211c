"""Several lidars in one run: the points of the others, moved to the first one's frame and added to its scans."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator, Sequence
from copy import copy
from functools import cache, partial
from itertools import chain

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from scanchain.config import LogConfig
from scanchain.data import GAP_INTERVALS, OtherPoints, Pose
from scanchain.errors import InputError, counted, duration
from scanchain.logs.index import Channel, Decoded, FileIndex, name_of
from scanchain.logs.messages.lidar import Returns, decode_cloud, decode_laser_scan, plane_height_m, with_offsets
from scanchain.logs.messages.point_times import UNITS_S, PointTimes
from scanchain.logs.messages.readers import is_scan, reader
from scanchain.logs.mounting import place_text, stated_poses
from scanchain.logs.publishers import Publishers, in_first_frame
from scanchain.logs.samples import HOLD_SCANS, NEAREST_NS
from scanchain.logs.stream import sampled_messages

_TOGETHER_NS = 125_000_000  # longest time between a point and the middle of the scan it is added to
_WAITING_NS = 2_000_000_000  # longest time between points that wait: the first lidar is missing, or a clock jumped


def decoder(channel: Channel, times: PointTimes, plane_m: float | None) -> Callable[[memoryview], Returns]:
    """Decoder of a lidar's messages to points; ``plane_m`` is the height of the plane of planar clouds."""
    decode = partial(decode_cloud, read=reader(channel), times=times, plane_m=plane_m)
    if is_scan(channel):
        decode = partial(decode_laser_scan, read=reader(channel), config=times.config)
    offsets = times.config.elevation_offset_rad, times.config.range_offset_m
    return partial(_corrected, decode=decode, offsets=offsets) if any(offsets) else decode


def _corrected(
    data: memoryview, *, decode: Callable[[memoryview], Returns], offsets: tuple[float, float]
) -> Returns:
    returns = decode(data)
    points = with_offsets(returns.points.astype(np.float64), *offsets).astype(np.float32)
    return returns._replace(points=points)


class OtherLidar:
    """A lidar whose points are added to the scans of the first one.

    T_first_other : its pose in the frame of the first one
    waiting, end_ns : points that wait for their scan, with their times (N,), and the time of the last one
    scans : log time of each scan of the first lidar, and whether it has points of this one
    faults : defects of the messages that are left out
    """

    def __init__(
        self,
        indexes: Sequence[FileIndex],
        lidar: Channel,
        config: LogConfig,
        first: Publishers,
        notes: list[str],
        T_stated: Pose | None,
    ) -> None:
        """Add its pose to ``notes``: ``T_stated``, or by the transforms.

        Raises InputError if its points cannot be moved to the frame of the first.
        """
        unit = config.point_times if config.point_times in (*UNITS_S, "none") else "auto"  # not by azimuth
        own = {"point_times": unit, "every": 1, "elevation_offset_rad": 0.0, "range_offset_m": 0.0}
        self.channel, self.config = lidar, replace(config, **own)
        decode = decoder(lidar, PointTimes(self.config), None)
        sampled = list(sampled_messages(indexes, lidar.topic, decode, most=16))
        self.plane_m = None if is_scan(lidar) else plane_height_m(each.value for each in sampled)
        offsets_ns = [each.value.stamp_ns - each.log_time_ns for each in sampled]
        of_first_ns = [offset_ns for _, offset_ns in first.offsets_ns]
        away_ns = float(np.median(offsets_ns) - np.median(of_first_ns)) if sampled and of_first_ns else 0.0
        self.pose = cache(partial(first.joined, away_ns=away_ns, T_stated=T_stated))  # by frame
        T, why = self.pose(sampled[0].value.frame) if sampled else (None, "no message of it can be understood")
        if sampled and (is_scan(lidar) or self.plane_m is not None) != first.is_planar:
            why = "one is planar, the other is not"
        if why or T is None:
            topic = config.topic.partition(",")[0]
            why = f"cannot be combined with {topic}: {why}; use one of them, as --topic {topic}"
            raise InputError(f"{name_of(indexes)}: {lidar.topic} {why}")
        self.T_first_other = T
        notes.append(f"{lidar.topic} is used too, moved to frame {first.frame}: it is at {place_text(T)}")
        self.begin()

    def begin(self) -> None:
        """Reset what was read."""
        self.times = PointTimes(self.config)
        self.waiting, self.end_ns = deque[tuple[NDArray[np.int64], OtherPoints]](), 0
        self.scans, self.faults = list[tuple[int, bool]](), list[str]()

    def add(self, message: Decoded, *, is_mirrored: bool) -> None:
        """Add a message, or its defect."""
        returns = message.value
        T, why = self.pose(returns.frame) if isinstance(returns, Returns) else (None, str(returns))
        if why or not len(returns.points):
            self.faults.append(why or f"no valid point: {returns.why}")
            return
        seen = in_first_frame(returns, T, is_mirrored=is_mirrored)
        times_s = seen.times_s if len(seen.times_s) else np.zeros(len(seen.points))
        times_ns = returns.stamp_ns + (1e9 * times_s.astype(np.float64)).astype(np.int64)
        self.waiting.append((times_ns, seen._replace(moves_middle=False)))
        self.end_ns = int(times_ns.max())
        while abs(self.end_ns - int(self.waiting[0][0][0])) > _WAITING_NS:
            self.waiting.popleft()

    def nearest_to(self, scan: Decoded, middle_ns: int, next_ns: int) -> list[OtherPoints]:
        """The points that are nearer in time to the middle of a scan than to that of the next one."""
        until_ns = middle_ns + min(max((next_ns - middle_ns) // 2, 0) or _TOGETHER_NS, _TOGETHER_NS)
        near, waiting, self.waiting = list[OtherPoints](), self.waiting, deque()
        for times_ns, seen in waiting:
            is_later = times_ns > until_ns
            is_near = ~is_later & (times_ns >= middle_ns - _TOGETHER_NS)
            if is_near.any():
                times_s = (1e-9 * (times_ns[is_near] - scan.value.stamp_ns)).astype(np.float32)
                near.append(seen._replace(points=seen.points[is_near], times_s=times_s))
            if is_later.any():
                self.waiting.append((times_ns[is_later], seen._replace(points=seen.points[is_later])))
        self.scans.append((scan.log_time_ns, len(near) > 0))
        return near

    def absence(self, first: str) -> str:
        """Number of scans of the ``first`` topic during absences of the lidar, as text; empty if none."""
        times_ns = np.array([time_ns for time_ns, _ in self.scans])
        found = np.flatnonzero([has_points for _, has_points in self.scans])
        usual_ns = float(np.median(np.diff(times_ns[found]))) if len(found) > 1 else -1.0
        ends = np.array([-1, *found, len(self.scans)])
        begins_s, ends_s = 1e-9 * (times_ns - times_ns[0])[np.clip([ends[:-1], ends[1:]], 0, len(times_ns) - 1)]
        is_absent = ends_s - begins_s > GAP_INTERVALS * 1e-9 * usual_ns
        missed, k = int((np.diff(ends) - 1)[is_absent].sum()), int(np.argmax(ends_s - begins_s))
        lasted, after = duration(ends_s[k] - begins_s[k]), duration(begins_s[k])
        when = f"missing for up to {lasted}, {after} after the first scan"
        when = when if len(found) else f"not used: no point is within {1e-9 * _TOGETHER_NS:g} s of a scan"
        scans = f"{missed} of {counted(len(times_ns), 'scan')} of {first} without {self.channel.topic}"
        return f"{scans}, which is {when}" if missed else ""


def other_lidars(
    indexes: Sequence[FileIndex],
    channels: Sequence[Channel],
    config: LogConfig,
    first: Publishers,
    notes: list[str],
) -> list[OtherLidar]:
    """The lidars of these channels, at the poses of the configuration or the transforms."""
    stated = stated_poses(config.other_lidar_poses, "log.other_lidar_poses") or [None] * len(channels)
    if len(stated) != len(channels):
        wanted = f"as many as topics after the first of log.topic, {len(channels)}"
        raise InputError(f"log.other_lidar_poses has {counted(len(stated), 'pose')}; wanted {wanted}")
    return [OtherLidar(indexes, each, config, first, notes, T) for each, T in zip(channels, stated, strict=True)]


class Together:
    """The scans of the first lidar, of this topic, with the points of the others, while a log is read."""

    def __init__(
        self, topic: str, others: Sequence[OtherLidar], publishers: Publishers, *, is_mirrored: bool
    ) -> None:
        self.topic, self.publishers, self.is_mirrored = topic, publishers, is_mirrored
        self.others = {each.channel.topic: copy(each) for each in others}
        self.decoders = dict[str, Callable[[memoryview], Returns]]()
        for name, each in self.others.items():
            each.begin()
            self.decoders[name] = decoder(each.channel, each.times, each.plane_m)

    def joined(self, messages: Iterator[Decoded]) -> Iterator[Decoded]:
        """Messages in their order without those of the other lidars, whose points are added to the scans.

        Each point is added to the scan whose middle is nearest in time, once: so all points of a scan are of one
        interval, which its constant twist covers, whatever the rates and phases of the lidars. A scan is held
        back until the next one is known and the points of the others until then, for half a second at most.
        """
        if not self.others:
            yield from messages
            return
        for topic, each in self.others.items():
            messages = each.times.checked(messages, topic, most_ns=NEAREST_NS)
        waiting, middles_ns = deque[Decoded](), deque[int]()
        for message in chain(messages, [None]):
            if message is not None and message.channel.topic in self.others:
                self.others[message.channel.topic].add(message, is_mirrored=self.is_mirrored)
            elif message is not None:
                waiting.append(message)
                middles_ns += [message.value.middle_ns] if self._is_scan(message) else []
            while waiting:
                first = waiting[0]
                if self._is_scan(first):
                    is_late = message is None or message.log_time_ns - first.log_time_ns > NEAREST_NS
                    if not (is_late or len(middles_ns) > HOLD_SCANS or self._are_complete(middles_ns)):
                        break
                    middle_ns = middles_ns.popleft()
                    next_ns = middles_ns[0] if middles_ns else middle_ns
                    near = [each.nearest_to(first, middle_ns, next_ns) for each in self.others.values()]
                    first = first._replace(value=first.value._replace(others=tuple(chain(*near))))
                waiting.popleft()
                yield first

    def absences(self) -> list[str]:
        """Notes on lidars that are missing for a while."""
        return [line for each in self.others.values() if each.scans and (line := each.absence(self.topic))]

    def notes(self) -> list[str]:
        """Notes on point times and absences."""
        times = ((topic, [each.times.assumed, *each.times.faults(topic)]) for topic, each in self.others.items())
        return [f"{topic}: {line}" for topic, lines in times for line in lines if line] + self.absences()

    def losses(self) -> list[str]:
        """Warnings about messages that are left out, and about implausible point times."""
        lines = list[str]()
        for topic, each in self.others.items():
            many = counted(len(each.faults), "message")
            lines += [f"{many} of {topic} left out (the first: {each.faults[0]})"] if each.faults else []
            lines += each.times.warnings(topic)
        return lines

    def _is_scan(self, message: Decoded) -> bool:
        returns = message.value
        is_own = message.channel.topic == self.topic and isinstance(returns, Returns)
        return is_own and len(returns.points) > 0 and self.publishers.of(returns.frame).is_used

    def _are_complete(self, middles_ns: Sequence[int]) -> bool:
        """True if no later point can be nearest to the first of the scans that wait."""
        if len(middles_ns) < 2:
            return False
        until_ns = max(middles_ns[0], (middles_ns[0] + middles_ns[1]) // 2)
        return all(each.end_ns >= until_ns for each in self.others.values())
