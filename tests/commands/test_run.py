"""``scanchain run`` and ``check``: what is printed where, what flags change, which true poses are used."""

import json
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from scanchain.data import Trajectory
from scanchain.errors import folded
from scanchain.logs.writer import LogWriter
from scanchain.runs.metrics import REASON, shortened, verdict_lines
from scanchain.settings import flatten
from scanchain.trajectory import read_tum, write_kitti, write_tum
from tests.support.in_process import here
from tests.support.messages import says, unfolded
from tests.support.naive_logs import SECOND, STAMP_NS, laser_scan, odometry, odometry_said, scan_said, write
from tests.support.scenes import configured


def test_a_run_is_quiet_but_for_its_summary_when_piped(call, tmp_path, office):
    code, output, errors = call("run", office, "--out", tmp_path / "a")
    assert (code, errors) == (0, "")
    folder = tmp_path / "a"
    last = f"written        {folder}\nopen           {folder}/report.html, scanchain view {folder}\n"
    summary = (folder / "summary.txt").read_text()
    assert output == shortened(summary) + last and "\nms per scan " in summary and "ms per scan" not in output
    assert len(output.splitlines()) <= 25
    says(output, office, "/scan", "preset lidar2d of 2D logs", "60 over 5.9 s: 60 ok")
    says(output, f"\n{office} /scan (wheel odometry /odom; lidar at x 0.15, y 0.00 m of the base)\n")
    code, output, errors = call("run", office, "--out", tmp_path / "b", "--json", "--rerun", "off")
    assert (code, errors) == (0, "")
    assert json.loads(output) == json.loads((tmp_path / "b" / "metrics.json").read_text())
    assert json.loads(output)["scans"] == 60
    files = [{path.name for path in (tmp_path / name).iterdir()} for name in "ab"]
    assert files[0] - files[1] == {"recording.rrd"} and files[1] < files[0]


def test_a_run_whose_scans_tell_too_little_says_so_first_and_fails_with_its_results_written(call, tmp_path, ran):
    path = tmp_path / "radar.mcap"
    rng = np.random.default_rng(0)
    with LogWriter(path) as log:
        for k in range(20):
            log.point_cloud("/radar", k * SECOND // 10 + STAMP_NS, "radar", rng.uniform(-40.0, 40.0, (12, 3)))
    run = ran(path)
    assert (run.code, run.errors) == (1, "")  # once, on one of the two
    why = run.metrics["verdict_reason"]
    says(why, f"{run.metrics['degenerate']} of 20 scans are degenerate and {run.metrics['lost']} lost")
    says(why, "scans have 12 valid points", "radar", "--topic")
    for summary in (run.output, (run.folder / "summary.txt").read_text()):
        assert summary.splitlines()[0] == "verdict        not trustworthy"
        said = unfolded(summary).partition(f"\n{path} /radar")[0]
        assert said.startswith(f"verdict        not trustworthy {why.replace('; ', ' ')}")
    errors = call("run", path, "--out", tmp_path / "json", "--json")[2]
    assert errors == f"error: {tmp_path / 'json'}: not trustworthy: {why}\n"
    says((run.folder / "report.html").read_text(), *why.replace("'", "&#39;").split("; "))
    assert json.loads((run.folder / "run.json").read_text())["complete"] and (run.folder / "map.ply").exists()
    code, output, errors = call("check", run.folder)
    assert (code, errors) == (1, "") and output.startswith("\n  ".join(["not trustworthy", *why.split("; ")]))


def test_a_run_of_the_office_is_trustworthy_and_so_is_its_true_trajectory_but_not_one_that_jumps(
    call, tmp_path, office, ran
):
    run = ran(office, "--strict")
    metrics = run.metrics
    assert run.code == 0 and metrics["verdict"] == "trustworthy" and metrics["segments"] == []
    code, output, _ = call("check", run.folder, "--json")
    assert code == 0 and json.loads(output) == {
        name: metrics[name] for name in ("verdict", "verdict_error", "verdict_reason", "segments")
    }
    expected = metrics["expected_ate_m"]
    low, high = map(float, re.fullmatch(r"ATE ([\d.]+) to ([\d.]+) m", metrics["verdict_error"]).groups())
    assert low <= expected["low"] < expected["mean"] < expected["high"] <= high < expected["high"] + 0.001
    assert run.output.splitlines()[0] == f"verdict        trustworthy ({metrics['verdict_error']})"
    assert metrics["ok"] == 60 and metrics["verdict_reason"].startswith(
        "nothing to check in 60 scans; checked by "
    )
    truth = office.with_suffix(".tum")
    code, output, _ = call("check", "--trajectory", truth, office)
    (bound_m,) = map(float, re.findall(r"^trustworthy \(ATE below ([\d.]+) m by scan matching\)\n", output))
    assert code == 0 and 0.0 < bound_m < 0.1 and "wheels" in output
    poses = read_tum(truth)
    poses.poses[len(poses) // 2 :, 0, 3] += 3.0
    write_tum(tmp_path / "jump.tum", poses)
    code, output, _ = call("check", "--trajectory", tmp_path / "jump.tum", office)
    assert code == 1 and output.startswith("not trustworthy\n")
    says(output, "impossible acceleration, 3.0 m from where constant velocity leads")


def test_a_run_without_a_directory_gets_one_by_its_log_with_a_number_where_that_is_taken(
    call, tmp_path, office, monkeypatch
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my.log.mcap").symlink_to(office)
    for number, words in (("", ()), ("_2", ()), ("_2", ("--force",))):
        code, output, _ = call("run", "my.log.mcap", "--rerun", "off", "--end", "2", *words)
        name = "my" if words else f"my{number}"
        assert code == 0 and output.endswith(
            f"written        runs/{name}\nopen           runs/{name}/report.html\n"
        )
        assert json.loads(Path("runs", name, "run.json").read_text())["command"][-2:] == ["--out", f"runs/{name}"]
    assert sorted(path.name for path in Path("runs").iterdir()) == ["my", "my_2"]


def test_a_terminal_shows_three_reasons_and_how_many_more_there_are():
    head = list(verdict_lines("check these segments", ["a " * 60, "b", "c", "d", "e"]))
    assert shortened("\n".join([*head, "log.mcap", "   5 %"]) + "\n") == (
        "\n".join([*(line.rstrip() for line in head[:4]), f"{REASON}2 more in summary.txt", "log.mcap", "   5 %"])
        + "\n"
    )
    assert shortened("\n".join([head[0], *head[2:4], "x"]) + "\n") == "\n".join([head[0], *head[2:4], "x"]) + "\n"


def test_lines_are_folded_behind_their_labels_to_the_width_of_the_terminal_and_rows_of_tables_are_not(monkeypatch):
    monkeypatch.setenv("COLUMNS", "60")
    said = f"note           {'text --log.point_times ' * 4}end"
    shown = folded(f"{said}\n{REASON}{'word ' * 20}end\n\nmethod    ATE      RPE\n").splitlines()
    assert all(len(line) <= 60 for line in shown) and all(line.startswith(REASON) for line in shown[1:6])
    assert shown[4].startswith(f"{REASON}  word") and shown[-2:] == ["", "method    ATE      RPE"]
    assert unfolded("\n".join(shown[:3])) == said


# flags


def test_start_end_and_every_choose_scans(office, ran):
    whole, chosen = ran(office, "--end", "99"), ran(office, "--start", "1", "--end", "3", "--every", "2")
    says(whole.output, "note           --end 99 s has no effect: the log ends at ")
    # a scan is logged at its end: the one that begins 0.9 s after the log's begin is the first
    assert chosen.stamps == whole.stamps[9:30:2]
    assert [chosen.config[f"log.{key}"] for key in ("start_s", "end_s", "every")] == [1.0, 3.0, 2]


def test_info_and_compare_take_the_part_that_run_takes(call, tmp_path, office, monkeypatch):
    here(monkeypatch)
    part = ("--topic", "/scan", "--start", "1", "--end", "3", "--every", "2")
    says(call("info", office, *part)[1], "/scan: 2D, 11 scans")
    code, output, _ = call("compare", office, *part, "--methods", "plicp", "--out", tmp_path / "c", "--json")
    assert code == 0 and json.loads(output)["scans"] == 11


def test_flags_stand_for_keys_and_change_the_preset_and_a_file(tmp_path, office, ran):
    preset, mine = flatten(configured(2)), tmp_path / "mine.toml"
    mine.write_text("[maps]\nvoxel_size_m = 0.4\n")
    run = ran(office, "--matcher", "svd", "--no-loops", "--topic", "/scan")
    assert run.config == preset | {"matching.matcher": "svd", "loops.enabled": False, "log.topic": "/scan"}
    assert run.metrics["ok"] == 60 and run.metrics["ground_truth"]["optimized"]["ate_rmse_m"] < 0.02
    run = ran(office, "--config", mine, "--loops.enabled=true", "--local_map.voxel_size_m", "0.15")
    assert run.config == preset | {"maps.voxel_size_m": 0.4, "local_map.voxel_size_m": 0.15}
    source = f"preset lidar2d of 2D logs, {mine}, loops.enabled true, local_map.voxel_size_m 0.15"
    says(run.output, f"configuration  {source}")
    assert json.loads((run.folder / "run.json").read_text())["configuration"] == source
    run = ran(office, "--odometry.prior", "constant-velocity")
    says(run.output, "wheel odometry /odom, not used: odometry.prior is constant-velocity;")


# true poses


def test_ground_truth_is_taken_from_the_file_named_else_from_the_log(tmp_path, office, ran):
    truth = read_tum(office.with_suffix(".tum"))
    stretched = truth.poses.copy()
    stretched[:, :2, 3] *= 2.0
    write_tum(tmp_path / "other.tum", Trajectory(truth.stamps_ns, stretched))
    write_kitti(tmp_path / "poses.txt", truth)
    sources = [
        tmp_path / "other.tum",
        office.with_suffix(".tum"),
        tmp_path / "poses.txt",
        "/odom",
        "/ground_truth",
    ]
    found = [ran(office, "--gt", source).metrics["ground_truth"] for source in sources]
    assert [each["source"] for each in found] == list(map(str, sources))
    other_m, *near_m, of_log_m = (each["optimized"]["ate_rmse_m"] for each in found)
    assert other_m > 0.3 and near_m[:2] == pytest.approx([of_log_m] * 2, abs=1e-7)
    assert found[2]["optimized"]["pairs"] == 60
    run = ran(office)
    assert run.metrics["ground_truth"]["optimized"]["ate_rmse_m"] == of_log_m < 0.02
    assert ran(office, "--gt", "none").metrics["ground_truth"] is None


def test_true_poses_that_fit_no_scan_are_refused_before_the_work(refused, tmp_path, office):
    (tmp_path / "old.tum").write_text("1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    truth = read_tum(office.with_suffix(".tum"))
    write_kitti(tmp_path / "poses.txt", truth)
    words = ["--out", tmp_path / "a", "--rerun", "off", "--gt"]
    first, last = truth.stamps_ns[[0, -1]] / 1e9
    says(refused("run", office, *words, tmp_path / "old.tum"), "1.000 to 2.000 s", f"{first:.3f} to {last:.3f} s")
    says(refused("run", office, *words, tmp_path / "poses.txt", "--end", "3"), "60 lines for 30 scans")
    stamps_ns = [STAMP_NS + k * SECOND for k in range(20)]
    said = [scan_said(stamp_ns, laser_scan(stamp_ns, [3.0] * 31)) for stamp_ns in stamps_ns]
    said += [odometry_said(stamp_ns, odometry(stamp_ns - STAMP_NS, 0, 0), "/mocap") for stamp_ns in stamps_ns]
    log = write(tmp_path / "a.mcap", said)
    says(refused("run", log, *words, "/mocap"), "/mocap", "0.000 to 19.000 s")
    says(refused("run", log, *words, "/ground_truth"), "/ground_truth", "scanchain info")


def test_true_poses_too_far_apart_are_a_warning_and_the_run_stands(call, tmp_path, office, ran):
    ends = read_tum(office.with_suffix(".tum")).stamps_ns[[0, -1]] / 1e9 + np.array([-1.0, 1.0])
    (tmp_path / "ends.tum").write_text("".join(f"{stamp:.9f} {k} 0 0 0 0 0 1\n" for k, stamp in enumerate(ends)))
    run = ran(office, "--gt", tmp_path / "ends.tum")
    assert run.code == 0 and run.errors.count("\n") == 1
    assert run.errors.startswith(f"warning: no accuracy against {tmp_path / 'ends.tum'}: ")
    says(run.output, "no accuracy against", "--max-gap")
    assert "\nATE " not in run.output
    assert run.metrics["ground_truth"] is None
    run = ran(office, "--gt", tmp_path / "ends.tum", "--max-gap", "100")
    assert run.code == 0 and "s apart, and the path between them is taken as straight" in run.errors
    assert run.metrics["ground_truth"]["max_gap_s"] == 100.0
    picture = tmp_path / "b.png"
    assert call("view", run.folder, "--png", picture)[0] == 0
    before = picture.read_bytes()
    picture.write_bytes(b"mine")
    code, _, errors = call("view", run.folder, "--png", picture)
    assert code == 2 and "--force" in errors and picture.read_bytes() == b"mine"
    assert call("view", run.folder, "--png", picture, "--force")[0] == 0
    assert picture.read_bytes() == before


def test_a_truth_of_few_scans_is_a_warning_that_says_why(tmp_path, office, monkeypatch, ran):
    truth = read_tum(office.with_suffix(".tum"))
    write_tum(tmp_path / "part.tum", Trajectory(truth.stamps_ns[10:30], truth.poses[10:30]))
    run = ran(office, "--gt", tmp_path / "part.tum")
    few = "accuracy is that of 20 of 60 scans alone: 40 without a true pose: 10 before the truth begins, 30 after"
    assert run.code == 0 and run.errors.startswith(f"warning: {few}")
    says(run.output, f"warning        {few}")
    assert run.metrics["warnings"] == [run.errors.removeprefix("warning: ").strip()]
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True, raising=False)
    run = ran(office, "--gt", tmp_path / "part.tum")
    assert run.output.count(few) == 1 and run.errors == ""  # a terminal shows both, and the summary has it


def test_a_log_cut_off_is_read_up_to_the_damage_and_the_damage_is_told(call, tmp_path, office, ran):
    path = tmp_path / "cut.mcap"
    whole = office.read_bytes()
    path.write_bytes(whole[: len(whole) * 9 // 10])
    run = ran(path)
    count = len(run.stamps)
    assert run.code == 0 and 30 < count < 60
    assert all(line.startswith("warning: ") for line in run.errors.splitlines())
    for text in (run.errors, run.output):
        says(text, "truncated", f"{count} scans of /scan were recovered")
    assert json.loads((run.folder / "run.json").read_text())["complete"]
    says(call("info", path)[1], "damage ", "truncated")
    assert json.loads(call("info", path, "--json")[1])["damage"]
