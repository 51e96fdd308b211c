"""A comparison: the same scans for all, one bad method never touches another, figures that can be checked."""

import csv
import itertools
import json
import re
import subprocess
import sys

import msgspec
import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest

from scanchain import lie
from scanchain.__main__ import main
from scanchain.comparison.compare import Compared, Comparison, compare
from scanchain.comparison.figures import COLUMNS
from scanchain.comparison.methods import OURS, default_names, resolve
from scanchain.comparison.processes import EndReport, Outcome, Status, run_all, store
from scanchain.comparison.results import method_folder
from scanchain.comparison.table import Row, Table, markdown, read_table, text
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import absolute_error, disagreement, motion_nees, pair, sampled_map, sharpness
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.processes import Limits
from scanchain.runs.job import Progress
from scanchain.runs.provenance import Provenance
from scanchain.settings import Override, load_settings
from scanchain.simulation import simulate
from scanchain.trajectory import read_tum, write_kitti, write_tum
from tests.support.killing import processes_about, wait_until
from tests.support.scenes import ROOT, shared_data

SUPPORT = ROOT / "tests" / "support"
NATURES = ("Raises", "Hangs", "Eats", "Dies", "DiesEarly", "LosesItself", "Spatial")


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    """Six seconds in the simulated office, 60 scans, with the truth in the log and beside it."""
    path = tmp_path_factory.mktemp("log") / "office.mcap"
    simulate("office", path, duration_s=6.0)
    return path


@pytest.fixture(autouse=True)
def own_odometries(monkeypatch):
    """The methods of these tests can be imported by the processes of a comparison."""
    monkeypatch.setenv("PYTHONPATH", f"{SUPPORT}:{ROOT}", prepend=":")


def toml(path, text_):
    path.write_text(text_)
    return path


def run(office, folder, *methods, **changes):
    """The table of a comparison without report and recording."""
    comparison = Comparison(logs=(office,), out=folder / "out", methods=methods, **changes)
    return compare(comparison, lambda _: None, Progress()).table


def row(table, name):
    return next(each for each in table.rows if each.name == name)


def refused(*arguments, match):
    with pytest.raises(InputError, match=match):
        resolve(*arguments[:2], file=arguments[2] if len(arguments) > 2 else None)


GOOD = """
    [coarse]
    method = "plicp"
    local_map.voxel_size_m = 0.4
    [mine]
    method = "bad_odometries:Shifted"
    step_m = 0.25
    [unsteady]
    method = "bad_odometries:Unsteady"
"""


@pytest.fixture(scope="module")
def good(office, tmp_path_factory):
    """Two runs each of five methods that come to their end: the table and its directory."""
    folder = tmp_path_factory.mktemp("good")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{SUPPORT}:{ROOT}", prepend=":")
        names = ("plicp", "svd+loops", "coarse", "mine", "unsteady")
        table = run(office, folder, *names, repeat=2, config_file=toml(folder / "good.toml", GOOD))
    return table, folder / "out"


# one that is bad


@pytest.fixture(scope="module")
def bad(office, tmp_path_factory):
    """Bad methods among two good ones, by the command line: the exit code and the directory.

    The clock of the time limit stands still until one hangs, so that a slow machine ends no other.
    """
    folder = tmp_path_factory.mktemp("bad")
    hanging = folder / "hanging"
    settings = "".join(f'[{name.lower()}]\nmethod = "bad_odometries:{name}"\n' for name in NATURES)
    names = [name.lower() for name in NATURES]
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", f"{SUPPORT}:{ROOT}", prepend=":")
        patch.setenv("HANGS_FILE", str(hanging))
        patch.setattr("scanchain.processes.monotonic", lambda: 1000.0 * hanging.exists())
        code = main(
            [
                "compare", str(office), "--out", str(folder / "out"),
                "--methods", ",".join(["plicp", *names, "svd"]),
                "--settings", str(toml(folder / "bad.toml", settings)),
                "--time-limit", "20", "--memory-limit", "1",
            ]
        )  # fmt: skip
    return code, folder / "out"


def test_every_bad_method_is_a_row_that_says_how_it_ended(bad):
    table = read_table(bad[1])
    for name, status, reason in (
        ("raises", Status.CRASHED, "at scan 10: ValueError: no more <b>patience</b>"),
        ("hangs", Status.TIMED_OUT, "at scan 10: took longer than --time-limit (20 s)"),
        ("eats", Status.OUT_OF_MEMORY, "at scan 10: took more than --memory-limit (1 GiB)"),
        ("dies", Status.CRASHED, "at scan 10: ended by SIGSEGV"),
        ("diesearly", Status.CRASHED, "while starting or warming up: ended by SIGSEGV"),
        ("losesitself", Status.CRASHED, "at scan 10: ValueError: a pose that is not finite"),
        (
            "spatial",
            Status.CRASHED,
            "at scan 0: ValueError: track returned an array of the shape (4, 4); wanted a pose (3, 3)",
        ),
    ):
        assert (row(table, name).status, row(table, name).reason) == (status, reason)
        assert row(table, name).figures["ate_m"] is None


def test_the_others_finish_and_the_exit_code_says_that_some_did_not(bad):
    code, folder = bad
    table = read_table(folder)
    assert code == 1
    for name in ("plicp", "svd"):
        assert row(table, name).status is Status.OK
        assert row(table, name).figures["ate_m"] < 0.05
    assert {"report.html", "compare.rrd", "table.csv", "table.md", "run.json"} <= {
        p.name for p in folder.iterdir()
    }


def test_what_one_did_until_it_failed_is_kept_scan_by_scan(bad):
    scans = pq.read_table(bad[1] / "per_scan.parquet").to_pandas()
    assert scans.groupby("method").size()["raises"] == 10
    assert scans.groupby("method").size()["plicp"] == 60


def test_children_of_a_method_end_with_it(office, tmp_path, monkeypatch):
    monkeypatch.setenv("SPAWNED_FILE", str(tmp_path / "spawned"))
    for name, status in (("Spawns", Status.OK), ("SpawnsAway", Status.OK), ("SpawnsAndDies", Status.CRASHED)):
        found = run(office, tmp_path / name, f"bad_odometries:{name}")
        assert [row.status for row in found.rows] == [status]
        spawned = int((tmp_path / "spawned").read_text())
        wait_until(lambda pid=spawned: not psutil.pid_exists(pid) or psutil.Process(pid).status() == "zombie")


def test_a_killed_comparison_leaves_neither_processes_nor_folders(office, tmp_path, monkeypatch):
    monkeypatch.setenv("HANGS_FILE", str(tmp_path / "hanging"))
    command = [sys.executable, "-m", "scanchain", "compare", str(office), "--out", str(tmp_path / "out" / "table")]
    child = subprocess.Popen(
        [*command, "--methods", "bad_odometries:Hangs"],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_until((tmp_path / "hanging").exists)
    assert len(processes_about(tmp_path)) == 2
    child.kill()
    child.wait()
    wait_until(lambda: not processes_about(tmp_path))
    assert not list((tmp_path / "out").iterdir())


def test_one_that_is_not_installed_is_a_gap_with_the_command_that_fills_it(office, tmp_path, monkeypatch):
    (tmp_path / "kiss_icp").mkdir()
    toml(tmp_path / "kiss_icp" / "__init__.py", "raise ImportError")
    monkeypatch.setenv("PYTHONPATH", str(tmp_path), prepend=":")
    table = run(office, tmp_path, "kiss-icp", "plicp", repeat=2)
    assert row(table, "kiss-icp").status is Status.MISSING
    assert "pip install 'scanchain[baselines]'" in row(table, "kiss-icp").reason
    assert row(table, "plicp").status is Status.OK
    assert "not installed" in text(table) and "pip install" in markdown(table)
    missing = row(table, "kiss-icp")
    lines = text(
        msgspec.structs.replace(table, rows=[*table.rows, msgspec.structs.replace(missing, name="genz-icp")])
    ).splitlines()
    (line,) = [each for each in lines if "-icp" in each]
    assert line == "not installed: kiss-icp, genz-icp; pip install 'scanchain[baselines]'"


def test_a_verdict_fails_nothing_and_a_method_that_did_not_finish_does(office, good, monkeypatch, capfd):
    table, folder = good
    doubted = msgspec.structs.replace(table.rows[0], verdict="not trustworthy", verdict_reason="most are lost")
    crashed = msgspec.structs.replace(table.rows[0], status=Status.CRASHED)
    for first, code in ((doubted, 0), (crashed, 1)):
        compared = Compared(folder, msgspec.structs.replace(table, rows=[first, *table.rows[1:]]))
        monkeypatch.setattr("scanchain.comparison.compare.compare", lambda *_, done=compared: done)
        assert main(["compare", str(office), "--out", str(folder)]) == code
    output = capfd.readouterr()
    assert output.err == "error: did not finish: plicp; see the table for the reason\n"
    assert "plicp: not trustworthy: most are lost" in output.out


def test_every_verdict_names_the_error_that_its_checks_resolve(good):
    table, _ = good
    ours = ("plicp", "svd+loops", "coarse")
    for each in table.rows:
        bounds = re.findall(r"ATE ([\d.]+) to ([\d.]+) m with 95 %", each.verdict_error)
        others = re.findall(r"ATE below ([\d.]+) m by (?:plicp|svd\+loops|coarse|wheels)", each.verdict_error)
        assert (len(bounds), len(others)) == ((1, 0) if each.name in ours else (0, 1)), each.verdict_error
        if each.name in ours and each.verdict == "trustworthy":
            assert each.vouched == f"trustworthy, {each.verdict_error}"
            assert each.vouched in text(table) and each.vouched in markdown(table)
        elif each.name not in ours:
            assert each.figures["ate_m"] < 1.05 * float(others[0])


def test_where_all_fail_the_tables_still_say_how(office, tmp_path):
    table = run(office, tmp_path, "a", "b", config_file=toml(
        tmp_path / "a.toml", "".join(f'[{name}]\nmethod = "bad_odometries:Raises"\n' for name in "ab")
    ))  # fmt: skip
    assert text(table).count("at scan 10: ValueError") == markdown(table).count("at scan 10: ValueError") == 2


def test_one_that_failed_is_best_at_nothing():
    made = Provenance(True, "", [], "", 0.0, [], "", "", "", 2, {})
    rows = [
        Row(name, name, status, "", "", {}, {"peak_mib": mib, "ate_m": mib}, [])
        for name, status, mib in (("a", Status.OK, 30.0), ("b", Status.CRASHED, 1.0), ("c", Status.OK, 20.0))
    ]
    table = Table("log", "/scan", 2, 60, 180.0, 1, "truth", "", rows, [], [], made, {})
    assert "| c | **20.0** | **20** |" in markdown(table) and "1.0" not in text(table)


def test_a_run_that_compiled_kernels_is_run_anew(monkeypatch, tmp_path):
    ran, blank = [], np.zeros(2)

    def fake(method, scans, folder, limits):
        ran.append(folder.name)
        report = EndReport(Status.OK, "", has_compiled=len(ran) == 1)
        return Outcome(
            report, blank, Trajectory([0, 1], np.tile(np.eye(3), (2, 1, 1))), blank + len(ran), blank, folder
        )

    monkeypatch.setattr("scanchain.comparison.processes._run", fake)
    methods = resolve(("plicp",), 2, file=None)
    outcomes = run_all(methods, None, tmp_path, repeat=2, limits=Limits(1.0, 1.0), progress=Progress())
    assert len(ran) == len(set(ran)) == 3
    assert [outcome.seconds[0] for outcome in outcomes["plicp"]] == [2.0, 3.0]


# the same scans for all


def test_a_word_stands_for_the_methods_that_begin_with_it_and_a_wrong_one_names_those_near():
    def named(words, dimension):
        return [method.name for method in resolve(words, dimension, file=None)]

    assert named(["plicp", "KISS", "open3d"], 2) == ["plicp", "kiss-icp", "open3d-p2p", "open3d-gicp"]
    assert named(["open3d", "kiss_icp"], 3) == ["open3d-p2p", "open3d-p2l", "open3d-gicp", "kiss-icp"]
    assert named(["genz"], 3) == ["genz-icp"] and named(["plicp+loops"], 3) == ["plicp+loops"]
    refused(["gicp"], 3, match=r"no method 'gicp'; choose among open3d-gicp, small-gicp, small-vgicp, or")
    refused(["open3d", "open3d-p2p"], 3, match="names one twice")


def test_sections_of_the_configuration_hold_for_all_of_ours_as_in_a_run(office, tmp_path):
    file = toml(
        tmp_path / "a.toml",
        """
        [log]
        every = 3
        [matching]
        max_iterations = 7
        matcher = "svd"
        [svd.matching]
        max_iterations = 9
        """,
    )
    table = run(office, tmp_path, "plicp", "svd", config_file=file)
    assert table.scans == -(-len(list(open_log(office).scans())) // 3)
    assert [each.settings["matching"]["max_iterations"] for each in table.rows] == [7, 9]
    assert [each.settings["matching"]["matcher"] for each in table.rows] == ["plicp", "svd"]


def test_every_method_is_a_line_on_a_pipe_as_it_ends(office, tmp_path, capfd):
    assert (
        main(["compare", str(office), "--methods", "plicp,svd", "--end", "2", "--out", str(tmp_path / "a")]) == 0
    )
    lines = capfd.readouterr().err.splitlines()
    assert [line.split(" in ")[0] for line in lines if " in " in line] == ["plicp: 20 scans", "svd: 20 scans"]


class StopsAtOnce(Progress):
    stopped = True

    def track(self, scans, count):
        return itertools.islice(scans, 5)


def test_a_reading_that_the_user_stopped_is_told(office, tmp_path):
    settings = toml(tmp_path / "a.toml", '[mine]\nmethod = "bad_odometries:Shifted"\n')
    comparison = Comparison(logs=(office,), out=tmp_path / "out", methods=("mine",), config_file=settings)
    table = compare(comparison, lambda _: None, StopsAtOnce()).table
    assert table.scans == 5 and "the user stopped the reading: 5 scans compared" in text(table)


def test_stored_scans_are_the_decoded_ones_bit_by_bit(office, tmp_path):
    log = open_log(office)
    stored = store(log.scans(), log.T_base_lidar, tmp_path)
    for scan, again in zip(log.scans(), stored.scans(), strict=True):
        assert (scan.index, scan.stamp_ns, scan.log_time_ns, scan.dropped) == (
            again.index, again.stamp_ns, again.log_time_ns, again.dropped,
        )  # fmt: skip
        np.testing.assert_array_equal(scan.points, again.points)
        np.testing.assert_array_equal(scan.times_s, again.times_s)
        np.testing.assert_array_equal(scan.T_odom_base, again.T_odom_base)
        assert again.points.dtype == np.float32 and again.points.flags.c_contiguous


def test_stored_clouds_keep_the_times_of_their_points(tmp_path):
    simulate("town", tmp_path / "town.mcap", duration_s=0.3, sensor="vlp-16")
    log = open_log(tmp_path / "town.mcap")
    (tmp_path / "store").mkdir()
    stored = list(store(log.scans(), log.T_base_lidar, tmp_path / "store").scans())
    for scan, again in zip(log.scans(), stored, strict=True):
        assert len(again.times_s) == len(again.points) > 1000
        np.testing.assert_array_equal(scan.times_s, again.times_s)
        np.testing.assert_array_equal(scan.points, again.points)


def test_ours_is_our_odometry_to_the_last_bit(office, good):
    log = open_log(office)
    odometry = Odometry(
        load_settings(2, overrides=(Override("odometry.prior", "constant-velocity", ""),)).config, log.T_base_lidar
    )
    poses = np.array([odometry.process(scan).T_odom_lidar for scan in log.scans()])
    scans = pq.read_table(good[1] / "per_scan.parquet").to_pandas()
    ours = scans[(scans.method == "plicp") & (scans.repeat == 1)]
    np.testing.assert_array_equal(ours[["x", "y"]], poses[:, :2, 2])


def test_runs_of_the_same_method_are_compared_with_each_other(good):
    *steady, unsteady = [each.figures["repeats_apart_m"] for each in good[0].rows]
    assert steady == [0.0] * 4 and unsteady > 0.01
    scans = pq.read_table(good[1] / "per_scan.parquet")
    assert set(scans["repeat"].to_pylist()) == {0, 1} and len(scans) == 2 * 5 * 60


def test_every_run_of_a_method_is_judged_by_its_own_poses(office, good):
    truth = read_tum(office.with_suffix(".tum")).poses[:, :3, 3]
    scans = pq.read_table(good[1] / "per_scan.parquet").to_pandas()
    for repeat in (0, 1):
        rows = scans[(scans.method == "unsteady") & (scans.repeat == repeat)]
        aligned = rows[["aligned_x", "aligned_y", "aligned_z"]].to_numpy()
        np.testing.assert_allclose(rows.error_m, np.linalg.norm(aligned - truth, axis=1), atol=1e-6)


def test_methods_for_clouds_follow_planar_scans_in_the_plane(office, tmp_path):
    table = run(office, tmp_path, *[name for name in default_names(2) if name not in OURS])
    began = [each for each in table.rows if each.status is not Status.MISSING]
    if not began:
        pytest.skip(table.rows[0].reason)
    assert all(each.status is Status.OK and each.figures["ate_m"] < 0.1 for each in began), text(table)
    scans = pq.read_table(tmp_path / "out" / "per_scan.parquet")
    assert len(scans) == 60 * len(began) and not any(scans["z"].to_numpy())


# settings


def test_a_table_of_settings_sets_a_method_or_makes_a_variant_of_it(good):
    table, _ = good
    assert "voxels of 0.1 m" in row(table, "plicp").description
    assert "voxels of 0.4 m" in row(table, "coarse").description
    assert row(table, "mine").description == "moves 0.25 m a scan"
    assert row(table, "plicp").figures["ate_m"] != row(table, "coarse").figures["ate_m"]


def test_written_settings_can_be_given_back(good):
    table, folder = good
    again = resolve([each.name for each in table.rows], 2, file=folder / "settings.toml")
    for method, each in zip(again, table.rows, strict=True):
        assert (method.name, method.base) == (each.name, each.base)
        assert method.settings == each.settings


def test_what_does_not_exist_is_refused_by_name(tmp_path):
    refused(("plicp", "icp"), 3, match=r"no method 'icp'; choose among plicp, plicp\+loops, open3d-gicp")
    refused(("genz-icp",), 2, match="made for 3D")
    refused(("plicp", "open3d-p2l"), 2, match="open3d-p2l is made for 3D")
    refused(("plicp", "plicp"), 3, match="twice")
    kiss = toml(tmp_path / "a.toml", "[kiss-icp]\nvoxel_size = 0.5\n")
    refused(("kiss-icp",), 3, kiss, match=r"a\.toml: \[kiss-icp\].*voxel_size.*voxel_size_m")
    negative = toml(tmp_path / "b.toml", "[kiss-icp]\nvoxel_size_m = -1.0\n")
    refused(("kiss-icp",), 3, negative, match=r"\[kiss-icp\]")
    ours = toml(tmp_path / "c.toml", "[plicp.matching]\nmax_distnce_m = 0.5\n")
    refused(("plicp",), 3, ours, match=r"c\.toml: \[plicp\].*did you mean matching\.max_distance_m")
    refused(("svd",), 3, ours, match=r"\[plicp\] is not among the methods")
    refused(("plicp",), 3, toml(tmp_path / "d.toml", "plicp = 1\n"), match="is no table")
    refused(("plicp",), 3, tmp_path / "absent.toml", match="absent.toml")
    refused(
        ("plicp",), 3, toml(tmp_path / "e.toml", '[plicp]\nmethod = ["svd"]\n'), match=r"no method \"\['svd'\]\""
    )
    refused(("..",), 3, toml(tmp_path / "f.toml", '[".."]\nmethod = "svd"\n'), match="folder")


def test_what_a_method_is_and_what_all_share_cannot_be_set_for_it(tmp_path):
    svd = toml(tmp_path / "a.toml", '[plicp]\nmatching.matcher = "svd"\n')
    refused(("plicp",), 3, svd, match=r"a\.toml: \[plicp\] matching\.matcher is svd, but plicp has plicp")
    shared = toml(tmp_path / "b.toml", "[plicp]\nlog.end_s = 3.0\n")
    refused(("plicp",), 3, shared, match="holds for all methods; give it as log__end_s")
    with pytest.raises(InputError, match="choose by methods"):
        resolve(("plicp",), 3, file=None, overrides=[Override("loops.enabled", "true", "--loops.enabled")])


def test_methods_of_like_names_have_folders_of_their_own(tmp_path):
    names = ("a/b", "a_b", "a b", "<script>", "plicp+loops")
    folders = [method_folder(tmp_path, name) for name in names]
    assert len({folder.name for folder in folders}) == len(names)
    assert all(folder.parent == tmp_path / "methods" for folder in folders)


# what errors are against


def test_errors_are_those_of_evaluate_against_the_log_a_tum_or_a_kitti_file(office, tmp_path):
    truth = read_tum(office.with_suffix(".tum"))
    write_kitti(tmp_path / "truth.txt", truth)
    references = (None, office.with_suffix(".tum"), tmp_path / "truth.txt")
    for number, reference in enumerate(references):
        folder = tmp_path / str(number)
        folder.mkdir()
        settings = toml(folder / "a.toml", '[mine]\nmethod = "bad_odometries:Shifted"\n')
        figures = run(office, folder, "mine", ground_truth=reference, config_file=settings).rows[0].figures
        estimate = read_tum(folder / "out" / "methods" / "mine" / "trajectory.tum")
        assert figures["ate_m"] == pytest.approx(
            absolute_error(pair(estimate, truth)).translation_m.rmse, abs=1e-8
        )
        assert figures["paired_share"] == 1.0


def test_scans_without_truth_are_counted_in_a_note_and_a_column(office, tmp_path):
    truth = read_tum(office.with_suffix(".tum"))
    write_tum(tmp_path / "part.tum", Trajectory(truth.stamps_ns[6:-9:3], truth.poses[6:-9:3]))
    settings = toml(tmp_path / "a.toml", '[mine]\nmethod = "bad_odometries:Shifted"\n')
    table = run(office, tmp_path, "mine", ground_truth=tmp_path / "part.tum", config_file=settings)
    known = len(truth.stamps_ns[6:-9:3]) * 3 - 2
    assert table.rows[0].figures["paired_share"] == pytest.approx(known / 60)
    missing = (
        f"Of 60 scans {60 - known} without a true pose: 6 before the truth begins, {54 - known} after it ends"
    )
    assert missing in table.against and missing in text(table)


def test_a_truth_that_does_not_fit_is_refused_before_anything_runs(office, tmp_path):
    truth = read_tum(office.with_suffix(".tum"))
    write_kitti(tmp_path / "short.txt", Trajectory(truth.stamps_ns[:-1], truth.poses[:-1]))
    with pytest.raises(InputError, match="59 lines for 60 scans"):
        run(office, tmp_path, "plicp", ground_truth=tmp_path / "short.txt")
    toml(tmp_path / "old.tum", "1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    with pytest.raises(InputError, match="same clock"):
        run(office, tmp_path, "plicp", ground_truth=tmp_path / "old.tum")
    toml(tmp_path / "a.relations", "1.0 2.0 0 0 0 0 0 0\n")
    with pytest.raises(InputError, match="belong to this log"):
        run(office, tmp_path, "plicp", relations=tmp_path / "a.relations")
    assert not (tmp_path / "out").exists()


def test_a_topic_of_true_poses_that_is_named_must_be_there(tmp_path):
    named = Override("log.ground_truth_topic", "/ground_truth", "--gt")
    with pytest.raises(InputError, match="no poses on /ground_truth"):
        run(
            shared_data("3d/kitti_0005_first60.mcap"), tmp_path, "plicp",
            overrides=(named, Override("log.end_s", "0.5", "")),
        )  # fmt: skip


def test_without_truth_there_is_sharpness_and_disagreement_and_it_is_said_that_they_are_none(tmp_path):
    log = shared_data("3d/kitti_0005_first60.mcap")
    table = run(log, tmp_path, "plicp", "svd", "mine", overrides=(Override("log.end_s", "1.6", ""),),
        config_file=toml(tmp_path / "a.toml", '[mine]\nmethod = "bad_odometries:StandsStill"\n'))  # fmt: skip
    assert table.truth == "" and all(each.figures["ate_m"] is None for each in table.rows)
    sharp = [row(table, name).figures for name in ("plicp", "mine")]
    assert sharp[1]["thickness_m"] is None or sharp[0]["thickness_m"] < sharp[1]["thickness_m"]
    assert row(table, "mine").figures["disagreement_m"] > 10.0 * table.disagreement_m[0][1]
    assert "no ground truth" in text(table)


# figures


def test_the_best_of_a_column_is_marked_as_it_is_shown():
    ate = next(column for column in COLUMNS if column.key == "ate_m")
    nees = next(column for column in COLUMNS if column.key == "nees")
    rows = [{"ate_m": 0.12341, "nees": 0.5}, {"ate_m": 0.12339, "nees": 1.2}, {"ate_m": 0.2}, {}]

    def best(column, rows):
        return [cell.is_best for cell in column.cells(rows)]

    assert best(ate, rows) == [True, True, False, False]
    assert best(nees, rows) == [False] * 4  # a bad method may have exact covariances
    assert best(ate, rows[2:]) == [False, False]
    assert best(ate, rows[:2]) == [False, False]


def test_a_column_has_the_digits_that_its_smallest_figure_needs():
    time = next(column for column in COLUMNS if column.key == "median_s")
    for seconds, texts in (
        ((0.23456, 2.9871), ["235", "2987"]),
        ((0.031234, 0.23456), ["31.2", "234.6"]),
        ((0.000212, 0.031234), ["0.21", "31.23"]),
        ((0.0, None), ["0.00", "–"]),
    ):
        assert [cell.text for cell in time.cells([{"median_s": each} for each in seconds])] == texts


def test_the_tables_say_the_same(good):
    table, folder = good
    said = json.loads((folder / "table.json").read_text())
    with (folder / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    for place, each in enumerate(table.rows):
        assert said["rows"][place]["figures"]["ate_m"] == float(rows[place]["ate_m"]) == each.figures["ate_m"]
        for words in ((folder / "table.md").read_text(), text(table)):
            assert f"{each.figures['ate_m']:.4f}" in words
    scans = pq.read_table(folder / "per_scan.parquet").to_pandas()
    ours = scans[scans.method == "plicp"]
    assert row(table, "plicp").figures["median_s"] == pytest.approx(ours[ours["index"] > 0].seconds.median())
    assert row(table, "plicp").figures["ate_m"] == pytest.approx(np.sqrt((ours.error_m**2).mean()))


def test_the_time_of_the_first_scan_stands_apart_and_stages_add_up(good):
    for name in ("plicp", "svd+loops"):
        figures = row(good[0], name).figures
        stages_s = figures["preprocess_s"] + figures["match_s"] + figures["map_s"]
        assert 0.3 * figures["median_s"] < stages_s < 1.2 * figures["median_s"]
        assert figures["first_s"] > 0.0 and figures["p95_s"] >= figures["median_s"]
        assert 50.0 < figures["peak_mib"] < 2000.0


def test_a_shaken_way_makes_a_duller_map(office):
    log = open_log(office)
    scans, truth = list(log.scans()), read_tum(office.with_suffix(".tum"))
    exact = Trajectory(truth.stamps_ns, lie.flatten(truth.poses))
    noise = np.random.default_rng(0).normal(scale=[0.03, 0.03, 0.01], size=(len(truth), 3))
    shaken = Trajectory(exact.stamps_ns, exact.poses @ lie.exp(noise))
    sharp, dull = sharpness([sampled_map(scans, way, 1) for way in (exact, shaken)])
    assert sharp.thickness_m < 0.7 * dull.thickness_m
    assert sharp.mean_map_entropy < dull.mean_map_entropy


def test_a_map_that_has_fallen_apart_spoils_no_other():
    wall = np.random.default_rng(0).uniform(size=(20_000, 3)) * [10.0, 0.05, 3.0]
    scattered = np.random.default_rng(1).uniform(-5e3, 5e3, (20_000, 3))
    alone, (beside, lost) = sharpness([wall]), sharpness([wall, scattered])
    assert lost is None and beside == alone[0]


def test_disagreement_is_the_distance_of_motions_not_of_positions():
    steps = np.tile(lie.exp(np.array([1.0, 0.0, 0.1])), (30, 1, 1))
    way = np.array([np.linalg.matrix_power(steps[0], k) for k in range(30)])
    turned = lie.exp(np.array([5.0, 2.0, 1.0])) @ way
    longer = np.array([np.linalg.matrix_power(lie.exp(np.array([1.01, 0.0, 0.1])), k) for k in range(30)])
    apart_m = disagreement([way, turned, longer, way[:0]])
    assert apart_m[0, 1] == pytest.approx(0.0, abs=1e-12)
    assert apart_m[0, 2] == pytest.approx(0.01, rel=0.01)
    assert np.isnan(apart_m[3]).all() and np.isnan(apart_m[:, 3]).all()


@pytest.mark.parametrize("k", [3, 6])
def test_errors_drawn_from_the_covariances_have_a_nees_of_one(k):
    rng = np.random.default_rng(k)
    count = 4000
    truth = lie.exp(rng.normal(scale=0.3, size=(count, k)))
    roots = 0.01 * rng.normal(size=(count, k, k))
    covariances = roots @ np.swapaxes(roots, 1, 2) + 1e-6 * np.eye(k)
    errors = np.einsum("nij,nj->ni", np.linalg.cholesky(covariances), rng.normal(size=(count, k)))
    nees = motion_nees(truth @ lie.exp(errors), covariances, truth)
    assert nees.mean() == pytest.approx(1.0, abs=0.06)
    twice = motion_nees(truth @ lie.exp(errors), 4.0 * covariances, truth)
    np.testing.assert_allclose(twice, 0.25 * nees)
    covariances[7] = np.nan
    assert np.flatnonzero(np.isnan(motion_nees(truth, covariances, truth))).tolist() == [6, 7]
