"""Verdicts on clocks: scanchain doctor's and clockdoctor's (Apache 2.0) of the same logs.

First real logs, then copies of a simulated one (office, 60 s, with wheels) with one known fault each. A line says
what either reports of the times of the lidar's topic and of the wheels. clockdoctor reads MCAP in CDR itself; of
bags it gets the times that rosbags reads. Its flags of other topics are left out.
"""

from __future__ import annotations

import contextlib
import io
import json
import struct
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path

from mcap.reader import make_reader
from mcap.writer import Writer
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from tests.benchmarks.harness import drive_of, options_of, table
from tests.support.scenes import DATA

SECOND = 1_000_000_000
SHOWN = 110  # characters of a finding
REAL = {  # log, and its lidar's topic
    "2d/intel.mcap": "/scan",
    "2d/aces.mcap": "/scan",
    "2d/mit_csail.mcap": "/scan",
    "2d/mocap_room_1.bag": "/scan",
    "3d/kitti_0001_first54.mcap": "/velodyne_points",
    "3d/pandaset_002_sweeps30to55.mcap": "/pandar64/points",
    "reports/f2_ydlidar.mcap": "/scan",
    "reports/rplidar_standing.bag": "/scan",
    "reports/rplidar_turned.bag": "/scan",
    "reports/two_publishers.db3": "/scan",
}
Shift = Callable[[int, int], tuple[int, int] | None]  # (number, ns since the start) to those of stamp and log time
FAULTS: dict[str, tuple[tuple[str, ...], Shift]] = {  # topics that are altered, and how
    "none": ((), lambda k, t: (0, 0)),
    "all stamps 5 s behind": (("/scan", "/odom"), lambda k, t: (-5 * SECOND, 0)),
    "wheels stamped 0.3 s late": (("/odom",), lambda k, t: (3 * SECOND // 10, 0)),
    "wheels stamped 100 s ahead": (("/odom",), lambda k, t: (100 * SECOND, 0)),
    "scans stamped 0.1 % fast": (("/scan",), lambda k, t: (t // 1000, 0)),
    "all stamps jump ahead by 10 s": (("/scan", "/odom"), lambda k, t: (10 * SECOND * (t > 30 * SECOND), 0)),
    "every 20th scan stamped 0.15 s early": (("/scan",), lambda k, t: (-SECOND * 3 // 20 * (k % 20 == 19), 0)),
    "scans logged in bursts of five": (("/scan",), lambda k, t: (0, (4 - k % 5) * SECOND // 10)),
    "no scans for 2 s": (("/scan",), lambda k, t: None if 30 * SECOND < t < 32 * SECOND else (0, 0)),
}


def altered(source: Path, target: Path, topics: tuple[str, ...], shift: Shift) -> Path:
    """A copy of a log in CDR with stamps and log times shifted; messages for which that is None are left out."""
    numbers: dict[int, int] = {}
    start_ns = 0
    with source.open("rb") as stream, target.open("wb") as written:
        writer, numbered = Writer(written), dict.fromkeys(topics, -1)
        writer.start()
        for schema, channel, message in make_reader(stream).iter_messages():
            if channel.id not in numbers:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                numbers[channel.id] = writer.register_channel(channel.topic, channel.message_encoding, number)
            data, log_ns = bytearray(message.data), message.log_time
            if channel.topic in topics:
                numbered[channel.topic] += 1
                stamp_ns = SECOND * struct.unpack_from("<I", data, 4)[0] + struct.unpack_from("<I", data, 8)[0]
                start_ns = start_ns or stamp_ns
                shifted = shift(numbered[channel.topic], stamp_ns - start_ns)
                if shifted is None:
                    continue
                struct.pack_into("<II", data, 4, *divmod(stamp_ns + shifted[0], SECOND))
                log_ns += shifted[1]
            writer.add_message(numbers[channel.id], log_ns, bytes(data), log_ns)
        writer.finish()
    return target


def rows_of(bag: Path, target: Path) -> Path:
    """The times of a bag's messages in the format that clockdoctor analyzes."""
    with AnyReader([bag], default_typestore=get_typestore(Stores.ROS2_HUMBLE)) as reader, target.open("w") as rows:
        for connection, log_ns, data in reader.messages():
            header = getattr(reader.deserialize(data, connection.msgtype), "header", None)
            if header is not None:
                stamp = {"sec": header.stamp.sec, "nanosec": header.stamp.nanosec}
                row = {"topic": connection.topic, "schema_name": connection.msgtype, "log_time_ns": log_ns}
                row |= {"publish_time_ns": log_ns, "data": {"header": {"stamp": stamp, "frame_id": ""}}}
                rows.write(json.dumps(row) + "\n")
    return target


def theirs(log: Path, *topics: str) -> str:
    """clockdoctor's flags of these topics."""
    from clockdoctor.analyze import analyze_jsonl
    from clockdoctor.extract import extract_to_jsonl

    with tempfile.TemporaryDirectory() as folder, contextlib.redirect_stdout(io.StringIO()):
        rows = Path(folder, "log_messages.jsonl")
        extract_to_jsonl(log, out_path=rows) if log.suffix == ".mcap" else rows_of(log, rows)
        flags = json.loads(analyze_jsonl(rows)["timeline_json"].read_text())["flags"]
    said = (f"{each['topic']} {each['message'].partition(' -> ')[0]}" for each in flags if each["topic"] in topics)
    return "; ".join(f"{each[:SHOWN]}" for each in said) or "nothing"


def ours(log: Path, topic: str) -> str:
    """Findings of scanchain doctor about times that are not ok, and its notes about clocks."""
    command = [sys.executable, "-m", "scanchain", "doctor", log, "--topic", topic, "--json"]
    found = json.loads(subprocess.run(command, capture_output=True, check=True).stdout)
    said = [
        f"{each['check']}: {each['found']}"
        for each in found["findings"]
        if each["check"] in ("gaps", "stamps", "wheels", "damage") and each["severity"] != "ok"
    ]
    said += [note for note in found["notes"] if "clock" in note]
    return "; ".join(each[:SHOWN] for each in said) or "nothing"


def main() -> None:
    arguments = options_of(__doc__, real=False, faults=False)
    row = table("log", "clockdoctor", "scanchain doctor")
    for name, topic in {} if arguments.faults else REAL.items():
        row(Path(name).stem, theirs(DATA / name, topic, "/odom"), ours(DATA / name, topic))
    base = drive_of("office", "lms-270", 600, arguments.cache)
    with tempfile.TemporaryDirectory() as folder:
        for number, (name, (topics, shift)) in enumerate({} if arguments.real else FAULTS.items()):
            log = altered(base, Path(folder, f"{number}.mcap"), topics, shift)
            row(name, theirs(log, "/scan", "/odom"), ours(log, "/scan"))


if __name__ == "__main__":
    main()
