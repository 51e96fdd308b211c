"""Remedies that the doctor prints help: a log with the fault, the error without its flags and with them."""

import json
import math
import shlex
import struct

import pytest

from scanchain.__main__ import main
from tests.support import made
from tests.support.naive_logs import (
    SECOND,
    Said,
    decoded,
    write,
)

TOUCHED = {"/scan", "/points", "/ground_truth"}


def said_in(path):
    """(number within its topic, message, decoded) of every message."""
    numbers = {}
    for schema, channel, message, contents in decoded(path):
        number = numbers[channel.topic] = numbers.get(channel.topic, -1) + 1
        yield number, Said(channel.topic, schema.name, message.log_time, message.data), contents


def stamp_of(data):
    seconds, nanoseconds = struct.unpack_from("<iI", data, 4)
    return seconds * SECOND + nanoseconds


# logs, each with one fault


def town():
    return made.log("town", seconds=15, sensor="vlp-16")


def a_gap():
    for number, said, _ in said_in(town()):
        if said.topic == "/tf_static" or (said.topic in TOUCHED and not 100 <= number < 140):
            yield said


FAULTS = {
    a_gap: "gaps",
}


def figures(path, out, capfd, *flags):
    """Error of the odometry in meters, infinite where the run stops."""
    words = [
        "run",
        path,
        "--out",
        out,
        "--rerun",
        "off",
        "--no-loops",
        "--error-bars",
        "quick",
        "--force",
        "--json",
        *flags,
    ]
    code = main([str(word) for word in words])
    output = capfd.readouterr().out
    if code and not output.startswith("{"):
        return math.inf
    return json.loads(output)["ground_truth"]["odometry"]["ate_rmse_m"]


@pytest.mark.slow
@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_the_flags_of_a_finding_help(tmp_path, capfd, fault):
    path = write(tmp_path / "log.mcap", list(fault()), chunk_size=1 << 20)
    assert main(["doctor", str(path), "--json"]) == 0
    found = {finding["check"]: finding for finding in json.loads(capfd.readouterr().out)["findings"]}
    finding = found[FAULTS[fault]]
    flags = shlex.split(finding["fix"])
    assert flags, finding
    before_m = figures(path, tmp_path / "a", capfd)
    after_m = figures(path, tmp_path / "a", capfd, *flags)
    print(f"{fault.__name__}: {before_m:.4f} m, with {shlex.join(flags)} {after_m:.4f} m")
    assert after_m < 0.9 * before_m
