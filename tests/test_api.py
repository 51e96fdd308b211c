"""What scripts call: arrays in, results out, without a log, a configuration or a command line."""

import ast
import subprocess
import sys
from html import unescape
from importlib.metadata import version
from itertools import islice

import numpy as np
import pytest

import scanchain as sc
from scanchain.errors import InputError
from tests.support.in_process import here
from tests.support.scenes import ROOT, configured, kitti_scans, shared_data


def test_odometry_of_arrays_is_that_of_the_log_bit_by_bit():
    scans = kitti_scans(6)
    of_log = sc.Odometry(configured(3), np.eye(4))
    live = sc.Odometry(dimension=3)
    for scan in scans:
        stamp_s = scan.stamp_ns * 1e-9
        again = scan.__class__.of(scan.points, stamp_s, scan.times_s, index=scan.index)
        tracked = live.process(sc.Scan.of(scan.points, stamp_s, scan.times_s))
        assert np.array_equal(tracked.T_odom_lidar, of_log.process(again).T_odom_lidar)
    assert tracked.T_odom_lidar[0, 3] > 5.0
    assert tracked.state is sc.State.OK


def test_a_log_is_opened_with_keys_of_its_section(office):
    log = sc.open_log(office, topic="/scan", end_s=1.05)
    assert log.topic == "/scan" and log.scan_count == 10
    assert sc.open_log(office, log.config, log__every=2).scan_count == 5
    for changes, words in (
        ({"topic": "/nowhere"}, "has no topic /nowhere"),
        ({"topics": "/scan"}, "log__topics is not a configuration key; did you mean log__topic"),
        ({"end_s": "soon"}, "log__end_s is 'soon'"),
    ):
        with pytest.raises(InputError, match=words):
            sc.open_log(office, **changes)
    with pytest.raises(InputError, match='a topic is chosen by topic="/points"'):
        sc.open_log(office, "/scan")


def test_a_log_has_a_length_and_scans_and_slam_gives_the_cloud_and_the_verdict_of_a_run(office, tmp_path):
    log = sc.open_log(office)
    slam = sc.Slam(sc.load_settings(2).config, log.T_base_lidar)
    steps = [slam.process(scan) for scan in log]
    result = slam.finish()
    assert len(steps) == len(log) == 60
    done = sc.run(office, tmp_path / "run", recording=False, outputs__mcap=True, outputs__error_bars="quick")
    written = {path.name for path in done.path.iterdir()}
    assert {"trajectory.tum", "report.html", "metrics.json", "results.mcap"} <= written
    assert "recording.rrd" not in written
    with pytest.raises(InputError, match=r"did you mean loops__drift\?"):
        sc.run(office, tmp_path / "again", loops__driff=0.1)
    assert sc.judge(result).sentence == done.metrics.sentence
    assert len(sc.cloud(result)) == done.metrics.map_points
    assert done.accuracy.ate_rmse_m == done.metrics.ground_truth.optimized.ate_rmse_m
    shown = done._repr_html_()  # in a notebook
    assert done.summary.splitlines()[0] in unescape(shown) and "<svg" in shown and "60 poses of SE(2)" in shown
    untrue = sc.run(office, tmp_path / "untrue", recording=False, log__ground_truth_topic="none")
    with pytest.raises(InputError, match="no ground truth; name a file by ground_truth"):
        untrue.accuracy  # noqa: B018
    found = sc.evaluate(result.trajectory, log.ground_truth())
    assert found.ate.translation_m.rmse == pytest.approx(done.accuracy.ate_rmse_m)
    of_run = sc.evaluate(done.path, log.ground_truth())
    assert of_run.ate.translation_m.rmse == pytest.approx(done.accuracy.ate_rmse_m, rel=1e-6)
    assert list(found.rpe) == ["1_pose", "1_s"] and found.rpe["1_s"].translation_m.rmse < 0.1
    with pytest.raises(InputError, match="KITTI metric: no segment of 10 m fits"):
        found.kitti  # noqa: B018
    for wrong, words in (((result, log), "estimate is"), ((result.trajectory, 3), "path is 3|truth is")):
        with pytest.raises(InputError, match=words):
            sc.evaluate(*wrong)
    records = [result, result.graph, result.state, result.keyframes[0], steps[9], steps[9].scan, steps[9].match]
    for record in (*records, log, done, found, found.ate, result.trajectory, sc.optimize(result.graph)):
        assert "\n" not in repr(record) and len(repr(record)) < 600, repr(record)
    assert repr(result.trajectory) == "Trajectory(60 poses of SE(2) over 5.9 s)"
    closures, keyframes = len(result.closures), len(result.keyframes)
    assert repr(slam) == f"Slam(60 2D scans, {keyframes} keyframes, {closures} closures tried)"
    assert repr(found).startswith(f"Results(ate rmse {found.ate.translation_m.rmse:.4f} m, rpe_1_pose rmse 0.0")
    assert repr(sc.Odometry(dimension=2)) == "Odometry(0 2D scans)"
    localizer = sc.Localizer(done.path)
    assert repr(localizer) == "Localizer(0 scans in 'run': searching)"
    placed = localizer.process(log[0])
    assert repr(localizer) == f"Localizer(1 scan in 'run': {placed.state})"


def test_errors_of_calls_name_arguments_of_the_call(office, tmp_path):
    (tmp_path / "taken").mkdir()
    for call, words in (
        (lambda: sc.run(office, tmp_path / "taken"), "choose another out or pass force=True to replace it$"),
        (lambda: sc.run(office, tmp_path / "x", log__topic="/nowhere"), "log__topic"),
        (lambda: sc.simulate("office", office), "choose another name or pass force=True"),
    ):
        with pytest.raises(InputError, match=words) as raised:
            call()
        assert "--" not in str(raised.value) and "--" in raised.value.text


def test_slam_of_arrays_places_every_scan():
    scans = list(islice(sc.open_log(shared_data("2d/mit_csail.mcap")).scans(), 120))
    slam = sc.Slam(dimension=2)
    steps = [slam.process(sc.Scan.of(scan.points, scan.stamp_ns * 1e-9)) for scan in scans]
    result = slam.finish()
    assert [step.scan.index for step in steps] == list(range(120))
    assert len(result.trajectory) == 120
    assert np.linalg.norm(result.trajectory.poses[-1][:2, 2]) > 1.0


def test_every_module_is_imported_where_there_is_no_posix():
    code = """
import importlib.util, os, pkgutil, psutil, sys  # that of Linux needs resource itself
sys.modules |= dict.fromkeys(("fcntl", "grp", "pwd", "resource", "termios"))
for name in ("geteuid", "getpgrp", "killpg", "getuid"):
    delattr(os, name)
for package in map(importlib.import_module, ("scanchain", "scanchain_viz")):
    for module in pkgutil.walk_packages(package.__path__, package.__name__ + "."):
        if module.name != "scanchain.evalio" or importlib.util.find_spec("evalio"):
            importlib.import_module(module.name)
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def test_version_and_modules_of_the_reference_are_attributes_of_a_fresh_package():
    code = (
        "import scanchain, sys; assert not any(name.startswith('scanchain.') for name in sys.modules);"
        "print(scanchain.__version__, scanchain.lie.exp.__name__, scanchain.evaluation.pair.__name__)"
    )
    printed = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True).stdout
    assert printed.split() == [version("scanchain"), "exp", "pair"]
    with pytest.raises(AttributeError, match="no attribute 'aline'"):
        sc.aline  # noqa: B018


def test_invalid_returns_of_an_organized_cloud_are_dropped_with_their_times_and_counted():
    scans = kitti_scans(3)
    whole, organized = sc.Odometry(), sc.Odometry()
    for scan in scans:
        stamp_s, count = scan.stamp_ns * 1e-9, len(scan.points)
        rows = np.sort(np.random.default_rng(0).choice(2 * count, count, replace=False))
        points, times_s = np.full((2 * count, 3), np.nan), np.zeros(2 * count)
        points[:9] = np.inf
        points[rows] = scan.points
        if len(scan.times_s):
            times_s[rows] = scan.times_s
        wanted = whole.process(sc.Scan.of(scan.points, stamp_s, scan.times_s))
        tracked = organized.process(sc.Scan.of(points, stamp_s, times_s if len(scan.times_s) else None))
        assert tracked.scan.dropped == count and len(tracked.scan.points) == count
        assert np.array_equal(tracked.T_odom_lidar, wanted.T_odom_lidar)
    assert np.array_equal(sc.downsample(points, 1.0), sc.downsample(scan.points, 1.0))
    assert sc.downsample([[0.1, 0.1], [0.2, 0.2], [1.1, 0.1]], 1.0).tolist() == [[0.1, 0.1], [1.1, 0.1]]
    match, wanted = (sc.align(scans[0].points, cloud) for cloud in (points, scan.points))
    assert np.array_equal(match.T_target_source, wanted.T_target_source)


def test_a_comparison_from_python_has_a_row_a_method(office, tmp_path, monkeypatch):
    here(monkeypatch)
    compared = sc.compare(office, tmp_path / "compared", ["svd"])
    assert [row.name for row in compared.table.rows] == ["svd"]
    assert (compared.path / "report.html").exists()


@pytest.mark.parametrize("folder", ["pipeline", "viz"])
def test_no_module_gives_a_second_value_to_a_name_of_its_own(folder):
    """Files that are joined may each have a constant of one name; the later value would hold for both."""
    for path in sorted((ROOT / folder).rglob("*.py")):
        targets = [
            node.id
            for statement in ast.parse(path.read_text(encoding="utf-8")).body
            if isinstance(statement, ast.Assign)
            for target in statement.targets
            for node in ast.walk(target)
            if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store)
        ]
        assert len(set(targets)) == len(targets), path
