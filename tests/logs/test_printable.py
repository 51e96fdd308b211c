"""Names in logs: topics, types, frames and sessions are printable wherever they come from; nothing is forged."""

import json

import pytest

from scanchain.errors import printable
from scanchain.logs import open_log
from scanchain.maps.saved_map import Session
from tests.support import naive_logs, recorders
from tests.support.naive_logs import ROS1, ROS2
from tests.support.recorders import Ros

HOSTILE = ("\nlidar /forged", "\x1b[2J\x1b[H", "\rok", "\u202egnp", "\u2028", "\x9b1m", "\x00", "\t")


def drive(ros, evil):
    """The planar drive, its topics and frames with hostile ends, and a second scan topic."""
    for topic, kind, time_ns, message in ros.drive():
        if kind.endswith("TFMessage"):
            for each in message.transforms:
                each.header.frame_id += evil
                each.child_frame_id += evil
        else:
            message.header.frame_id += evil
            if hasattr(message, "child_frame_id"):
                message.child_frame_id += evil
        yield topic if topic == "/tf_static" else topic + evil, kind, time_ns, message
        if topic == "/scan":
            yield f"/other{evil}", kind, time_ns, message


def logs(folder, evil):
    for name, store in (("ros1", ROS1), ("ros2", ROS2)):
        ros = Ros(store)
        yield recorders.mcap_of(folder / f"{name}.mcap", ros, drive(ros, evil))
    yield recorders.bag1_of(folder / "a.bag", [*drive(Ros(ROS1), evil)])
    if "\x00" not in evil:  # which SQLite ends a text at
        yield recorders.bag2_of(folder / "bag", [*drive(Ros(ROS2), evil)])


def assert_printable(text):
    assert all(line.isprintable() for line in text.split("\n")), text
    assert "\nlidar /forged" not in text and "\u202e" not in text


@pytest.mark.parametrize("evil", HOSTILE)
def test_topics_and_frames_are_printable_and_chosen_by_what_is_printed(tmp_path, evil):
    for path in logs(tmp_path, evil):
        chosen = f"/scan{printable(evil)}"
        log = open_log(path, topic=chosen)
        assert log.topic == chosen and chosen.isprintable()
        assert len(list(log.scans())) == 3
        assert log.odometry_topic == f"/odom{printable(evil)}"
        assert log.mounting.base == f"base_link{printable(evil)}"
        for line in (*log.notes, *log.damage):
            assert_printable(line)


@pytest.mark.parametrize("evil", HOSTILE[:4])
def test_no_command_prints_what_a_topic_says_to_a_terminal(tmp_path, call, evil):
    path = recorders.bag1_of(tmp_path / "a.bag", [*drive(Ros(ROS1), evil)])
    for words in (["info", path], ["doctor", path], ["run", path, "--out", tmp_path / "absent"]):
        _, *output = call(*words)
        output = "".join(output)
        assert printable(f"/other{evil}") in output
        assert_printable(output)


def test_the_name_of_a_type_is_told_in_print(tmp_path, call):
    path = naive_logs.write(tmp_path / "a.mcap", naive_logs.office(2), rename="\x1b[31m{}\n".format)
    assert_printable("".join(call("info", path)[1:]))


def test_the_name_of_a_session_is_printable():
    for evil in HOSTILE:
        assert Session(f"a{evil}.mcap", 0, 1, 2).name == f"a{printable(evil)}.mcap"


def test_what_is_printable_stays_as_it_is():
    for text in ("/scan", "Größe ångström 激光", "a b", ""):
        assert printable(text) is text
    assert printable(json.loads('"\\ud800"')) == "\\ud800"
