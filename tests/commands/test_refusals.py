"""Whatever is wrong with a log or with arguments is told in one line, with exit code 2, and nothing is left.

The wording of a wrong key, value or log is checked where it is made; here, what the command line adds to it.
"""

import pytest

from tests.support.messages import says
from tests.support.naive_logs import STAMP_NS, laser_scan, scan_said, write

RUN = ["run", "{office}", "--out", "{tmp}/a"]
RING = ["optimize", "{ring}"]
TOO_LONG = ["longer than the file system takes (255 bytes per part); shorten it"]


def test_several_lidars_ask_for_a_choice_by_the_short_option_which_info_and_convert_take_too(
    call, refused, tmp_path
):
    said = [scan_said(STAMP_NS, laser_scan(STAMP_NS, [1.0] * 9), topic) for topic in ("/front", "/rear")]
    path = write(tmp_path / "two.mcap", said)
    says(refused("run", path, "--out", tmp_path / "a"), path, "--topic", "/front", "/rear")
    code, output, _ = call("info", path)
    assert code == 1 and "choose one with --topic" in output
    code, output, _ = call("info", path, "--topic", "/rear")
    assert code == 0 and "lidar     /rear: 2D, 1 scan" in output and "problem" not in output
    code, output, _ = call("convert", path, tmp_path / "rear.mcap", "--topic", "/rear")
    assert code == 0 and "/rear" in output and "/front" not in output


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (
            [*RUN, "--topic", "/nope"],
            ["{office}", "/nope", "choose --topic from", "/scan (sensor_msgs"],
        ),
        ([*RUN, "--start", "100"], ["{office}", "after --start 100 s; the log is 6.0 s long"]),
        ([*RUN, "--matching.max_distance_m"], ["--matching.max_distance_m needs a value", "--help"]),
        ([*RUN, "--every", "0"], ["--every", "log.every is 0", "whole number >= 1"]),
        ([*RUN, "--start", "soon"], ["--start", "'soon'", "a number >= 0, in s"]),
        ([*RUN, "--rerun", "off,save"], ["--rerun is 'off,save'", "save, spawn, connect, web"]),
        ([*RUN, "--rerun", "spawn,web"], ["only one of spawn, connect, web"]),
        ([*RUN, "--gt", "absent.tum"], ["absent.tum", "check the path"]),
        ([*RUN, "--gt", "{long}.tum"], ["{long}", *TOO_LONG]),
        ([*RUN, "--gt", "/nope"], ["log.ground_truth_topic /nope", "/odom"]),
        ([*RUN, "--checkpoint", "nan"], ["nan is no number"]),
        ([*RUN, "--threads", "100000"], ["--threads"]),
        ([*RUN, "--forec"], ["No such option '--forec'. Did you mean '--force'?; see scanchain run --help"]),
        (["run"], ["'LOG...'", "scanchain run --help"]),
        (["rum"], ["'rum'", "scanchain --help"]),
        (["run", "absent.mcap", "--out", "{tmp}"], ["{tmp}", "exists", "--force"]),
        (["run", "absent.mcap", "--out", "{tmp}/a"], ["absent.mcap: no such file; check the path"]),
        (["run", "empty.mcap", "--out", "{tmp}/a"], ["empty.mcap", "empty", "copy it again"]),
        (["run", "{long}", "--out", "a"], TOO_LONG),
        (["run", "{office}", "--out", "{long}"], TOO_LONG),
        (["simulate", "office", "{long}.mcap"], TOO_LONG),
        (["simulate", "office", "x.mcap", "--duration", "long"], ["--duration", "simulate --help"]),
        (["sequence", "get", "mulran"], ["mulran.mcap", "ask for a sequence", "scanchain convert"]),
        (["check", "{tmp}"], ["has no steps.parquet that can be read", "scanchain run", "--resume"]),
        (["check", "{office}"], ["is not a run directory", "--trajectory"]),
        (["check", "{office}", "{office}"], ["--trajectory"]),
        (["evaluate", "absent.tum"], ["give GT", "--relations"]),
        (["evaluate", "a", "b", "--max-gap", "nan"], ["--max-gap", "nan is no number"]),
        (["evaluate", "a", "b", "--time-offset", "soon"], ["--time-offset"]),
        (["evaluate", "a", "b", "--kitti", "--time-offset", "1"], ["files with stamps"]),
        (["evaluate", "a", "b", "--png", "{office}"], ["name a file that ends in .png"]),
        (["config", "show", "--loops.enable", "off"], ["--loops.enable", "loops.enabled"]),
        (["config", "dump", "--lidar", "4d"], ["--lidar", "'4d'", "config dump --help"]),
        (["view", "absent"], ["absent: no recording", "scanchain run"]),
        ([*RING, "--marginals", "all"], ["give --out FILE"]),
        (
            [*RING, "--marginals", "9", "--out", "a.g2o"],
            ["--marginals 9: no such vertex; the ids go from 0 to 3"],
        ),
        ([*RING, "--marginals", "one", "--out", "a.g2o"], ["give all, or vertex ids"]),
        ([*RING, "--png", "a.jpg"], ["name a file that ends in .png"]),
        ([*RING, "--recording", "a.png"], ["name a file that ends in .rrd"]),
        ([*RING, "--out", "zz.txt"], ["zz.txt: name a file that ends in .g2o or .graph or .toro"]),
        ([*RING, "--out", "none/a.g2o"], ["there is no folder"]),
        ([*RING, "--out", "{ring}"], ["exists; choose another name, or --force"]),
        ([*RING, "--out", "{tmp}"], ["is a folder"]),
        ([*RING, "--optimizer", "magic"], ["graph.optimizer is 'magic'; it must be one of"]),
        ([*RING, "--loops.drift", "1"], ["--loops.drift has no meaning for optimize"]),
    ],
)
def test_a_wrong_command_line_is_one_line_with_what_to_do(
    refused, monkeypatch, tmp_path, office, ring, words, said
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "empty.mcap").touch()
    names = {"office": office, "ring": ring, "tmp": tmp_path, "long": "x" * 260}
    says(refused(*(word.format(**names) for word in words)), *(part.format(**names) for part in said))
