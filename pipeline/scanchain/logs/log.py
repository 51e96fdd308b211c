"""A log: files or folders of any supported format, read as a stream of scans."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import closing, suppress
from copy import copy
from functools import partial
from itertools import chain, islice, tee

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from scanchain import checks
from scanchain.clock import working_s
from scanchain.config import LogConfig, PreprocessConfig
from scanchain.data import OtherPoints, Pose, Scan, Trajectory
from scanchain.errors import InputError, counted, grouped, shown
from scanchain.files import Source, source_of
from scanchain.logs import stream
from scanchain.logs.bad_scans import ScanCounts, defect
from scanchain.logs.index import Channel, Decoded, FileIndex, name_of
from scanchain.logs.messages.lidar import Returns, plane_height_m
from scanchain.logs.messages.point_times import UNTIMED, PointTimes
from scanchain.logs.messages.poses import StampedPose
from scanchain.logs.messages.readers import Read, is_scan, pose_reader
from scanchain.logs.mounting import (
    Wheels,
    between_frames,
    find_mounting,
    find_sensors,
    find_wheels,
    in_plane,
    is_upside_down,
)
from scanchain.logs.opening import DEFAULTS, index_files
from scanchain.logs.other_lidars import Together, decoder, other_lidars
from scanchain.logs.publishers import Publishers, seen_together, with_jumps
from scanchain.logs.samples import HOLD_SCANS, Recorded, ScaledOdometry
from scanchain.logs.sectors import MOST, Assembler, expected_sweeps, find_sectors
from scanchain.logs.topics import find_ground_truth, find_lidars
from scanchain.settings import load_settings, overrides_of


def open_log(
    sources: Source | str | Sequence[Source | str], config: LogConfig = DEFAULTS, **changes: object
) -> Log:
    """Log of one file, folder or address, or of several, opened and its topics chosen.

    changes : keys of ``[log]`` on top of ``config``, such as topic="/lidar_front/points" or end_s=60.0;
        topic=("/front", "/rear") combines lidars
    Raises InputError if it is no log, or for an unknown key.
    """
    named = sources_of(sources)
    checks.instance(
        config, LogConfig, "config", 'load_settings().config.log; a topic is chosen by topic="/points"'
    )
    if changes:
        short = {name.removeprefix("log__"): value for name, value in changes.items()}
        changed = load_settings(overrides=overrides_of(short, "log")).config.log
        config = replace(config, **{name: getattr(changed, name) for name in short})
    return Log(index_files(named, config), config)


def sources_of(sources: Source | str | Sequence[Source | str]) -> tuple[Source, ...]:
    """The files or addresses of one log. Raises InputError for anything else, and for an empty list."""
    named = [sources] if isinstance(sources, Source | str) else sources
    is_named = isinstance(named, Sequence) and all(isinstance(each, Source | str) for each in named)
    if not is_named:
        raise InputError(f"a log is {shown(sources)}; wanted a path, an address or a list of them")
    if not named:
        raise InputError("no log was given; wanted a path, an address or a list of them")
    return tuple(source_of(each) for each in named)


class Log:
    """An opened log; ``scans`` can be iterated any number of times.

    paths, name : its files, and their names for errors
    topic, dimension : the lidar's topic; 2 for laser scans and planar clouds, 3 for other clouds
    others : the lidars on other topics whose points are added to its scans; topics : of all, separated by commas
    mounting : of the lidar on the robot, with T_base_lidar (d+1, d+1); stated_mounting : None if it is assumed
    scan_count : number of scans by the index, for the chosen part and ``every``
    duration_s : time from the first to the last message
    odometry_topic : topic of the wheel odometry, empty if there is none; wheels : with frames and rate, for /tf
    notes : choices and assumptions
    distortion : motion distortion of scans without point times, as text; empty if it is removed
    distorted_share : share of the motion between scans that distorts them, if it is not removed

    imu, gnss : its IMU and its GNSS receiver; None if it has none, or several

    Set by reading, once ``scans`` is exhausted or closed:
    bad_scans, scans_with_wheels : number of scans left out, and with a wheel reading near their stamp
    wheels_late_s : delay of the stamps of the wheels where they are of another clock, else 0
    times : reader of the point times; jumps : warnings about jumps or a wrong rate of the header stamps
    together : the other lidars
    """

    together: Together
    _truth: Trajectory | None

    def __init__(self, indexes: Sequence[FileIndex], config: LogConfig) -> None:
        self.config, self.indexes = config, indexes
        self.paths, self.name = tuple(index.path for index in indexes), name_of(indexes)
        self.notes: list[str] = [line for index in indexes for line in index.notes]
        stream.check_one_log(indexes, config)
        lidar, *others = find_lidars(indexes, config.topic)
        self.lidar, self.topics = lidar, ", ".join(each.topic for each in (lidar, *others))
        self.topic, truth = lidar.topic, find_ground_truth(indexes, config.ground_truth_topic)
        self.ground_truth_topic = "" if truth is None else truth.topic
        self._sampled_times = self.times = PointTimes(config)
        self.plane_height_m: float | None = None
        sample = partial(stream.sampled_messages, indexes, self.topic)
        first, again = tee(each.value for each in sample(self.decoder(self._sampled_times), blocks=MOST))
        self.plane_height_m = None if is_scan(lidar) else plane_height_m(first)
        if (z_m := self.plane_height_m) is not None:
            self.notes.append(
                f"the clouds of {self.topic} are planar (z = {z_m:.3g} m everywhere): read as a 2D log"
            )
        self.dimension = 2 if is_scan(lidar) or self.plane_height_m is not None else 3
        self.duration_s = (whole := stream.whole_span(indexes)).duration_s
        self.span = stream.chosen_span(whole, config)
        self.sectors = find_sectors(again, config.point_times)
        self.scan_count = expected_sweeps(stream.count_scans(indexes, self.topic, whole, config), self.sectors)
        of_part = partial(sample, self.decoder(PointTimes(config)), self.span)
        self.publishers = Publishers(
            of_part, partial(between_frames, indexes, self.span), is_planar=self.dimension == 2
        )
        self.others = other_lidars(indexes, others, config, self.publishers, self.notes)
        wheels = find_wheels(indexes, self.publishers.frame, config, self.span, self.notes)
        self.mounting = mounting = find_mounting(indexes, self.publishers.frame, wheels, self.span, config)
        self.gaps = stream.gap_notes(indexes, config)  # the notes on long gaps
        topic = wheels.channel.topic if wheels else ""
        self.notes += self.publishers.notes + ([self.sectors.note(self.topic)] if self.sectors else [])
        self.notes += stream.notes_on(indexes, config) + (
            mounting.notes(topic, self.dimension)
            if self.publishers.known
            else [f"no message of {self.topic} could be understood"]
        )
        wheels = wheels if mounting.motion is None else None
        self.odometry_topic, self.wheels = (topic, wheels.text) if wheels else ("", "")
        T, is_planar = mounting.T_base_lidar, self.dimension == 2
        self.is_mirrored = is_planar and (config.upside_down or is_upside_down(T))
        self.T_base_lidar: Pose = in_plane(T) if is_planar else T
        self.stated_mounting = self.T_base_lidar if mounting.is_stated else None
        self._damage: list[str] = [line for index in indexes for line in index.damage]
        self.imu, self.gnss = find_sensors(indexes, config, self.publishers.frame, self.span, self.notes)
        self.sample_decoders = self._sample_decoders(wheels, truth)
        self.scans_with_wheels, self.bad_scans, self.distorted_share, self.distortion = 0, 0, 0.0, ""
        self.jumps, self._truth, self._opening_notes, self.wheels_late_s = [], None, tuple(self.notes), 0.0

    def __repr__(self) -> str:
        return f"Log({self.name!r}: {counted(self.scan_count, f'{self.dimension}D scan')} of {self.topic})"

    def __len__(self) -> int:
        return self.scan_count

    def __iter__(self) -> Generator[Scan, None, None]:
        return self.scans()

    def __getitem__(self, index: int) -> Scan:
        """The scan with this index, from 0; all before it are read too. Raises InputError if there is none."""
        number = checks.integer(
            index, "index", "the number of a scan, from 0; islice(log, first, last) for some", least=0
        )
        with closing(self._apart().scans()) as scans:
            scan = next(islice(scans, number, None), None)
        if scan is None:
            raise InputError(
                f"{self.name}: has no scan {number:,}, {counted(self.scan_count, 'scan')} by the index"
            )
        return scan

    def _apart(self) -> Log:
        """Copy of the log with separate counts and notes."""
        other = copy(self)
        other.publishers = copy(self.publishers)
        other.publishers.known = dict(self.publishers.known)
        return other

    @property
    def placed(self) -> dict[str, str]:
        """Topics of the IMU and the GNSS receiver in use, and where they are in the frame of the lidar."""
        return {each.topic: each.place for each in (self.imu, self.gnss) if each is not None}

    @property
    def damage(self) -> list[str]:
        """Damage found so far; complete once ``scans`` is exhausted or closed."""
        return grouped(self._damage)

    def scans(self, preprocess: PreprocessConfig | None = None) -> Generator[Scan, None, None]:
        """Scans in the order of log time, each with the wheel odometry pose at its stamp.

        A scan that is malformed, has no valid point at all or none in the range that ``preprocess`` retains is
        left out and reported in ``damage``, as are damaged chunks. Raises InputError if there are more such scans
        than ``log.max_bad_scans_percent`` allows.
        """
        self._damage = [line for index in self.indexes for line in index.damage]
        self.notes = list(self._opening_notes)
        recorded = Recorded(
            self.odometry_topic,
            self.ground_truth_topic,
            self.imu,
            self.gnss,
            is_mirrored=self.is_mirrored,
            delays_s=(self.config.odometry_delay_s, self.config.imu_delay_s),
        )
        counts = ScanCounts(self.topic, self.odometry_topic)
        self.times, latest = self._point_times(), dict[str, tuple[int, OtherPoints]]()
        self.together = Together(self.topic, self.others, self.publishers, is_mirrored=self.is_mirrored)
        assembler = None if self.sectors is None else Assembler(self.sectors, self.topic, self.times)
        count, index, requested_s, jump_s, self.scans_with_wheels = 0, 0, working_s(), 0.0, 0
        try:
            for message, T_odom_base, jumped_s in with_jumps(self._with_samples(counts, recorded, assembler)):
                count, jump_s = count + 1, jumped_s or jump_s
                if (count - 1) % self.config.every:
                    continue
                if unusable := defect(message, preprocess):
                    path = self.indexes[message.channel.key[0]].path
                    complaint = f"{path}: scan {count - 1} of {self.topic} {unusable}"
                    counts.reject(complaint, self.scan_count, self.config)
                    continue
                returns: Returns = message.value
                own, others = seen_together(returns, self.publishers, latest, is_mirrored=self.is_mirrored)
                scan = Scan(
                    index=index,
                    stamp_ns=returns.stamp_ns,
                    log_time_ns=message.log_time_ns,
                    points=own.points,
                    times_s=returns.times_s,
                    dropped=returns.dropped,
                    T_odom_base=T_odom_base,
                    waited_s=working_s() - requested_s,
                    is_copy=counts.repeats(own.points),
                    clock_jump_s=jump_s,
                    others=others,
                    origin=own.origin if own.origin.any() else None,
                    inertial=recorded.inertial(returns),
                    fixes=recorded.fixes(returns),
                )
                counts.add(scan)
                self.scans_with_wheels += T_odom_base is not None
                yield scan
                index, jump_s, requested_s = index + 1, 0.0, working_s()
            self._truth = recorded.ground_truth(self._lidar_on)
        finally:  # also if the caller stops early
            is_damaged, self.jumps, self.bad_scans = bool(self._damage), counts.jumps(), counts.bad
            self.wheels_late_s, lost = recorded.wheels_late_s(), [*recorded.losses(), *self.together.losses()]
            self._damage += [
                *counts.losses(), *self.times.warnings(self.topic), *self.jumps, *lost,
                *stream.overlap_notes(self.indexes, self.topic),
            ]  # fmt: skip
            self.notes += [note for note in self.publishers.notes if note not in self.notes]
            is_said = any(note.startswith(UNTIMED.partition(":")[0]) for note in self._opening_notes)
            assumed = "" if is_said and self.times.assumed == UNTIMED else self.times.assumed
            self.notes += [*filter(None, [assumed]), *self.times.faults(self.topic), *counts.notes()]
            self.notes += (assembler.notes() if assembler else []) + recorded.notes() + self.together.notes()
        if not index:
            raise InputError(f"{self.name}: no scan of {self.topic} could be read: {'; '.join(self.damage)}")
        if is_damaged:
            self._damage.append(counts.recovered(0 if self.sectors else self.scan_count))

    def windows(self, places: Sequence[float], scans: int) -> Iterator[list[Scan]]:
        """Windows of ``scans`` scans, at places from 0 (start of the log) to 1 (end); shorter ones are skipped."""
        whole = stream.whole_span(self.indexes)
        begin_ns, end_ns = max(self.span.begin_ns, whole.begin_ns), min(self.span.end_ns, whole.end_ns)
        last_ns = (end_ns - begin_ns) * max(1.0 - scans / max(self.scan_count - 1, 1), 0.0)
        for place in places:
            window = self._apart()
            window.span = stream.Span(begin_ns + round(place * last_ns), end_ns)
            with suppress(InputError), closing(window.scans()) as following:
                found = list(islice(following, scans))
                if len(found) == scans:
                    yield found

    def time_points(self, config: LogConfig, note: str) -> None:
        """Use the point times of another configuration from now on; ``note`` explains the change."""
        self.config = config
        self._opening_notes += (note,)

    def assumed_point_times(self) -> str:
        """Assumption of a run about per-point times, from the first scan with returns; empty for laser scans."""
        times = self._sampled_times
        if self.sectors is not None:
            times = self._point_times()
            next(stream.sampled_messages(self.indexes, self.topic, self.decoder(times)), None)
            if not times.assumed.startswith("point times"):
                times.assumed = self.sectors.assumed
        return "" if is_scan(self.lidar) else times.assumed

    def expected_stamps(self, topic: str) -> NDArray[np.int64]:
        """First and last header stamp (2,) expected of a topic in the part that is read, from its first message.

        topic : the lidar's or the ground truth's
        Raises InputError if the topic has no usable message there.
        """
        decode = self.sample_decoders.get(topic) or self.decoder(self._point_times())
        why, unset = "", None
        for message in stream.decoded_messages(self.indexes, {topic: decode}, self.span, ahead=1, damage=[]):
            value = message.value
            if not isinstance(value, Returns | StampedPose):
                why = why or f" (the first: {value})"
            elif not isinstance(value, Returns) or self.publishers.of(value.frame).is_used:
                last_ns = min(self.span.end_ns, stream.whole_span(self.indexes).end_ns)
                expected = np.array([value.stamp_ns, value.stamp_ns + last_ns - message.log_time_ns])
                if value.stamp_ns or isinstance(value, StampedPose):
                    return expected
                unset = expected if unset is None else unset
        if unset is not None:
            return unset
        raise InputError(f"{self.name}: no message of {topic} in the part that is read could be understood{why}")

    def ground_truth(self) -> Trajectory | None:
        """Poses of ``log.ground_truth_topic`` or None; read separately if ``scans`` is not exhausted."""
        topic = self.ground_truth_topic
        if self._truth is None and topic:
            recorded, decoders = Recorded("", topic), {topic: self.sample_decoders[topic]}
            for message in stream.decoded_messages(self.indexes, decoders, self.span, damage=[]):
                recorded.add(message)
            self._truth = recorded.ground_truth(self._lidar_on)
        return self._truth

    def _lidar_on(self, frame: str) -> Pose | None:
        """T_frame_lidar (d+1, d+1), None if neither ``log.lidar_pose`` nor a fixed transform gives it."""
        if self.config.lidar_pose and frame == (self.mounting.base or "base_link"):
            return self.T_base_lidar
        is_other = frame not in ("", self.publishers.frame)
        T = between_frames(self.indexes, self.span, frame, self.publishers.frame) if is_other else np.eye(4)
        return in_plane(T) if T is not None and self.dimension == 2 else T

    def _sample_decoders(self, wheels: Wheels | None, truth: Channel | None) -> dict[str, Read]:
        """Readers of the messages of the other sensors, by topic."""
        found: dict[str, Read] = {each.topic: each.read for each in (self.imu, self.gnss) if each is not None}
        if wheels is not None:
            found[wheels.channel.topic] = pose_reader(wheels.channel, self.dimension, wheels.link)
        if truth is not None:
            found[truth.topic] = pose_reader(truth, self.dimension)
        return found

    def _with_samples(
        self, counts: ScanCounts, recorded: Recorded, assembler: Assembler | None
    ) -> Iterator[tuple[Decoded, Pose | None]]:
        """Scans with the wheel odometry pose at their stamp; they are held back briefly for samples after them."""
        decoders = {self.topic: self.decoder(self.times), **self.together.decoders, **self.sample_decoders}
        scaled = ScaledOdometry(self.config.odometry_scale, self.config.odometry_turn_scale)
        waiting: deque[Decoded] = deque()
        messages = stream.decoded_messages(self.indexes, decoders, self.span, damage=self._damage)
        messages = messages if assembler is None else assembler.sweeps(messages)
        for message in chain(self.together.joined(self.times.checked(messages, self.topic)), [None]):
            if message is not None and message.channel.topic == self.topic:
                value = message.value
                if not isinstance(value, Returns) or counts.uses(self.publishers.of(value.frame), value):
                    waiting.append(message)
            elif message is not None:
                recorded.add(message)
            while waiting and (
                message is None
                or len(waiting) > HOLD_SCANS
                or message.log_time_ns - waiting[0].log_time_ns > recorded.patience_ns
                or not isinstance(first := waiting[0].value, Returns)
                or recorded.covers(first)
            ):
                scan = waiting.popleft()
                value, log_time_ns = scan.value, scan.log_time_ns
                wheels = recorded.wheels(value.stamp_ns, log_time_ns) if isinstance(value, Returns) else None
                yield scan, wheels and scaled.corrected(wheels.T_parent_child)

    def decoder(self, times: PointTimes) -> Callable[[memoryview], Returns]:
        """Decoder of the lidar's messages to points; ``times`` records what is assumed about the point times."""
        return decoder(self.lidar, times, self.plane_height_m)

    def _point_times(self) -> PointTimes:
        """New reader of point times; if messages are sectors, in the unit inferred from their duration."""
        unit = self.sectors.point_times if self.sectors else self.config.point_times
        return PointTimes(replace(self.config, point_times=unit))
