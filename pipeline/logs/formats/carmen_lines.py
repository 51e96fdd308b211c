"""The lines of a CARMEN log (FLASER, ROBOTLASER1, ODOM, TRUEPOS) as ROS 2 messages."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from scanchain.logs.writing.pack import LATEST_NS, Place, pack_laser_scan, pack_odometry

KINDS = (b"FLASER", b"ROBOTLASER1", b"ODOM", b"TRUEPOS")
SCANS = (b"FLASER", b"ROBOTLASER1")

_LEAST_CODE_M = 81.83  # of a SICK LMS: from 8183 up its 13 bits are codes, such as that for no return
_STEPS_RAD = {180: math.pi / 180, 181: math.pi / 180, 360: math.pi / 360, 361: math.pi / 360, 401: math.pi / 720}
_HALF_TURN = math.pi


class Line(NamedTuple):
    """Where a line lies in the text, of which kind it is, and at which log time it counts."""

    kind: bytes
    begin: int
    end: int
    number: int
    stamp_ns: int
    log_time_ns: int


class CarmenScan(NamedTuple):
    """A laser line: the scan and the robot's pose, each as a message; ``mounting`` is the laser on the robot."""

    scan: bytes
    odometry: bytes
    mounting: Place


def stamp_of(words: list[bytes]) -> int:
    """Nanoseconds of a line's own stamp, the third word from behind, held as the double that CARMEN keeps.

    Raises ValueError or IndexError where that is none.
    """
    stamp_ns = int(float(words[-3]) * 1e9)
    if not 0 <= stamp_ns < LATEST_NS:
        raise ValueError(f"{stamp_ns} ns is no stamp")
    return stamp_ns


def read_scan(words: list[bytes], stamp_ns: int, max_range_m: float, offset_m: float) -> CarmenScan:
    """A FLASER or ROBOTLASER1 line. Raises ValueError or IndexError where words are missing or no numbers.

    max_range_m, offset_m : the scanner's reach and its place ahead of the robot's center, as the log's PARAM
        lines tell them for FLASER; ROBOTLASER1 tells both itself
    """
    if words[0] == b"FLASER":
        count = int(words[1])
        poses = _numbers(words[2 + count :], 6)
        step_rad = _STEPS_RAD.get(count, _HALF_TURN / max(count - 1, 1))
        first_rad = -0.5 * step_rad * (count - 1) if count == 401 else -0.5 * _HALF_TURN
        ranges_m = _numbers(words[2:], count)
        mounting, robot = Place(offset_m, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), poses[3:]
    else:
        first_rad, opening_rad, step_rad, max_range_m = _numbers(words[2:], 4)
        count = int(words[8])
        ranges_m = _numbers(words[9:], count)
        poses = _numbers(words[10 + count + int(words[9 + count]) :], 6)
        step_rad = step_rad if step_rad > 0.0 else opening_rad / max(count - 1, 1)
        mounting, robot = _mounting(poses[:3], poses[3:]), poses[3:]
    scan = pack_laser_scan(
        stamp_ns,
        "laser",
        first_rad,
        step_rad,
        np.array(ranges_m),
        range_min_m=0.0,
        range_max_m=min(max_range_m, _LEAST_CODE_M) if max_range_m > 0.0 else _LEAST_CODE_M,
    )
    return CarmenScan(scan, pack_odometry(stamp_ns, "odom", "base_link", planar(*robot)), mounting)


def read_pose(words: list[bytes], stamp_ns: int, frame: str) -> bytes:
    """The first three numbers of an ODOM or TRUEPOS line. Raises ValueError where they are none."""
    return pack_odometry(stamp_ns, frame, "base_link", planar(*_numbers(words[1:], 3)))


def planar(x_m: float, y_m: float, yaw_rad: float) -> Place:
    """A pose in the plane."""
    return Place(x_m, y_m, 0.0, 0.0, 0.0, math.sin(0.5 * yaw_rad), math.cos(0.5 * yaw_rad))


def _numbers(words: list[bytes], count: int) -> list[float]:
    if not 0 <= count <= len(words):
        raise ValueError(f"{count} numbers are told, {len(words)} words follow")
    return [float(word) for word in words[:count]]


def _mounting(laser: list[float], robot: list[float]) -> Place:
    """The laser's pose in the robot's frame."""
    dx, dy, dyaw = (a - b for a, b in zip(laser, robot, strict=True))
    cosine, sine = math.cos(robot[2]), math.sin(robot[2])
    return planar(cosine * dx + sine * dy, cosine * dy - sine * dx, dyaw)
