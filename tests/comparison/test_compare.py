"""A comparison: the same scans for all, one bad method never touches another, figures that can be checked."""

import csv
import itertools
import json
import pickle
import re
import subprocess
import sys
from html import unescape

import msgspec
import numpy as np
import psutil
import pyarrow.parquet as pq
import pytest

from scanchain import lie
from scanchain.__main__ import main
from scanchain.comparison import processes, worker
from scanchain.comparison.compare import Compared, compare
from scanchain.comparison.methods import OURS, default_names, resolve
from scanchain.comparison.processes import Status, StoredScans, store
from scanchain.comparison.results import method_folder
from scanchain.comparison.table import COLUMNS, Row, Table, markdown, read_table, text
from scanchain.data import Trajectory
from scanchain.errors import InputError
from scanchain.evaluation import absolute_error, pair, path_length
from scanchain.logs import open_log
from scanchain.odometry import Odometry
from scanchain.runs.job import Progress
from scanchain.runs.provenance import Provenance
from scanchain.settings import Override, load_settings
from scanchain.trajectory import read_tum, write_kitti, write_tum
from tests.support import made
from tests.support.in_process import SUPPORT, here
from tests.support.killing import processes_about, wait_until
from tests.support.messages import says, unfolded
from tests.support.scenes import ROOT, shared_data


@pytest.fixture(scope="module")
def office():
    """Six seconds in the simulated office, 60 scans, with the truth in the log and beside it."""
    return made.log("office", seconds=6)


@pytest.fixture(scope="module", autouse=True)
def few_queries():
    """Sharpness at fewer points than is fair, since every comparison measures it."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("scanchain.evaluation.consistency.MAX_QUERIES", 500)
        yield


@pytest.fixture
def in_process(monkeypatch):
    here(monkeypatch)


@pytest.fixture
def own_processes(monkeypatch):
    monkeypatch.setenv("PYTHONPATH", f"{SUPPORT}:{ROOT}", prepend=":")


def toml(path, text_):
    path.write_text(text_)
    return path


def bad(path, *natures):
    """Settings of methods named after the nature of a bad odometry, which may write a file beside them."""
    of_all = f'method = "bad_odometries:Bad"\nfile = "{path.with_suffix(".said")}"\n'
    return toml(path, "".join(f'[{nature}]\nnature = "{nature}"\n{of_all}' for nature in natures))


def run(office, folder, *methods, progress=None, **changes):
    """The table of a comparison without report and recording."""
    return compare(
        (office,), folder / "out", lambda _: None, progress or Progress(), methods=methods, **changes
    ).table


def row(table, name):
    return next(each for each in table.rows if each.name == name)


class Announced(Progress):
    def __init__(self):
        self.lines = []

    def announce(self, line):
        self.lines.append(line)


GOOD = """
    [coarse]
    method = "plicp"
    local_map.voxel_size_m = 0.4
    [mine]
    method = "bad_odometries:Shifted"
    step_m = 0.25
    [unsteady]
    method = "bad_odometries:Bad"
    nature = "is-unsteady"
"""


@pytest.fixture(scope="module")
def good(office, tmp_path_factory):
    """Two runs each of five methods that come to their end: the table and its directory."""
    folder, progress = tmp_path_factory.mktemp("good"), Announced()
    names, file = ("plicp", "svd+loops", "coarse", "mine", "unsteady"), toml(folder / "good.toml", GOOD)
    with pytest.MonkeyPatch.context() as patch:
        here(patch)
        table = run(office, folder, *names, repeat=2, config_file=file, progress=progress)
    lines = [line.split(" in ")[0] for line in progress.lines if " in " in line]
    assert lines[:3] == ["plicp 1/2: 60 scans", "svd+loops 1/2: 60 scans", "coarse 1/2: 60 scans"]
    return table, folder / "out"


# one that is bad


@pytest.mark.usefixtures("own_processes")
def test_one_that_hangs_or_kills_its_process_is_a_row_that_says_how_it_ended_and_the_others_finish(
    office, tmp_path, monkeypatch
):
    """The clock of the time limit stands still until one hangs, so that a slow machine ends no other."""
    hanging, folder = tmp_path / "bad.said", tmp_path / "out"
    settings = bad(tmp_path / "bad.toml", "hangs", "eats", "dies", "dies-early")
    monkeypatch.setattr("scanchain.processes.monotonic", lambda: 1000.0 * hanging.exists())
    words = ["--methods", "hangs,eats,plicp,dies,dies-early", "--time-limit", "20", "--memory-limit", "1"]
    code = main(["compare", str(office), "--out", str(folder), "--settings", str(settings), *words])
    table = read_table(folder)
    for name, status, reason in (
        ("hangs", Status.TIMED_OUT, "at scan 10: took longer than --time-limit (20 s)"),
        ("eats", Status.OUT_OF_MEMORY, "at scan 10: took more than --memory-limit (1 GiB)"),
        ("dies", Status.CRASHED, "at scan 10: ended by SIGSEGV"),
        ("dies-early", Status.CRASHED, "while starting or warming up: ended by SIGSEGV"),
    ):
        assert (row(table, name).status, row(table, name).reason) == (status, reason)
        assert row(table, name).figures["ate_m"] is None
    assert code == 1 and row(table, "plicp").status is Status.OK and row(table, "plicp").figures["ate_m"] < 0.05
    assert 50.0 < row(table, "plicp").figures["peak_mib"] < 2000.0
    written = {path.name for path in folder.iterdir()}
    assert {"report.html", "compare.rrd", "table.csv", "table.md", "run.json"} <= written
    scans = pq.read_table(folder / "per_scan.parquet").to_pandas().groupby("method")
    assert dict(scans.size()) == {"hangs": 10, "eats": 10, "plicp": 60, "dies": 10}
    begin = read_tum(office.with_suffix(".tum")).poses[0, :2, 3]
    np.testing.assert_allclose(scans.get_group("dies")[["aligned_x", "aligned_y"]].iloc[0], begin, atol=1e-6)


@pytest.mark.usefixtures("in_process")
def test_where_all_fail_the_tables_still_say_how(office, tmp_path):
    natures = ("raises", "is-lost", "is-spatial")
    table = run(office, tmp_path, *natures, config_file=bad(tmp_path / "a.toml", *natures))
    for each, reason in zip(
        table.rows,
        (
            "at scan 10: ValueError: no more <b>patience</b>",
            "at scan 10: ValueError: a pose that is not finite",
            "at scan 0: ValueError: it returned an array of the shape (4, 4); wanted a pose (3, 3)",
        ),
        strict=True,
    ):
        assert (each.status, each.reason) == (Status.CRASHED, reason)
        assert unfolded(text(table)).count(reason) == markdown(table).count(reason) == 1
    assert "best of its column" not in text(table)


@pytest.mark.usefixtures("own_processes")
def test_children_of_a_method_end_with_it(office, tmp_path):
    natures = ("spawns", "spawns-away", "spawns-and-dies")
    table = run(office, tmp_path, *natures, config_file=bad(tmp_path / "a.toml", *natures))
    assert [row.status for row in table.rows] == [Status.OK, Status.OK, Status.CRASHED]
    pids = [int(line) for line in (tmp_path / "a.said").read_text().splitlines()]
    assert len(pids) == 3
    for spawned in pids:
        wait_until(lambda pid=spawned: not psutil.pid_exists(pid) or psutil.Process(pid).status() == "zombie")


@pytest.mark.usefixtures("own_processes")
def test_a_killed_comparison_leaves_neither_processes_nor_folders(office, tmp_path):
    command = [sys.executable, "-m", "scanchain", "compare", str(office), "--out", str(tmp_path / "out" / "table")]
    child = subprocess.Popen(
        [*command, "--methods", "hangs", "--config", str(bad(tmp_path / "a.toml", "hangs"))],
        cwd=ROOT,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
    )
    wait_until((tmp_path / "a.said").exists)
    assert len(processes_about(tmp_path)) == 2
    child.kill()
    child.wait()
    wait_until(lambda: not processes_about(tmp_path))
    assert not list((tmp_path / "out").iterdir())


@pytest.mark.usefixtures("in_process")
def test_one_that_is_not_installed_is_a_gap_with_the_command_that_fills_it(office, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "kiss_icp.config.parser", None)
    progress = Announced()
    table = run(office, tmp_path, "kiss-icp", "mine", repeat=2, progress=progress,
        config_file=toml(tmp_path / "a.toml", '[mine]\nmethod = "bad_odometries:Shifted"\n'))  # fmt: skip
    missing = row(table, "kiss-icp")
    assert missing.status is Status.MISSING and row(table, "mine").status is Status.OK
    says(missing.reason, "pip install 'scanchain[baselines]'")
    says(markdown(table), "pip install")
    assert sum(line.startswith("kiss-icp") for line in progress.lines) == 1
    two = msgspec.structs.replace(table, rows=[*table.rows, msgspec.structs.replace(missing, name="genz-icp")])
    (line,) = [each for each in text(two).splitlines() if "-icp" in each]
    assert line == "not installed: kiss-icp, genz-icp; pip install 'scanchain[baselines]'"


@pytest.mark.usefixtures("in_process")
def test_poses_that_a_method_optimizes_after_the_last_scan_are_its_trajectory(office, tmp_path):
    settings = toml(tmp_path / "a.toml", '[optimized]\nmethod = "bad_odometries:Doubled"\n')
    table = run(office, tmp_path, "optimized", config_file=settings)
    x = read_tum(method_folder(tmp_path / "out", "optimized") / "trajectory.tum").positions
    assert row(table, "optimized").status is Status.OK and len(x) == 60
    assert np.linalg.norm(x[-1] - x[0]) == pytest.approx(0.2 * 59, abs=1e-6)


@pytest.mark.usefixtures("own_processes")
def test_kiss_slam_is_measured_by_its_optimized_trajectory_over_several_local_maps(tmp_path):
    pytest.importorskip("kiss_slam", reason="kiss-slam is not installed; pip install 'scanchain[slam]'")
    log = made.log("town", seconds=5, sensor="vlp-16")
    settings = toml(tmp_path / "a.toml", "[kiss-slam]\nlocal_map_m = 4.0\n")
    table = run(log, tmp_path, "kiss-slam", "kiss-icp", config_file=settings)
    slam = row(table, "kiss-slam")
    says(slam.description, "local maps of 4 m")
    assert slam.status is Status.OK, slam.reason
    trajectories = [method_folder(tmp_path / "out", name) / "trajectory.tum" for name in ("kiss-slam", "kiss-icp")]
    optimized, odometry = (read_tum(path) for path in trajectories)
    assert len(optimized) == len(odometry) == 50 and path_length(odometry.poses)[-1] > 12.0
    assert 0.0 < np.abs(optimized.poses - odometry.poses).max() < 0.3
    assert slam.figures["ate_m"] < 0.2


def test_a_verdict_fails_nothing_and_a_method_that_did_not_finish_does(office, good, monkeypatch, capfd):
    table, folder = good
    doubted = msgspec.structs.replace(table.rows[0], verdict="not trustworthy", verdict_reason="most are lost")
    crashed = msgspec.structs.replace(table.rows[0], status=Status.CRASHED)
    for first, code in ((doubted, 0), (crashed, 1)):
        compared = Compared(folder, msgspec.structs.replace(table, rows=[first, *table.rows[1:]]))
        monkeypatch.setattr("scanchain.comparison.compare.compare", lambda *_, done=compared, **__: done)
        assert main(["compare", str(office), "--out", str(folder)]) == code
    output = capfd.readouterr()
    assert output.err == "error: did not finish: plicp; see the table for the reason\n"
    says(output.out, "plicp: not trustworthy: most are lost")


def test_every_verdict_names_the_error_that_its_checks_resolve(good):
    table, _ = good
    ours = ("plicp", "svd+loops", "coarse")
    for each in table.rows:
        bounds = re.findall(r"ATE ([\d.]+) to ([\d.]+) m", each.verdict_error)
        others = re.findall(r"ATE below ([\d.]+) m by (?:plicp|svd\+loops|coarse|wheels)", each.verdict_error)
        assert (len(bounds), len(others)) == ((1, 0) if each.name in ours else (0, 1)), each.verdict_error
        if each.name in ours and each.verdict == "trustworthy":
            assert each.vouched == f"trustworthy, {each.verdict_error}"
            assert each.vouched in text(table) and each.vouched in markdown(table)
        elif each.name not in ours:
            assert each.figures["ate_m"] < 1.05 * float(others[0])


# the same scans for all


@pytest.mark.usefixtures("in_process")
def test_a_reading_that_the_user_stopped_is_told(office, tmp_path, monkeypatch):
    progress = Progress()
    monkeypatch.setattr(Progress, "stopped", True)
    monkeypatch.setattr(Progress, "track", lambda _, scans, count: itertools.islice(scans, 5))
    table = run(office, tmp_path, "bad_odometries:Shifted", progress=progress)
    assert table.scans == 5
    says(text(table), "the user stopped the reading: 5 scans compared")


@pytest.mark.parametrize("log", [("office", {"seconds": 6}), ("town", {"seconds": 0.3, "sensor": "vlp-16"})])
def test_stored_scans_are_the_decoded_ones_bit_by_bit(log, tmp_path):
    log = open_log(made.log(log[0], **log[1]))
    stored = store(log.scans(), log.T_base_lidar, tmp_path / "scans")
    for scan, again in zip(log.scans(), stored.scans(), strict=True):
        for name in ("index", "stamp_ns", "log_time_ns", "dropped", "is_copy"):
            assert getattr(scan, name) == getattr(again, name)
        for name in ("points", "times_s", "T_odom_base"):
            np.testing.assert_array_equal(getattr(scan, name), getattr(again, name))
        assert again.points.dtype == np.float32 and again.points.flags.c_contiguous
    assert log.dimension == 2 or len(again.times_s) > 1000


def test_what_lies_in_the_directory_of_a_comparison_executes_nothing(tmp_path):
    class Touching:
        def __reduce__(self):
            return open, (str(tmp_path / "executed"), "w")

    task, scans = tmp_path / processes.TASK_FILE, tmp_path / "scans"
    for harm in (pickle.dumps(Touching()), pickle.dumps((Touching(), 1)), b"", b"\x00", bytes(100)):
        task.write_bytes(harm)
        with pytest.raises((msgspec.DecodeError, TypeError, ValueError)):
            worker.run(tmp_path)
        scans.write_bytes(len(harm).to_bytes(8, "little") + harm)
        one = np.zeros(1, np.int64)
        with pytest.raises((msgspec.DecodeError, TypeError, ValueError)):
            list(StoredScans(str(scans), one, one, one, np.eye(3)[None], np.eye(3)).scans())
    assert not (tmp_path / "executed").exists()


def test_ours_is_our_odometry_to_the_last_bit(office, good):
    log = open_log(office)
    odometry = Odometry(
        load_settings(2, overrides=(Override("odometry.prior", "constant-velocity", ""),)).config, log.T_base_lidar
    )
    poses = np.array([odometry.process(scan).T_odom_lidar for scan in log.scans()])
    scans = pq.read_table(good[1] / "per_scan.parquet").to_pandas()
    ours = scans[(scans.method == "plicp") & (scans.repeat == 1)]
    np.testing.assert_array_equal(ours[["x", "y"]], poses[:, :2, 2])


def test_every_run_of_a_method_is_judged_by_its_own_poses_and_compared_with_the_others(office, good):
    truth = read_tum(office.with_suffix(".tum")).poses[:, :3, 3]
    scans = pq.read_table(good[1] / "per_scan.parquet").to_pandas()
    assert len(scans) == 2 * 5 * 60
    for repeat in (0, 1):
        rows = scans[(scans.method == "unsteady") & (scans.repeat == repeat)]
        aligned = rows[["aligned_x", "aligned_y", "aligned_z"]].to_numpy()
        np.testing.assert_allclose(rows.error_m, np.linalg.norm(aligned - truth, axis=1), atol=1e-6)
    *steady, unsteady = [each.figures["repeats_apart_m"] for each in good[0].rows]
    assert steady == [0.0] * 4 and unsteady > 0.01


@pytest.mark.usefixtures("in_process")
def test_the_gyro_is_used_by_the_methods_that_name_the_imu_and_is_a_row_where_the_log_has_one(tmp_path):
    [own] = resolve(["SvdMatcher+imu"], 3, file=None, matcher="scanchain.registration.svd_icp:SvdMatcher")
    assert own.settings["odometry"]["imu"] and not own.settings["loops"]["enabled"]
    assert "plicp+imu" in default_names(3, has_imu=True) and "plicp+imu" not in default_names(3)
    log = made.log("turns", sensor="vlp-16", seconds=4.0, imu="mems")
    table = run(log, tmp_path, "plicp", "plicp+imu")
    without, with_imu = table.rows
    assert with_imu.figures["ate_m"] < 0.8 * without.figures["ate_m"]
    steps = pq.read_table(tmp_path / "out" / "per_scan.parquet").to_pandas()
    assert len(steps) == 80


@pytest.mark.usefixtures("in_process")
def test_a_baseline_is_given_the_samples_of_the_imu_before_each_scan(tmp_path):
    log = made.log("turns", sensor="vlp-16", seconds=4.0, imu="mems")
    settings = toml(tmp_path / "gyro.toml", '[gyro]\nmethod = "bad_odometries:Turned"\n')
    table = run(log, tmp_path, "gyro", "rko-lio", config_file=settings)
    rko_lio = table.rows[1]
    poses, true = (
        read_tum(path).poses
        for path in (method_folder(tmp_path / "out", "gyro") / "trajectory.tum", log.with_suffix(".tum"))
    )
    turned, really = lie.between(poses[0], poses[-1]), lie.between(true[0], true[len(poses) - 1])
    assert lie.apart(really, turned)[1] < np.radians(2.0) < lie.apart(really, np.eye(4))[1]
    assert "rko-lio" in default_names(3, has_imu=True) and "rko-lio" not in default_names(3)
    if rko_lio.status is Status.MISSING:
        pytest.skip(rko_lio.reason)
    assert rko_lio.status is Status.OK and rko_lio.figures["ate_m"] < 0.5, text(table)


@pytest.mark.usefixtures("in_process")
def test_rko_lio_says_that_a_log_has_no_imu(tmp_path):
    [only] = run(made.log("turns", sensor="vlp-16", seconds=4.0), tmp_path, "rko-lio").rows
    if only.status is Status.MISSING:
        pytest.skip(only.reason)
    assert only.status is Status.NOT_APPLICABLE
    says(only.reason, "needs an IMU, of which the log has no sample")


@pytest.mark.usefixtures("in_process")
def test_methods_for_clouds_follow_planar_scans_in_the_plane(office, tmp_path):
    names = [name for name in default_names(2) if name not in OURS]
    table = run(office, tmp_path, *names, overrides=(Override("log.end_s", "3.0", ""),))
    began = [each for each in table.rows if each.status is not Status.MISSING]
    if not began:
        pytest.skip(table.rows[0].reason)
    assert all(each.status is Status.OK and each.figures["ate_m"] < 0.1 for each in began), text(table)
    scans = pq.read_table(tmp_path / "out" / "per_scan.parquet")
    assert len(scans) == 30 * len(began) and not any(scans["z"].to_numpy())


@pytest.mark.usefixtures("in_process")
def test_a_method_for_clouds_alone_is_a_row_that_says_so_on_planar_scans(office, tmp_path):
    table = run(
        office,
        tmp_path,
        "genz-icp",
        "mine",
        config_file=toml(tmp_path / "good.toml", '[mine]\nmethod = "bad_odometries:Shifted"'),
    )
    genz, mine = table.rows
    assert (genz.status, genz.reason) == (Status.NOT_APPLICABLE, "is made for 3D clouds, and the log is 2D")
    assert mine.status is Status.OK and not Compared(tmp_path, table).failures
    assert unescape(Compared(tmp_path, table)._repr_html_()) == f"<pre>{text(table)}</pre>"
    assert "genz-icp: not applicable: is made for 3D clouds" in text(table)


# names and settings


def test_a_word_stands_for_the_methods_that_begin_with_it():
    for words, dimension, names in (
        (["plicp", "KISS", "open3d"], 2, ["plicp", "kiss-icp", "open3d-p2p", "open3d-gicp"]),
        (["open3d", "kiss_icp"], 3, ["open3d-p2p", "open3d-p2l", "open3d-gicp", "kiss-icp"]),
        (["genz"], 3, ["genz-icp"]),
        (["rko"], 3, ["rko-lio"]),
        (["plicp+loops"], 3, ["plicp+loops"]),
    ):
        assert [method.name for method in resolve(words, dimension, file=None)] == names


@pytest.mark.usefixtures("in_process")
def test_sections_of_the_configuration_hold_for_all_of_ours_as_in_a_run(office, tmp_path):
    shared = '[log]\nevery = 3\n[matching]\nmax_iterations = 7\nmatcher = "svd"\n'
    file = toml(tmp_path / "a.toml", f"{shared}[svd.matching]\nmax_iterations = 9\n")
    table = run(office, tmp_path, "plicp", "svd", config_file=file)
    assert table.scans == 20
    assert [each.settings["matching"]["max_iterations"] for each in table.rows] == [7, 9]
    assert [each.settings["matching"]["matcher"] for each in table.rows] == ["plicp", "svd"]


def test_a_table_of_settings_sets_a_method_or_makes_a_variant_of_it_and_can_be_given_back(good):
    table, folder = good
    says(row(table, "plicp").description, "voxels of 0.1 m")
    says(row(table, "coarse").description, "voxels of 0.4 m")
    assert row(table, "mine").description == "moves 0.25 m a scan"
    assert row(table, "plicp").figures["ate_m"] != row(table, "coarse").figures["ate_m"]
    again = resolve([each.name for each in table.rows], 2, file=folder / "settings.toml")
    for method, each in zip(again, table.rows, strict=True):
        assert (method.name, method.base, method.settings) == (each.name, each.base, each.settings)


@pytest.mark.parametrize(
    ("names", "dimension", "settings", "words"),
    [
        (["gicp"], 3, "", r"no method 'gicp'; choose among open3d-gicp, small-gicp, small-vgicp, or"),
        (["plicp", "icp"], 3, "", r"no method 'icp'; choose among plicp, plicp\+loops, plicp\+imu, open3d-gicp"),
        (["open3d", "open3d-p2p"], 3, "", "names one twice"),
        (["kiss-icp"], 3, "[kiss-icp]\nvoxel_size = 0.5", r"a\.toml: \[kiss-icp\].*voxel_size.*voxel_size_m"),
        (["kiss-icp"], 3, "[kiss-icp]\nvoxel_size_m = -1.0", r"\[kiss-icp\]"),
        (["plicp"], 3, "[plicp.matching]\nmax_distnce_m = 1", r"\[plicp\].*did you mean matching\.max_distance_m"),
        (["svd"], 3, "[plicp.matching]\nmax_iterations = 5", r"\[plicp\] is not among the methods"),
        (["plicp"], 3, "plicp = 1", "is no table"),
        (["plicp"], 3, None, r"a\.toml: .*No such file"),
        (["plicp"], 3, '[plicp]\nmethod = ["svd"]', r"no method \"\['svd'\]\""),
        ([".."], 3, '[".."]\nmethod = "svd"', "folder"),
        (["plicp"], 3, '[plicp]\nmatching.matcher = "svd"', r"\[plicp\] matching\.matcher is svd, but plicp has"),
        (["plicp"], 3, "[plicp]\nlog.end_s = 3.0", "holds for all methods; give it as log__end_s"),
    ],
)
def test_what_does_not_exist_or_is_not_a_methods_own_is_refused_by_name(
    names, dimension, settings, words, tmp_path
):
    if settings is not None:
        toml(tmp_path / "a.toml", settings)
    with pytest.raises(InputError, match=words):
        resolve(names, dimension, file=tmp_path / "a.toml")


def test_what_tells_ours_apart_is_no_key_for_all_of_them():
    with pytest.raises(InputError, match="choose by methods"):
        resolve(("plicp",), 3, file=None, overrides=[Override("loops.enabled", "true", "--loops.enabled")])


def test_methods_of_like_names_have_folders_of_their_own(tmp_path):
    names = ("a/b", "a_b", "a b", "<script>", "plicp+loops")
    folders = [method_folder(tmp_path, name) for name in names]
    assert len({folder.name for folder in folders}) == len(names)
    assert all(folder.parent == tmp_path / "methods" for folder in folders)


# what errors are against


@pytest.mark.usefixtures("in_process")
def test_errors_are_those_of_evaluate_against_the_log_a_tum_or_a_kitti_file_and_relations(office, tmp_path):
    truth = read_tum(office.with_suffix(".tum"))
    write_kitti(tmp_path / "truth.txt", truth)
    stamps = [f"{ns / 1e9:.6f}" for ns in truth.stamps_ns.tolist()]
    one = toml(tmp_path / "a.relations", f"{stamps[0]} {stamps[20]} 0.5 0 0 0 0 0\n")  # the method's own are 2 m
    for reference in (None, office.with_suffix(".tum"), tmp_path / "truth.txt"):
        truths = {"ground_truth": reference, "relations": one}
        table = run(office, tmp_path, "bad_odometries:Shifted", force=True, **truths)
        estimate = read_tum(method_folder(tmp_path / "out", table.rows[0].name) / "trajectory.tum")
        pairs = pair(estimate, truth)
        error_m = absolute_error(pairs.after_start).translation_m.rmse
        assert table.rows[0].figures["ate_m"] == pytest.approx(error_m, abs=1e-8)
        assert table.rows[0].figures["start_m"] == pytest.approx(pairs.start_error_m, abs=1e-8)
        assert table.rows[0].figures["paired_share"] == 1.0
        assert table.rows[0].figures["relations_m"] == pytest.approx(1.5, abs=1e-9)
        relations = pq.read_table(tmp_path / "out" / "per_relation.parquet").to_pylist()
        assert [(each["method"], each["relation"]) for each in relations] == [(table.rows[0].name, 0)]


@pytest.mark.usefixtures("in_process")
def test_an_error_bar_that_the_truth_refutes_is_not_trustworthy(office, tmp_path):
    truth = read_tum(office.with_suffix(".tum"))
    stretched = truth.poses.copy()
    stretched[:, :3, 3] *= 2.0
    write_tum(tmp_path / "wrong.tum", Trajectory(truth.stamps_ns, stretched))
    (row,) = run(office, tmp_path, "plicp", ground_truth=tmp_path / "wrong.tum").rows
    assert row.verdict == "check these segments" and row.verdict_error == ""
    assert row.verdict_reason.startswith("the ground truth refutes ATE 0.0")
    assert row.verdict_reason.endswith(f" m: ATE {row.figures['ate_m']:.4f} m")


@pytest.mark.usefixtures("in_process")
def test_scans_without_truth_are_counted_in_a_note_and_a_column(office, tmp_path):
    truth = read_tum(office.with_suffix(".tum"))
    write_tum(tmp_path / "part.tum", Trajectory(truth.stamps_ns[6:-9:3], truth.poses[6:-9:3]))
    table = run(office, tmp_path, "bad_odometries:Shifted", ground_truth=tmp_path / "part.tum")
    known = len(truth.stamps_ns[6:-9:3]) * 3 - 2
    assert table.rows[0].figures["paired_share"] == pytest.approx(known / 60)
    missing = (
        f"Of 60 scans {60 - known} without a true pose: 6 before the truth begins, {54 - known} after it ends"
    )
    assert missing in table.against and missing in unfolded(text(table))


def test_a_truth_that_does_not_fit_is_refused_before_anything_runs(office, tmp_path):
    truth = read_tum(office.with_suffix(".tum"))
    write_kitti(tmp_path / "short.txt", Trajectory(truth.stamps_ns[:-1], truth.poses[:-1]))
    old = toml(tmp_path / "old.tum", "1.0 0 0 0 0 0 0 1\n2.0 1 0 0 0 0 0 1\n")
    relations = toml(tmp_path / "a.relations", "1.0 2.0 0 0 0 0 0 0\n")
    kitti = shared_data("3d/kitti_0005_first60.mcap")
    named = (Override("log.ground_truth_topic", "/ground_truth", "--gt"), Override("log.end_s", "0.5", ""))
    for log, changes, words in (
        (office, {"ground_truth": tmp_path / "short.txt"}, "59 lines for 60 scans"),
        (office, {"ground_truth": old}, "same clock"),
        (office, {"relations": relations}, "belong to this log"),
        (kitti, {"overrides": named}, "no poses on /ground_truth"),
    ):
        with pytest.raises(InputError, match=words):
            run(log, tmp_path, "plicp", **changes)
    assert not (tmp_path / "out").exists()


@pytest.mark.usefixtures("in_process")
def test_without_truth_there_is_sharpness_and_disagreement_and_it_is_said_that_they_are_none(tmp_path):
    log, still = shared_data("3d/kitti_0005_first60.mcap"), "bad_odometries:Bad"
    table = run(log, tmp_path, "plicp", "svd", still, overrides=(Override("log.end_s", "1.6", ""),))
    assert table.truth == "" and all(each.figures["ate_m"] is None for each in table.rows)
    sharp = [row(table, name).figures for name in ("plicp", still)]
    assert sharp[1]["thickness_m"] is None or sharp[0]["thickness_m"] < sharp[1]["thickness_m"]
    assert row(table, still).figures["disagreement_m"] > 10.0 * table.disagreement_m[0][1]
    says(text(table), "no ground truth")


# figures


def test_the_best_of_a_column_is_marked_as_it_is_shown():
    ate, nees = (next(column for column in COLUMNS if column.key == key) for key in ("ate_m", "nees"))
    rows = [{"ate_m": 0.12341, "nees": 0.5}, {"ate_m": 0.12339, "nees": 1.2}, {"ate_m": 0.2}, {}]

    def best(column, rows):
        return [cell.is_best for cell in column.cells(rows)]

    assert best(ate, rows) == [True, True, False, False]
    assert best(nees, rows) == [False] * 4  # a bad method may have exact covariances
    assert best(ate, rows[2:]) == best(ate, rows[:2]) == [False, False]


def test_one_that_failed_is_best_at_nothing():
    made = Provenance(True, "", [], "", 0.0, [], "", "", "", 2, {})
    rows = [
        Row(name, name, status, "", "", {}, {"peak_mib": mib, "ate_m": mib}, [])
        for name, status, mib in (("a", Status.OK, 30.0), ("b", Status.CRASHED, 1.0), ("c", Status.OK, 20.0))
    ]
    table = Table("log", "/scan", 2, 60, 180.0, 1, "truth", "", rows, [], [], made, {})
    assert "| c | **20.0** | **20** |" in markdown(table) and "1.0" not in text(table)


def test_a_column_has_the_digits_that_its_smallest_figure_needs():
    time = next(column for column in COLUMNS if column.key == "median_s")
    for seconds, texts in (
        ((0.23456, 2.9871), ["235", "2987"]),
        ((0.031234, 0.23456), ["31.2", "234.6"]),
        ((0.000212, 0.031234), ["0.21", "31.23"]),
        ((0.0, None), ["0.00", "–"]),
    ):
        assert [cell.text for cell in time.cells([{"median_s": each} for each in seconds])] == texts


def test_the_tables_say_the_same_and_time_every_stage(good):
    table, folder = good
    said = json.loads((folder / "table.json").read_text())
    with (folder / "table.csv").open() as file:
        rows = list(csv.DictReader(file))
    for place, each in enumerate(table.rows):
        assert said["rows"][place]["figures"]["ate_m"] == float(rows[place]["ate_m"]) == each.figures["ate_m"]
        for words in ((folder / "table.md").read_text(), text(table)):
            assert f"{each.figures['ate_m']:.4f}" in words
    scans = pq.read_table(folder / "per_scan.parquet").to_pandas()
    ours = scans[(scans.method == "plicp") & (scans["index"] > 0)]
    assert row(table, "plicp").figures["median_s"] == pytest.approx(ours.seconds.median())
    assert row(table, "plicp").figures["ate_m"] == pytest.approx(np.sqrt((ours.error_m**2).mean()))

    assert row(table, "mine").figures["nees"] is None
    for name in ("plicp", "svd+loops"):
        figures = row(table, name).figures
        assert 0.1 < figures["nees"] < 10.0
        assert min(figures[stage] for stage in ("preprocess_s", "match_s", "map_s")) > 0.0
        assert figures["first_s"] > 0.0 and figures["p95_s"] >= figures["median_s"]
