"""CARMEN logs, plain or compressed, as /scan, /odom, /tf_static and, of a simulator, /ground_truth.

The order of the lines is preserved: the log time is the stamp of a scan or, where stamps step back, slightly later
than that of the previous scan. Format: https://carmen.sourceforge.net/logger_playback.html
"""

from __future__ import annotations

import bz2
import gzip
import math
import zlib
from collections import Counter
from collections.abc import Iterator
from contextlib import suppress
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from scanchain.config import LogConfig
from scanchain.errors import InputError, counted, printable
from scanchain.logs import writer
from scanchain.logs.formats import Format, UnknownFormatError
from scanchain.logs.formats.mcap import temporary_index
from scanchain.logs.index import FileIndex, most_decompressed_file

_PLACE = (b"offset", b"side_offset", b"angular_offset")  # of the laser on the robot, in m and rad
_RESOLUTION = b"laser_front_laser_resolution"  # parameter with the step of a scanner in degrees

KINDS = (b"FLASER", b"ROBOTLASER1", b"ODOM", b"TRUEPOS")
SCANS = (b"FLASER", b"ROBOTLASER1")
_LEAST_CODE_M = 81.83  # smallest range in meters that a SICK LMS uses as an error code, such as for no return
# by the number of beams of SICK's and Hokuyo's scanners, as in GMapping and CARMEN
_STEPS_DEG = {180: 1.0, 181: 1.0, 360: 0.5, 361: 0.5, 401: 0.25, 540: 0.5, 541: 0.5, 1081: 0.25}
_STEPS_DEG |= {682: 360.0 / 1024.0, 683: 360.0 / 1024.0, 769: 360.0 / 1024.0}
_FROM_THE_RIGHT = 180, 181, 360, 361  # number of beams of which the first is at −90 degrees; others are centered
_LONGEST_LINE = 1 << 18  # largest length of a line in bytes; a longer one is malformed


def is_carmen(_: Path, head: bytes) -> bool:
    """True if a file is compressed, or begins with a comment or a word of capitals and digits as in CARMEN."""
    word = head.split(maxsplit=1)[0] if head.strip() else b""
    is_word = word.isascii() and word.replace(b"_", b"").isalnum() and word.isupper()
    return head.startswith((b"BZh", b"\x1f\x8b")) or word.startswith(b"#") or is_word


def index_carmen(path: Path, number: int, _: LogConfig) -> FileIndex:
    """Index of the messages of a log's lines. Raises UnknownFormatError if no line is of a known kind."""
    malformed, damage = [0, 0], list[str]()
    others, guessed = Counter[bytes](), set[int]()
    index = temporary_index(
        path, number, lambda log: _write(log, read_lines(path, damage), malformed, others, guessed)
    )
    if not index.counts and not malformed[1]:
        absent = f"text without a line of {b', '.join(KINDS).decode()}"
        text = b"\n".join(islice(read_lines(path, []), 256))  # from which other formats are recognized
        raise UnknownFormatError(text, "".join(damage).removeprefix(f"{path}: ") or absent)
    index.damage += damage
    if malformed[1]:
        lines = f"{counted(malformed[1], 'malformed line')} skipped (the first: line {malformed[0]})"
        index.damage.append(f"{path}: {lines}")
    if others:
        listed = ", ".join(f"{count} {kind.decode('ascii', 'replace')}" for kind, count in others.items())
        index.notes.append(f"{path}: lines of kinds that are not supported: {printable(listed)}")
    for beams in sorted(guessed):
        index.notes.append(f"{path}: FLASER lines state no angles: {beams} beams are taken as those of 180 deg")
    return index


def _write(
    log: writer.LogWriter,
    lines: Iterator[bytes],
    malformed: list[int],
    others: Counter[bytes],
    guessed: set[int],
) -> None:
    """Write the messages of each line of a known kind.

    malformed : set to the number of the first malformed line and the count of malformed lines
    others : incremented by the number of lines of each unknown kind
    guessed : extended by the numbers of beams whose angles are assumed
    """
    parameters: dict[bytes, float] = {}
    scan_ns, is_mounted = 0, False
    for number, line in enumerate(lines, start=1):
        kind = line[:16].split(maxsplit=1)[0] if line[:16].strip() else b"#"
        if kind not in (*KINDS, b"PARAM"):
            if not kind.startswith((b"#", b"PARAM")):
                others[kind] += 1
            continue
        words = line.split()
        if kind == b"PARAM":
            with suppress(ValueError, IndexError):
                parameters[words[1]] = float(words[2])
            continue
        try:  # the stamp is the third word from the end, a double as in CARMEN
            stamp_ns = int(float(words[-3]) * 1e9)
            if not 0 <= stamp_ns < writer.LATEST_NS:
                raise ValueError
            if kind not in SCANS:
                topic, frame = ("/odom", "odom") if kind == b"ODOM" else ("/ground_truth", "world")
                packed = writer.pack_odometry(stamp_ns, frame, "base_link", planar(*_numbers(words[1:], 3)))
                log.append(topic, "nav_msgs/msg/Odometry", packed, stamp_ns, max(stamp_ns, scan_ns))
                continue
            scan, robot, laser = read_scan(words, stamp_ns, parameters)
            if kind == b"FLASER" and int(words[1]) not in _STEPS_DEG and not parameters.get(_RESOLUTION):
                guessed.add(int(words[1]))
        except (ValueError, IndexError, OverflowError):
            malformed[:] = malformed[0] or number, malformed[1] + 1
            continue
        scan_ns = max(stamp_ns, scan_ns + 100_000)  # preserves the order
        if not is_mounted:
            mounting = writer.pack_transforms(stamp_ns, writer.Link("base_link", "laser", laser))
            log.append("/tf_static", "tf2_msgs/msg/TFMessage", mounting, stamp_ns, scan_ns)
            is_mounted = True
        packed = writer.pack_odometry(stamp_ns, "odom", "base_link", robot)
        log.append("/odom", "nav_msgs/msg/Odometry", packed, stamp_ns, scan_ns)
        log.append("/scan", "sensor_msgs/msg/LaserScan", scan, stamp_ns, scan_ns)


def read_scan(words: list[bytes], stamp_ns: int, parameters: dict[bytes, float]) -> tuple[bytes, Any, Any]:
    """Message of a FLASER or ROBOTLASER1 line, the robot's pose, and the pose of the laser on the robot.

    parameters : the scanner's maximum range, its step, and its place on the robot, as set by the log's PARAM
        lines for FLASER; ROBOTLASER1 lines state these themselves
    Raises ValueError or IndexError if words are missing or not numbers.
    """
    max_range_m = parameters.get(b"robot_front_laser_max", 0.0)
    if words[0] == b"FLASER":
        count = int(words[1])
        poses = _numbers(words[2 + count :], 6)
        step_deg = _STEPS_DEG.get(count) or parameters.get(_RESOLUTION) or 180.0 / max(count - 1, 1)
        step_rad = math.radians(step_deg)
        first_rad = -0.5 * math.pi if count in _FROM_THE_RIGHT else -0.5 * step_rad * (count - 1)
        ranges_m = _numbers(words[2:], count)
        mounting = planar(*(parameters.get(b"robot_frontlaser_" + name, 0.0) for name in _PLACE))
    else:
        first_rad, opening_rad, step_rad, max_range_m = _numbers(words[2:], 4)
        count = int(words[8])
        ranges_m = _numbers(words[9:], count)
        poses = _numbers(words[10 + count + int(words[9 + count]) :], 6)
        step_rad = step_rad if step_rad > 0.0 else opening_rad / max(count - 1, 1)
        dx, dy, dyaw = (laser - robot for laser, robot in zip(poses[:3], poses[3:], strict=True))
        cosine, sine = math.cos(poses[5]), math.sin(poses[5])
        mounting = planar(cosine * dx + sine * dy, cosine * dy - sine * dx, dyaw)
    reach_m = min(max_range_m, _LEAST_CODE_M) if max_range_m > 0.0 else _LEAST_CODE_M
    beams = first_rad, step_rad, np.array(ranges_m)
    scan = writer.pack_laser_scan(stamp_ns, "laser", *beams, range_min_m=0.0, range_max_m=reach_m)
    return scan, planar(*poses[3:]), mounting


def planar(x_m: float, y_m: float, yaw_rad: float) -> Any:
    """Pose in the plane, as a message."""
    return writer.place_of((x_m, y_m, 0.0), (0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad)))


def _numbers(words: list[bytes], count: int) -> list[float]:
    if not 0 <= count <= len(words):
        raise ValueError(f"{count} numbers stated, {len(words)} words found")
    return [float(word) for word in words[:count]]


def read_lines(path: Path, damage: list[str]) -> Iterator[bytes]:
    """Lines of a file, decompressed; lost text is added to ``damage``.

    A line that is too long is cut. Raises InputError if a file cannot be read or decompresses to more than any
    log does.
    """
    size, text = 0, bytearray()
    try:
        with path.open("rb") as file:
            head, most = file.read(3), most_decompressed_file(path.stat().st_size)
        opened = bz2.open if head == b"BZh" else gzip.open if head[:2] == b"\x1f\x8b" else Path.open
        with opened(path, "rb") as file:
            while block := file.read1(256):  # bytes; all are lost if they are damaged
                size += len(block)
                if size > most:
                    raise InputError(f"{path}: decompresses to more than {most:,} bytes; is it a CARMEN log?")
                text += block
                if len(text) > 2 * _LONGEST_LINE:
                    *lines, rest = bytes(text).split(b"\n")
                    yield from lines
                    text = bytearray(rest[:_LONGEST_LINE])
    except (zlib.error, EOFError, ValueError, OSError) as error:
        if isinstance(error, OSError) and error.errno is not None:  # raised by the system, not by bz2 or gzip
            raise InputError(f"{path}: cannot be read ({error.strerror}); check the file") from error
        damage.append(f"{path}: cannot be decompressed after byte {size} of the text ({error})")
    yield from bytes(text).split(b"\n")


FORMAT = Format(
    "carmen", "a CARMEN .log or .clf (also .bz2, .gz)", is_carmen, index_carmen, (".log", ".clf", ".bz2", ".gz")
)
