"""Samples of the sensors next to the lidar: a stream of the latest ones of each, and the whole ground truth."""

from __future__ import annotations

from bisect import bisect_left, bisect_right, insort
from collections.abc import Callable
from typing import Any, Generic, Protocol, Self, TypeVar

import numpy as np

from scanchain import lie
from scanchain.data import Fixes, Inertial, Pose, Trajectory
from scanchain.errors import counted, duration
from scanchain.logs.index import Decoded
from scanchain.logs.messages.gnss import Fix
from scanchain.logs.messages.inertial import ImuSample
from scanchain.logs.messages.point_times import Returns
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.messages.ros import MalformedMessageError
from scanchain.logs.mounting import Sensor, place_text

NEAREST_NS = 500_000_000  # longest time from a stamp to its sample, and, with its delay added, that a scan waits
# times from a scan to the sample of an IMU before it, and to a fix, above which they are of another clock
_LONG_BEFORE_NS, _FAR_NS = 2 * NEAREST_NS, 20 * NEAREST_NS
HOLD_SCANS = 32  # largest number of scans that wait for samples, or for points of other lidars; limits memory


class Sample(Protocol):
    """Measurement of a sensor at a stamp."""

    @property
    def stamp_ns(self) -> int: ...  # noqa: D102


class Interpolable(Sample, Protocol):
    """Measurement that can be interpolated."""

    def interpolate(self, later: Self, stamp_ns: int) -> Self:
        """The sample at a stamp between this one and a later one."""
        ...


S = TypeVar("S", bound=Sample)
V = TypeVar("V", bound=Interpolable)


class SampleStream(Generic[S]):
    """The latest samples of one sensor, sorted by stamp."""

    def __init__(self) -> None:
        self._stamps_ns: list[int] = []
        self._samples: dict[int, S] = {}
        self._added_ns = 0  # stamp of the sample added last

    def add(self, sample: S) -> None:
        """Add a sample; it replaces one of the same stamp. All earlier ones go if the clock jumped back."""
        if self._stamps_ns and sample.stamp_ns < self._added_ns - NEAREST_NS:
            self._stamps_ns, self._samples = [], {}
        self._added_ns = sample.stamp_ns
        if sample.stamp_ns not in self._samples:
            insort(self._stamps_ns, sample.stamp_ns)
        self._samples[sample.stamp_ns] = sample
        if len(self._stamps_ns) > 4096:  # 2 s and more at 2000 Hz
            del self._samples[self._stamps_ns.pop(0)]

    def covers(self, stamp_ns: int) -> bool:
        """True if there is a sample at or after a stamp."""
        return bool(self._stamps_ns) and self._stamps_ns[-1] >= stamp_ns

    def between(self, begin_ns: int, end_ns: int) -> list[S]:
        """Samples from one stamp to another, both included."""
        begin, end = bisect_left(self._stamps_ns, begin_ns), bisect_right(self._stamps_ns, end_ns)
        return [self._samples[stamp_ns] for stamp_ns in self._stamps_ns[begin:end]]

    def at(self: SampleStream[V], stamp_ns: int) -> V | None:
        """The sample at a stamp, interpolated between its neighbors or the nearest; None beyond half a second."""
        if stamp_ns in self._samples:
            return self._samples[stamp_ns]
        after = bisect_left(self._stamps_ns, stamp_ns)
        neighbors = [self._samples[each] for each in self._stamps_ns[max(after - 1, 0) : after + 1]]
        near = [each for each in neighbors if abs(each.stamp_ns - stamp_ns) <= NEAREST_NS]
        if len(near) == 2:
            return near[0].interpolate(near[1], stamp_ns)
        return near[0] if near else None


class ScaledOdometry:
    """Wheel odometry whose motions from scan to scan are divided by the scales of distances and of turns."""

    def __init__(self, scale: float, turn_scale: float) -> None:
        self.scale, self.turn_scale = scale, turn_scale
        self.last: tuple[Pose, Pose] | None = None  # as read, and corrected

    def corrected(self, T_odom_base: Pose) -> Pose:
        """The pose at the next scan."""
        if self.scale == self.turn_scale == 1.0:
            return T_odom_base
        T = T_odom_base
        if self.last is not None:
            by_component = lie.by_component(lie.twist_size(T), self.scale, self.turn_scale)
            T = self.last[1] @ lie.exp(lie.log(lie.between(self.last[0], T_odom_base)) / by_component)
        self.last = T_odom_base, T
        return T


class Recorded:
    """Messages of the sensors next to the lidar, sorted by topic; malformed ones are counted.

    streams : those that a scan waits for, by topic
    truth : poses of the ground truth in the order of the log
    """

    def __init__(
        self,
        odometry_topic: str,
        ground_truth_topic: str,
        imu: Sensor | None = None,
        gnss: Sensor | None = None,
        *,
        is_mirrored: bool = False,
        delays_s: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        """is_mirrored : whether a planar lidar hangs upside down; its frame is then as seen from above.

        delays_s : how late the stamps of wheel odometry and IMU are
        """
        topics = odometry_topic, "" if imu is None else imu.topic
        self._delays_ns = {topic: round(1e9 * delay_s) for topic, delay_s in zip(topics, delays_s, strict=True)}
        self.patience_ns = NEAREST_NS + max(0, round(1e9 * delays_s[0]))  # longest time that a scan waits
        self.odometry, self.imu = SampleStream[StampedPose](), SampleStream[ImuSample]()
        upright = np.diag([1.0, -1.0, -1.0, 1.0]) if is_mirrored else np.eye(4)
        stated = (None if each is None else each.T_lidar_sensor for each in (imu, gnss))
        self.T_lidar_imu, T_lidar_gnss = (None if T is None else upright @ T for T in stated)
        self.antenna_m = None if T_lidar_gnss is None else T_lidar_gnss[:3, 3]
        self._fixes = list[Fix]()  # those since the last scan
        self._fixed_ns, self._far = 0, 0  # end of the last scan, and number of fixes that are far from it
        self._given_ns, self._has_imu = 0, imu is not None  # stamp of the last sample that a scan has
        named = {odometry_topic: self.odometry, "" if imu is None else imu.topic: self.imu}
        self.streams: dict[str, SampleStream[Any]] = {topic: stream for topic, stream in named.items() if topic}
        self.odometry_topic, self.ground_truth_topic = odometry_topic, ground_truth_topic
        self.truth: list[StampedPose] = []
        self._frames: dict[str, Pose | None] = {}  # of the truth, with the lidar's pose in each if it is known
        self._malformed: dict[str, list[str]] = {}  # by topic, the defect of each message
        self._odometry_ns: int | None = None  # stamp of the latest sample of the wheels minus its log time
        self._late_ns = list[int]()  # that minus the same of each scan, 0 of one with wheels

    def add(self, message: Decoded) -> None:
        """Add the samples of a message to the stream of its topic."""
        topic = message.channel.topic
        for sample in message.value if isinstance(message.value, list) else [message.value]:
            if isinstance(sample, MalformedMessageError):
                self._malformed.setdefault(topic, []).append(str(sample))
                continue
            if topic == self.ground_truth_topic:
                self.truth.append(sample)
            if topic in self.streams:
                if delay_ns := self._delays_ns[topic]:
                    sample = sample._replace(stamp_ns=sample.stamp_ns - delay_ns)
                self.streams[topic].add(sample)
                if topic == self.odometry_topic:
                    self._odometry_ns = sample.stamp_ns - message.log_time_ns
            if isinstance(sample, Fix):
                self._fixes.append(sample)

    def covers(self, returns: Returns) -> bool:
        """True if every stream has a sample at or after the stamp of a scan, that of the IMU after its end."""
        return all(
            stream.covers(returns.end_ns if stream is self.imu else returns.stamp_ns)
            for stream in self.streams.values()
        )

    def wheels(self, stamp_ns: int, log_time_ns: int) -> StampedPose | None:
        """The wheel reading at a stamp; if stamps are late, None without a later one, since the last one lags."""
        is_late = self.patience_ns > NEAREST_NS
        found = None if is_late and not self.odometry.covers(stamp_ns) else self.odometry.at(stamp_ns)
        if self._odometry_ns is not None:
            self._late_ns.append(0 if found else self._odometry_ns - (stamp_ns - log_time_ns))
        return found

    def wheels_late_s(self) -> float:
        """Median delay in s of the stamps of the wheels by log times, where they are of another clock; else 0."""
        late_ns = np.array(self._late_ns or [0], np.float64)
        is_apart = np.ptp(late_ns) < NEAREST_NS < np.abs(late_ns).min()
        return 1e-9 * float(np.median(late_ns)) if is_apart else 0.0

    def inertial(self, returns: Returns) -> Inertial | None:
        """Samples of the IMU since those of the scan before, to the first after this one.

        None without any, and if all are long before, as of another clock.
        """
        if returns.end_ns < self._given_ns - NEAREST_NS:  # the clock jumped back
            self._given_ns = 0
        after = self.imu.between(max(self._given_ns, returns.end_ns) + 1, returns.end_ns + NEAREST_NS)[:1]
        found = self.imu.between(self._given_ns + 1, returns.end_ns) + after
        if not found or found[-1].stamp_ns < returns.end_ns - _LONG_BEFORE_NS:
            return None
        self._given_ns = found[-1].stamp_ns
        stamps_ns = np.array([each.stamp_ns for each in found], np.int64)
        rates, accelerations = np.array([(each.rates, each.accelerations) for each in found]).swapaxes(0, 1)
        return Inertial(stamps_ns, rates, accelerations, self.T_lidar_imu)

    def fixes(self, returns: Returns) -> Fixes | None:
        """The fixes of the GNSS receiver since the scan before; None without any.

        Those far from both scans, as of another clock, are counted.
        """
        first_ns, last_ns = sorted((self._fixed_ns or returns.end_ns, returns.end_ns))
        found = [each for each in self._fixes if first_ns - _FAR_NS <= each.stamp_ns <= last_ns + _FAR_NS]
        self._far += len(self._fixes) - len(found)
        self._fixes, self._fixed_ns = [], returns.end_ns
        if not found:
            return None
        stamps_ns, _, positions, covariances = zip(*found, strict=True)
        return Fixes(np.array(stamps_ns, np.int64), np.array(positions), np.array(covariances), self.antenna_m)

    def ground_truth(self, lidar_on: Callable[[str], Pose | None]) -> Trajectory | None:
        """True poses of the lidar so far; None if there are none.

        lidar_on : pose of the lidar in a frame, None if it is unknown: poses of that frame count as the lidar's
        """
        if not self.truth:
            return None
        stamps_ns = np.array([pose.stamp_ns for pose in self.truth], np.int64)
        self._frames = {child: lidar_on(child) for child in {pose.child for pose in self.truth}}
        poses = [(pose.T_parent_child, self._frames[pose.child]) for pose in self.truth]
        return Trajectory(stamps_ns, np.array([T if T_child is None else T @ T_child for T, T_child in poses]))

    def notes(self) -> list[str]:
        """Notes on a ground truth of other frames than the lidar's, and on sensors of another clock."""
        used = "taken as the lidar's, as no transform states where it is on"
        done = {
            child: f"{used} {child}" if T is None else f"moved to the lidar, at {place_text(T)}"
            for child, T in self._frames.items()
            if T is None or not np.array_equal(T, np.eye(len(T)))
        }
        notes = [f"{self.ground_truth_topic}: poses of {child}, {how}" for child, how in done.items()]
        if late_s := self.wheels_late_s():
            apart = f"{duration(abs(late_s))} {'after' if late_s > 0.0 else 'before'} those of the scans"
            flag = f"--log.odometry_delay_s {1e-9 * self._delays_ns[self.odometry_topic] + late_s:.2f}"
            notes.append(f"stamps of {self.odometry_topic} are {apart}, as of another clock: {flag}")
        if self._has_imu and not self._given_ns:
            notes.append("no sample of the IMU is of the time of a scan, as of another clock: it is not used")
        if self._far:
            far = f"{counted(self._far, 'fix', 'fixes')} of the GNSS receiver left out"
            notes.append(f"{far}: more than {1e-9 * _FAR_NS:g} s from the scans, as of another clock")
        return notes

    def losses(self) -> list[str]:
        """Warning for each topic with malformed messages."""
        return [
            f"{counted(len(reasons), 'malformed message')} of {topic} left out (the first: {reasons[0]})"
            for topic, reasons in self._malformed.items()
        ]
