"""Every remedy that the doctor prints helps: a log with the fault, the error without its flags and with them."""

import ast
import json
import math
import re
import shlex
import struct

import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory

from scanchain.__main__ import main
from scanchain.logs import open_log
from scanchain.simulation import simulate
from tests.support.naive_logs import (
    SECOND,
    Said,
    cloud_said,
    laser_scan,
    odometry,
    odometry_said,
    point_cloud,
    scan_said,
    write,
)
from tests.support.scenes import ROOT

ROW = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("time", "<f4")])
TOUCHED = {"/scan", "/points", "/ground_truth"}


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A log of a simulated drive, made once."""
    folder, made = tmp_path_factory.mktemp("worlds"), {}

    def log(name, sensor, duration_s):
        key = f"{name}_{sensor}_{duration_s:g}"
        if key not in made:
            made[key] = folder / f"{key}.mcap"
            simulate(name, made[key], duration_s=duration_s, sensor=sensor)
        return made[key]

    return log


def said_in(path):
    """(number within its topic, message, decoded) of every message."""
    numbers = {}
    with path.open("rb") as stream:
        reader = make_reader(stream, decoder_factories=[DecoderFactory()])
        for schema, channel, message, decoded in reader.iter_decoded_messages():
            number = numbers[channel.topic] = numbers.get(channel.topic, -1) + 1
            yield number, Said(channel.topic, schema.name, message.log_time, message.data), decoded


def kept(path, keep):
    """The messages of a log whose scans and truths are thinned out by their number, without its wheels."""
    for number, said, _ in said_in(path):
        if (said.topic in TOUCHED and keep(number)) or said.topic == "/tf_static":
            yield said


def planar(path, change):
    """The messages of a planar log, ranges changed by ``change(number, ranges)``."""
    for number, said, decoded in said_in(path):
        if said.topic == "/scan":
            ranges = change(number, np.array(decoded.ranges, np.float32))
            data = laser_scan(
                stamp_of(said.data), ranges, first=decoded.angle_min, step=decoded.angle_increment,
                beam_s=decoded.time_increment, low=decoded.range_min, high=0.0, frame="lidar",
            )  # fmt: skip
            yield scan_said(said.log_ns, data)
        elif said.topic != "/odom":
            yield said


def clouds(path, change, *, fields=ROW, scale=1.0, count=80, every=1):
    """The messages of a cloud log, rows made by ``change(rows, seconds)``, the world shrunk or grown.

    ``count`` scans, of each every ``every``-th point.
    """
    log = open_log(path)
    truth = log.ground_truth()
    for scan in log.scans():
        if scan.index == count:
            return
        T = truth.poses[scan.index].copy()
        T[:3, 3] *= scale
        data = odometry_of(scan.stamp_ns, T)
        yield odometry_said(scan.stamp_ns, data, "/ground_truth")
        points = scan.points[::every]
        rows = np.zeros(len(points), fields)
        for axis, name in enumerate("xyz"):
            rows[name] = scale * points[:, axis]
        change(rows, scan.times_s[::every])
        yield cloud_said(scan.stamp_ns + SECOND // 10, point_cloud(scan.stamp_ns, rows))


def odometry_of(stamp_ns, T):
    """A pose in space as nav_msgs/Odometry; this town is flat."""
    return odometry(stamp_ns, T[0, 3], T[1, 3], math.atan2(T[1, 0], T[0, 0]), z=T[2, 3])


def stamp_of(data):
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    return seconds * SECOND + nanoseconds


def stamped(said, stamp_ns):
    data = said.data[:4] + struct.pack("<iI", *divmod(stamp_ns, SECOND)) + said.data[12:]
    return Said(said.topic, said.kind, said.log_ns, data)


# logs, each with one fault


def a_gap(world):
    return kept(world("town", "vlp-16", 20.0), lambda k: not 100 <= k < 140)


def copies(world):
    last = None
    for number, said, _ in said_in(world("office", None, 40.0)):
        if said.topic == "/scan":
            last = said if number % 2 == 0 else last
            yield Said(said.topic, said.kind, said.log_ns, stamped(last, stamp_of(said.data)).data)
        elif said.topic != "/odom":
            yield said


def a_range_for_no_return(world):
    def change(number, ranges):
        ranges[100:220] = 29.99
        return ranges

    return planar(world("office", None, 40.0), change)


def wheels_far_from_an_unmounted_lidar(world):
    """Three meters behind it, scans at 1.7 Hz."""
    for number, said, decoded in said_in(world("office", None, 40.0)):
        if said.topic == "/odom":
            pose = decoded.pose.pose
            yaw = 2.0 * math.atan2(pose.orientation.z, pose.orientation.w)
            x, y = pose.position.x - 3.0 * math.cos(yaw), pose.position.y - 3.0 * math.sin(yaw)
            yield odometry_said(said.log_ns, odometry(stamp_of(said.data), x, y, yaw))
        elif said.topic in TOUCHED and number % 6 == 0:
            yield said


def no_point_times(world):
    return clouds(world("town", "vlp-16", 20.0), lambda rows, times_s: None, fields=np.dtype(ROW.descr[:3]))


def hundredths_of_a_second(world):
    def change(rows, times_s):
        rows["time"] = 100.0 * times_s

    return clouds(world("town", "vlp-16", 20.0), change, count=25)


def timed(rows, times_s):
    rows["time"] = times_s


def a_wide_world(world):
    return clouds(world("town", "vlp-16", 20.0), timed, scale=8.0, count=35, every=3)


def a_narrow_world(world):
    return clouds(world("town", "vlp-16", 20.0), timed, scale=0.012)


def blind(number, ranges):
    ranges[3:] = np.nan
    return ranges


def a_blind_start(world):
    return planar(world("office", None, 20.0), lambda k, ranges: blind(k, ranges) if k < 25 else ranges)


def a_blind_end(world):
    return planar(world("office", None, 20.0), lambda k, ranges: blind(k, ranges) if k >= 180 else ranges)


def many_empty_scans(world):
    return planar(world("office", None, 20.0), lambda k, ranges: np.nan * ranges if k % 5 == 4 else ranges)


FAULTS = {
    a_gap: "gaps",
    copies: "duplicates",
    a_range_for_no_return: "no return",
    wheels_far_from_an_unmounted_lidar: "wheels",
    no_point_times: "point times",
    hundredths_of_a_second: "point times",
    a_wide_world: "ranges",
    a_narrow_world: "ranges",
    a_blind_start: "returns",
    a_blind_end: "returns",
    many_empty_scans: "damage",
}


def figures(path, out, capfd, *flags):
    """Error of the odometry in meters, infinite where the run stops; scans lost. 1: it is unreliable."""
    words = ["run", path, "--out", out, "--rerun", "off", "--no-loops", "--force", "--json", *flags]
    code = main([str(word) for word in words])
    output = capfd.readouterr().out
    if code and not output.startswith("{"):
        return math.inf, 0
    metrics = json.loads(output)
    return metrics["ground_truth"]["odometry"]["ate_rmse_m"], metrics["lost"]


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_the_flags_of_a_finding_help(world, tmp_path, capfd, fault):
    path = write(tmp_path / "log.mcap", list(fault(world)), chunk_size=1 << 20)
    assert main(["doctor", str(path), "--json"]) == 0
    found = {finding["check"]: finding for finding in json.loads(capfd.readouterr().out)["findings"]}
    finding = found[FAULTS[fault]]
    flags = shlex.split(finding["remedy"])
    assert flags, finding
    before_m, lost = figures(path, tmp_path / "a", capfd)
    after_m, fewer_lost = figures(path, tmp_path / "a", capfd, *flags)
    print(f"{fault.__name__}: {before_m:.4f} m, with {shlex.join(flags)} {after_m:.4f} m")
    if "blind" in fault.__name__:
        assert lost > 10 * fewer_lost and after_m < before_m
    else:
        assert after_m < 0.9 * before_m


def test_every_flag_that_a_check_can_print_is_tried():
    """The flags in the texts of the checks are those of the faults above."""
    printed = set()
    for node in ast.walk(ast.parse((ROOT / "pipeline/scanchain/logs/doctor.py").read_text())):
        if isinstance(node, ast.Constant) and isinstance(node.value, str):
            printed |= set(re.findall(r"--[a-z][a-z_.]*[a-z]", node.value))
    assert printed == {
        "--end", "--start", "--every",
        "--log.max_range_m", "--odometry.prior", "--log.point_times", "--log.revolution_s",
        "--log.revolution_start_rad", "--preprocess.max_range_m", "--preprocess.min_range_m",
        "--log.max_bad_scans_percent",
    }  # fmt: skip
