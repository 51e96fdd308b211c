"""CARMEN logs, as text or packed by bzip2 or gzip: /scan, /odom, /tf_static and, of a simulator, /ground_truth.

The order of the lines is kept: log time is the stamp of a scan, or a little more than that of the scan before
where stamps step back. Format: https://carmen.sourceforge.net/logger_playback.html
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from collections.abc import Set as AbstractSet
from pathlib import Path

from scanchain.logs.formats.carmen_lines import KINDS, SCANS, Line, read_pose, read_scan, stamp_of
from scanchain.logs.formats.made import made_block, made_channel, made_index, unknown
from scanchain.logs.formats.packed_text import read_text
from scanchain.logs.mcap.records import Block, Channel, Contents, FileIndex, Message
from scanchain.logs.writing.pack import Link, pack_transforms
from scanchain.source import Source
from scanchain.words import counted

_LINES_A_BLOCK = 512
_LEAST_STEP_NS = 100_000  # between the log times of two scans
_PARAMETERS = (b"robot_frontlaser_offset", b"robot_front_laser_max")


def index_carmen(path: Path, number: int) -> FileIndex:
    """Find the lines of a log. Raises InputError where the file holds none that is known."""
    text, damage = read_text(path)
    index = made_index(path, number)
    index.damage += [damage] if damage else []
    if not _Carmen(index, text).lines:
        raise unknown(
            path, text, damage.removeprefix(f"{path}: ") or f"text without a line of {b', '.join(KINDS).decode()}"
        )
    return index


class _Carmen:
    """The text of a log, its lines and its channels."""

    def __init__(self, index: FileIndex, text: bytes) -> None:
        self.index = index
        self.text = text
        self.parameters: dict[bytes, float] = {}
        self.others: Counter[bytes] = Counter()
        self.malformed: list[int] = []
        self.lines = list(self._find())
        self.first_scan = next((place for place, line in enumerate(self.lines) if line.kind in SCANS), -1)
        self.scan = made_channel(index, "/scan", "sensor_msgs/msg/LaserScan")
        self.odometry = made_channel(index, "/odom", "nav_msgs/msg/Odometry")
        self.mounting = made_channel(index, "/tf_static", "tf2_msgs/msg/TFMessage")
        self.truth = made_channel(index, "/ground_truth", "nav_msgs/msg/Odometry")
        for begin in range(0, len(self.lines), _LINES_A_BLOCK):
            self._block(begin)
        index.channels = {number: c for number, c in index.channels.items() if index.counts.get(number)}
        index.make = self.make
        self._tell()

    def make(self, block: Block, wanted: AbstractSet[int] | None) -> Contents:
        """The messages of a block of lines."""
        messages: list[Message] = []
        malformed: list[int] = []
        for place, line in enumerate(self.lines[block.offset : block.offset + _LINES_A_BLOCK]):
            try:
                messages += self._messages(line, is_first=block.offset + place == self.first_scan)
            except (ValueError, IndexError):
                malformed.append(line.number)
        if wanted is not None:
            messages = [message for message in messages if message.channel.key[1] in wanted]
        return Contents(messages, _complaint(self.index.path, malformed))

    def _messages(self, line: Line, *, is_first: bool) -> Iterator[Message]:
        words = self.text[line.begin : line.end].split()
        if line.kind in SCANS:
            offset_m, reach_m = (self.parameters.get(name, 0.0) for name in _PARAMETERS)
            told = read_scan(words, line.stamp_ns, reach_m, offset_m)
            if is_first:
                data = pack_transforms(line.stamp_ns, Link("base_link", "laser", told.mounting))
                yield self._message(self.mounting, line, data)
            yield self._message(self.odometry, line, told.odometry)
            yield self._message(self.scan, line, told.scan)
        elif line.kind == b"ODOM":
            yield self._message(self.odometry, line, read_pose(words, line.stamp_ns, "odom"))
        else:
            yield self._message(self.truth, line, read_pose(words, line.stamp_ns, "world"))

    def _message(self, channel: Channel, line: Line, data: bytes) -> Message:
        return Message(channel, line.log_time_ns, memoryview(data))

    def _find(self) -> Iterator[Line]:
        """Every line of a known kind, in the order of the file."""
        begin, log_ns = 0, 0
        for number, raw in enumerate(self.text.splitlines(keepends=True), start=1):
            kind = raw[:16].split(maxsplit=1)[0] if raw[:16].strip() else b"#"
            end = begin + len(raw)
            if kind in KINDS:
                try:
                    stamp_ns = stamp_of(raw.rsplit(maxsplit=3))
                    line_ns = max(stamp_ns, log_ns)
                    if kind in SCANS:
                        line_ns = log_ns = max(stamp_ns, log_ns + _LEAST_STEP_NS)
                    yield Line(kind, begin, end, number, stamp_ns, line_ns)
                except (ValueError, IndexError, OverflowError):
                    self.malformed.append(number)
            elif kind == b"PARAM":
                self._parameter(raw.split())
            elif not kind.startswith(b"#"):
                self.others[kind] += 1
            begin = end

    def _parameter(self, words: list[bytes]) -> None:
        if len(words) > 2 and words[1] in _PARAMETERS:
            try:
                self.parameters[words[1]] = float(words[2])
            except ValueError:
                self.others[b"PARAM"] += 1

    def _block(self, begin: int) -> None:
        lines = self.lines[begin : begin + _LINES_A_BLOCK]
        kinds = Counter(line.kind for line in lines)
        scans = sum(kinds[kind] for kind in SCANS)
        counts = {
            self.mounting: int(0 <= self.first_scan - begin < len(lines)),
            self.odometry: scans + kinds[b"ODOM"],
            self.scan: scans,
            self.truth: kinds[b"TRUEPOS"],
        }
        size = lines[-1].end - lines[0].begin
        made_block(self.index, begin, size, [line.log_time_ns for line in lines], counts)

    def _tell(self) -> None:
        if self.malformed:
            self.index.note_damage(_complaint(self.index.path, self.malformed))
        if self.others:
            listed = ", ".join(f"{count} {kind.decode('ascii', 'replace')}" for kind, count in self.others.items())
            self.index.notes.append(f"{self.index.path}: lines of kinds that are not read: {listed}")


def _complaint(path: Source, malformed: list[int]) -> str:
    if not malformed:
        return ""
    return f"{path}: {counted(len(malformed), 'malformed line')} left out (the first: line {malformed[0]})"
