"""From a log to a complete run directory, every file read back by somebody else's reader."""

import contextlib
import hashlib
import io
import json
import os
import re
import subprocess
import sys
import tomllib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

from scanchain import lie
from scanchain.__main__ import main
from scanchain.graph.g2o import read_g2o
from scanchain.logs import open_log
from scanchain.odometry import jackknife
from scanchain.settings import flatten
from scanchain_viz.recording import entities
from tests.support.naive_graph import error
from tests.support.naive_maps import served_map
from tests.support.recordings import EVERY_SCAN, column, rows_of, static_entities
from tests.support.scenes import ROOT, configured, shared_data

FILES = {
    "trajectory.tum", "trajectory_base.tum", "keyframes.tum", "odometry.tum", "trajectory.kitti.txt", "graph.g2o",
    "map", "map.ply", "map.pgm", "map.yaml", "recording.rrd", "steps.parquet", "loops.parquet", "metrics.json",
    "summary.txt", "config.toml", "run.json", "report.html",
}  # fmt: skip
NOT_TIMED = (
    "trajectory.tum", "odometry.tum", "trajectory.kitti.txt", "keyframes.tum", "graph.g2o", "map.ply", "map.pgm",
    "map.yaml", "loops.parquet", "config.toml",
)  # fmt: skip
TIMED_COLUMNS = ["read_s", "preprocess_s", "match_s", "map_s", "loops_s"]
# the wheels are left out and loops may be short, so that a minute has closures of every verdict
OFFICE = ("--odometry.prior", "constant-velocity", "--loops.min_travel_m", "5")


WITH_WINDOWS = """
import sys
from scanchain.__main__ import main
from scanchain.odometry import jackknife
jackknife.LONGEST = %s
sys.exit(main(sys.argv[1:]))
"""  # of error bars, which are short in tests, see conftest.py


@dataclass(frozen=True)
class Drive:
    """A log, the flags it was run with, and the run directory."""

    log: Path
    flags: tuple[str, ...]
    folder: Path
    dimension: int

    @property
    def metrics(self):
        return json.loads((self.folder / "metrics.json").read_text())

    @property
    def steps(self):
        columns = self.table("steps").to_pydict()
        return {name: np.array(rows) for name, rows in columns.items() if None not in rows}

    @property
    def truth(self):
        return np.loadtxt(self.log.with_suffix(".tum"))

    def table(self, name):
        return pq.read_table(self.folder / f"{name}.parquet")

    def tum(self, name="trajectory"):
        return np.loadtxt(self.folder / f"{name}.tum")


def succeed(*words):
    """Run a command; its output."""
    output, errors = io.StringIO(), io.StringIO()
    with contextlib.redirect_stdout(output), contextlib.redirect_stderr(errors):
        code = main([str(word) for word in words])
    assert (code, errors.getvalue()) == (0, "")
    return output.getvalue()


def driven(folder, world, dimension, simulation, flags=()):
    log = folder / f"{world}.mcap"
    succeed("simulate", world, log, *simulation)
    succeed("run", log, "--out", folder / "run", *flags)
    return Drive(log, tuple(flags), folder / "run", dimension)


@pytest.fixture(scope="module")
def office(tmp_path_factory):
    return driven(tmp_path_factory.mktemp("office"), "office", 2, ["--duration", "60"], OFFICE)


@pytest.fixture(scope="module")
def town(tmp_path_factory):
    return driven(tmp_path_factory.mktemp("town"), "town", 3, ["--duration", "3", "--sensor", "vlp-16"])


@pytest.fixture(params=["office", "town"])
def drive(request):
    return request.getfixturevalue(request.param)


def matrices(rows):
    """Poses (N, 4, 4) of rows x y z qx qy qz qw."""
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3, :3] = Rotation.from_quat(rows[:, 3:]).as_matrix()
    poses[:, :3, 3] = rows[:, :3]
    return poses


def ate_m(estimate, truth):
    """Root mean square distance after the best rigid alignment, by scipy, of positions that pair row by row."""
    a, b = (rows[:, 1:4] - rows[:, 1:4].mean(axis=0) for rows in (truth, estimate))
    return Rotation.align_vectors(a, b)[1] / np.sqrt(len(a))


def length_m(rows):
    return np.linalg.norm(np.diff(rows[:, 1:4], axis=0), axis=1).sum()


def stamps_of(path):
    return [line.split()[0] for line in path.read_text().splitlines()]


def test_a_run_directory_holds_every_file_and_no_other(drive):
    rejected = {"graph_rejected.g2o"} if drive.metrics["closures_rejected_by_back_end"] else set()
    assert {path.name for path in drive.folder.iterdir()} == FILES | {"ground_truth.tum"} | rejected
    assert [path.name for path in drive.folder.parent.iterdir() if "partial" in path.name] == []


def test_trajectories_and_steps_have_the_same_pose_at_the_exact_stamp_of_every_scan(drive):
    steps, stamps = drive.steps, stamps_of(drive.log.with_suffix(".tum"))
    assert steps["index"].tolist() == list(range(len(stamps)))
    assert [f"{stamp // 10**9}.{stamp % 10**9:09d}" for stamp in steps["stamp_ns"].tolist()] == stamps
    for name, prefix in (("trajectory", ""), ("odometry", "odom_")):
        assert stamps_of(drive.folder / f"{name}.tum") == stamps
        rows = drive.tum(name)
        np.testing.assert_allclose(np.linalg.norm(rows[:, 4:], axis=1), 1.0, atol=1e-8)
        assert drive.dimension == 3 or not rows[:, [3, 4, 5]].any()
        columns = [steps[prefix + axis] for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]
        np.testing.assert_allclose(np.column_stack(columns), rows[:, 1:], atol=1e-9)
    lidars = matrices(drive.tum()[:, 1:])
    rows = np.loadtxt(drive.folder / "trajectory.kitti.txt").reshape(-1, 3, 4)
    np.testing.assert_allclose(rows, lidars[:, :3], atol=1e-7)
    T_base_lidar = open_log(drive.log).T_base_lidar
    mounted = T_base_lidar if drive.dimension == 3 else lie.lift(T_base_lidar)
    assert abs(mounted[0, 3]) > 0.1 or abs(mounted[2, 3]) > 0.1
    np.testing.assert_allclose(matrices(drive.tum("trajectory_base")[:, 1:]) @ mounted, lidars, atol=1e-7)
    assert set(steps["state"]) == {"ok"} and (steps["inliers"] <= steps["points"]).all()
    assert all((steps[name] >= 0.0).all() for name in TIMED_COLUMNS) and (steps["match_s"] > 0.0).all()


def test_covariances_are_symmetric_positive_and_of_a_likely_size(drive):
    k = 3 if drive.dimension == 2 else 6
    covariances = np.array(drive.table("steps")["covariance"].to_pylist()[1:]).reshape(-1, k, k)
    np.testing.assert_allclose(covariances, np.swapaxes(covariances, 1, 2), rtol=1e-6, atol=1e-15)
    assert (np.linalg.eigvalsh(covariances)[:, 0] > 0.0).all()
    sigma_m = np.sqrt(np.trace(covariances[:, : drive.dimension, : drive.dimension], axis1=1, axis2=2))
    assert 1e-4 < np.median(sigma_m) < 0.1
    directions = np.array(drive.table("steps")["degeneracy_direction"].to_pylist())
    np.testing.assert_allclose(np.linalg.norm(directions, axis=1), 1.0, atol=1e-6)


def test_the_graph_holds_the_keyframes_and_what_ties_them_and_chi2_is_the_sum_over_its_edges(drive):
    graph = read_g2o(drive.folder / "graph.g2o").graph
    steps, metrics = drive.steps, drive.metrics
    scans = np.flatnonzero(steps["keyframe"] >= 0)
    assert steps["keyframe"][scans].tolist() == list(range(metrics["keyframes"])) == list(range(len(graph)))
    refined_m = 0.03 if drive.dimension == 2 else 1e-7  # planar scans are aligned once more, after the graph
    np.testing.assert_allclose(lie.lift(graph.poses), matrices(drive.tum()[scans, 1:]), atol=refined_m)
    loops = drive.table("loops").to_pylist()
    tied = [[row["target"], row["source"]] for row in loops if row["verdict"] == "accepted"]
    assert sorted(graph.edges.tolist()) == sorted([*([i, i + 1] for i in range(len(scans) - 1)), *tied])
    assert len(tied) == metrics["closures_accepted"]
    assert len(tied) + metrics["closures_rejected_by_back_end"] == metrics["closures_verified"]
    assert (np.linalg.eigvalsh(graph.information)[:, 0] > 0.0).all()
    chi2 = 0.0
    for (i, j), Z, information in zip(graph.edges, graph.measurements, graph.information, strict=True):
        e = error(graph.poses[i], graph.poses[j], Z)
        chi2 += e @ information @ e
    assert chi2 == pytest.approx(metrics["chi2"], rel=1e-6, abs=1e-6)
    assert metrics["degrees_of_freedom"] == len(information) * (len(graph.edges) - (len(graph) - 1))


def test_loop_closures_are_told_with_verdict_and_reason_and_the_accepted_ones_are_true(office, town):
    rows, metrics = office.table("loops").to_pylist(), office.metrics
    verdicts = [row["verdict"] for row in rows]
    assert (len(rows), verdicts.count("accepted")) == (metrics["closures_tried"], metrics["closures_accepted"])
    assert set(verdicts) == {"accepted", "rejected"} and all(row["reason"] for row in rows)
    truth = matrices(office.truth[:, 1:])
    scans = np.flatnonzero(office.steps["keyframe"] >= 0)
    for row in rows:
        assert (row["target_scan"], row["source_scan"]) == (scans[row["target"]], scans[row["source"]])
        if row["verdict"] == "accepted":
            measured = matrices(np.array([[row[axis] for axis in ("x", "y", "z", "qx", "qy", "qz", "qw")]]))[0]
            off = np.linalg.inv(truth[row["target_scan"]]) @ truth[row["source_scan"]] @ np.linalg.inv(measured)
            assert np.linalg.norm(off[:3, 3]) < 0.1 and Rotation.from_matrix(off[:3, :3]).magnitude() < 0.02
            assert row["weight"] >= 0.1
        else:
            assert row["weight"] < 0.1
    assert town.table("loops").num_rows == town.metrics["closures_tried"] == 0
    assert town.table("loops").schema.names == office.table("loops").schema.names


def read_ply(path):
    """Points (N, 3) of a binary PLY by its own header."""
    header, _, body = path.read_bytes().partition(b"end_header\n")
    lines = header.decode().splitlines()
    assert lines[:2] == ["ply", "format binary_little_endian 1.0"]
    assert [line for line in lines if line.startswith("property")] == [f"property float {axis}" for axis in "xyz"]
    (count,) = [int(line.split()[2]) for line in lines if line.startswith("element vertex")]
    points = np.frombuffer(body, "<f4").reshape(-1, 3)
    assert len(points) == count > 0 and np.isfinite(points).all()
    return points


def test_the_cloud_and_the_grid_of_a_2d_log_show_the_same_walls(office):
    points = read_ply(office.folder / "map.ply")
    cells, origin, resolution_m = served_map(office.folder)
    assert not points[:, 2].any() and resolution_m == 0.05
    rows, columns = np.nonzero(cells == 100)
    walls = np.column_stack([columns, rows]) * resolution_m + np.array(origin[:2]) + 0.5 * resolution_m
    distance_m, _ = cKDTree(walls).query(points[:, :2])
    assert np.percentile(distance_m, 90) < 0.1
    assert {-1, 0, 100} == set(np.unique(cells))


def test_the_way_leads_over_free_cells(drive):
    cells, origin, resolution_m = served_map(drive.folder)
    columns, rows = np.floor((drive.tum()[:, 1:3] - origin[:2]) / resolution_m).astype(int).T
    values = cells[rows, columns]
    assert (values != 100).all()
    if drive.dimension == 2:
        assert (values == 0).mean() > 0.95


def test_the_metrics_agree_with_the_files(drive):
    metrics, steps = drive.metrics, drive.steps
    assert metrics["dimension"] == drive.dimension
    assert metrics["scans"] == len(steps["index"]) == len(drive.truth)
    states = {state: int((steps["state"] == state).sum()) for state in ("ok", "degenerate", "lost")}
    assert states == {state: metrics[state] for state in states}
    span_s = (steps["log_time_ns"][-1] - steps["log_time_ns"][0]) * 1e-9
    assert metrics["log_span_s"] == pytest.approx(span_s)
    assert metrics["times_real_time"] == pytest.approx(span_s / metrics["run_s"])
    assert metrics["scans_per_s"] == pytest.approx(metrics["scans"] / metrics["run_s"])
    assert metrics["map_points"] == len(read_ply(drive.folder / "map.ply"))
    assert metrics["traveled_m"] == pytest.approx(length_m(drive.tum()), abs=1e-5)
    assert metrics["scan_points"] == steps["scan_points"].sum()
    assert metrics["median_residual_m"] == pytest.approx(np.median(steps["residual_m"]))
    assert metrics["median_inlier_share"] == pytest.approx(np.median(steps["inliers"] / steps["points"]))
    for name in TIMED_COLUMNS:
        stage = name.removesuffix("_s")
        assert metrics["median_ms"][stage] == pytest.approx(1e3 * np.median(steps[name]))
        assert metrics["p95_ms"][stage] == pytest.approx(1e3 * np.percentile(steps[name], 95))


def test_the_error_told_is_the_one_scipy_finds_and_below_5_cm_and_3_per_mille_of_the_path(drive):
    told = drive.metrics["ground_truth"]
    assert told["path_length_m"] == pytest.approx(length_m(drive.truth), abs=1e-5)
    for key, name in (("optimized", "trajectory"), ("odometry", "odometry")):
        assert told[key]["ate_rmse_m"] == pytest.approx(ate_m(drive.tum(name), drive.truth), abs=1e-6)
        assert told[key]["pairs"] == len(drive.truth)
    found_m = told["optimized"]["ate_rmse_m"]
    assert found_m < 0.05 and found_m < 0.003 * length_m(drive.truth)


def test_the_run_file_says_what_was_read_and_the_configuration_is_the_preset_with_the_flags(drive):
    said = json.loads((drive.folder / "run.json").read_text())
    assert said["complete"] and said["stopped"] == ""
    (log,) = said["logs"]
    assert (log["path"], log["size_bytes"]) == (str(drive.log), drive.log.stat().st_size)
    assert log["sha256"] == hashlib.sha256(drive.log.read_bytes()).hexdigest()
    assert said["versions"]["scanchain"] and said["versions"]["rerun-sdk"].startswith("0.41")
    assert f"preset lidar{drive.dimension}d" in said["configuration"]
    tree = tomllib.loads((drive.folder / "config.toml").read_text())
    values = {f"{a}.{b}": value for a, branch in tree.items() for b, value in branch.items()}
    changes = {"odometry.prior": "constant-velocity", "loops.min_travel_m": 5.0} if drive.dimension == 2 else {}
    assert values == flatten(configured(drive.dimension)) | changes


# the recording


def test_the_recorded_poses_are_those_of_the_trajectories_at_every_scan(drive):
    path = drive.folder / "recording.rrd"
    ((strip,),) = column(path, entities.OPTIMIZED, "LineStrips3D:strips", is_static=True)
    np.testing.assert_allclose(strip, drive.tum()[:, 1:4], atol=1e-4)
    rows, constant = rows_of(path)[0], static_entities(path)
    for entity in EVERY_SCAN:
        assert rows[entity] - (entity in constant) == drive.metrics["scans"], entity


def test_events_edges_counts_and_the_table_agree_on_the_verdict_of_every_closure(drive):
    path, table = drive.folder / "recording.rrd", drive.table("loops").to_pylist()
    said = {}
    for (text,) in column(path, entities.EVENTS, "TextLog:text"):
        if found := re.match(r"closure (\d+) \((\d+) to (\d+)\) (accepted|rejected): (.+)", text):
            said[int(found[1])] = (int(found[2]), int(found[3]), found[4], found[5])
    rows = {
        number: (row["target"], row["source"], row["verdict"], row["reason"]) for number, row in enumerate(table)
    }
    assert said == rows
    accepted = sum(row["verdict"] == "accepted" for row in table)
    counts = [accepted, len(table) - accepted]
    assert column(path, entities.LOOPS, "Scalars:scalars")[-1] == counts
    edges = [column(path, entity, "LineStrips3D:strips")[-1] for entity in (entities.ACCEPTED, entities.REJECTED)]
    assert [len(strips) for strips in edges] == counts
    assert drive.metrics["closures_accepted"] == accepted


def test_the_truth_is_drawn_in_recording_and_picture_where_the_trajectory_is(drive, tmp_path, monkeypatch):
    found = drive.tum()[:, 1:4]
    recorded = column(drive.folder / "recording.rrd", "world/ground_truth", "LineStrips3D:strips", is_static=True)
    ((line,),) = recorded
    np.testing.assert_allclose(np.array(line), found, atol=0.1)
    shown = []
    monkeypatch.setattr(
        "scanchain_viz.pictures.maps.draw_map", lambda picture, title, lines, **what: shown.extend(lines)
    )
    succeed("view", drive.folder, "--png", tmp_path / "a.png")
    (truth,) = (line for line in shown if line.is_dashed)
    np.testing.assert_allclose(truth.positions, found, atol=0.1)


# again


def assert_same(a, b):
    for name in NOT_TIMED:
        assert (a / name).read_bytes() == (b / name).read_bytes(), name
    tables = [pq.read_table(folder / "steps.parquet").drop_columns(TIMED_COLUMNS) for folder in (a, b)]
    assert tables[0].equals(tables[1])


@pytest.mark.parametrize(
    ("drive", "threads"),
    [
        pytest.param(world, threads, marks=[] if is_quick else [pytest.mark.slow])
        for world, threads, is_quick in (
            ("office", "1", True), ("office", "8", False), ("town", "1", False), ("town", "8", True),
        )
    ],
    indirect=["drive"],
)  # fmt: skip
def test_the_same_run_in_another_process_is_bit_equal_whatever_the_threads(drive, tmp_path, threads):
    command = [sys.executable, "-c", WITH_WINDOWS % jackknife.LONGEST]
    words = [*command, "run", drive.log, "--out", tmp_path / "again", *drive.flags]
    names = ("SCANCHAIN_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "NUMBA_NUM_THREADS")
    limits = dict.fromkeys(names, threads)
    subprocess.run(words, cwd=ROOT, env=os.environ | limits, check=True, capture_output=True, timeout=200)
    assert_same(drive.folder, tmp_path / "again")


def test_the_configuration_written_repeats_the_run(drive, tmp_path):
    words = ["--config", drive.folder / "config.toml", "--rerun", "off"]
    succeed("run", drive.log, "--out", tmp_path / "again", *words)
    assert_same(drive.folder, tmp_path / "again")


# real logs


@pytest.fixture(scope="module")
def intel(tmp_path_factory):
    log = shared_data("2d/intel.mcap")
    folder = tmp_path_factory.mktemp("intel") / "run"
    succeed("run", log, "--out", folder)
    return Drive(log, (), folder, 2)


def test_intel_gives_all_13631_scans_in_the_order_they_were_taken(intel):
    rejected = {"graph_rejected.g2o"} if intel.metrics["closures_rejected_by_back_end"] else set()
    assert {path.name for path in intel.folder.iterdir()} == FILES | rejected
    assert intel.metrics["scans"] == len(intel.tum()) == len(intel.tum("odometry")) == 13_631
    steps = intel.steps
    assert (np.diff(steps["log_time_ns"]) >= 0).all() and (np.diff(steps["stamp_ns"]) < 0).sum() == 631
    rows, _ = rows_of(intel.folder / "recording.rrd")
    assert rows[entities.OPTIMIZED_LIDAR] == 13_631


@pytest.mark.parametrize(("name", "limit_m"), [("odometry", 0.03), ("trajectory", 0.0229)])
def test_intel_keeps_the_relations_set_by_hand(intel, name, limit_m):
    relations = shared_data("2d/intel.relations")
    words = ["evaluate", intel.folder / f"{name}.tum", "--relations", relations, "--json"]
    found = json.loads(succeed(*words))["relations"]
    assert (found["translation_m"]["count"], found["missing"]) == (2984, 0)
    assert found["translation_m"]["mean"] < limit_m
    assert name == "odometry" or np.degrees(found["rotation_rad"]["mean"]) < 0.453


def test_a_real_drive_without_a_time_per_point_runs_without_any_flag(tmp_path):
    succeed("run", shared_data("3d/kitti_0005_first60.mcap"), "--out", tmp_path / "a")
    assert {path.name for path in (tmp_path / "a").iterdir()} == FILES - {"trajectory_base.tum"}
    metrics = json.loads((tmp_path / "a" / "metrics.json").read_text())
    assert (metrics["scans"], metrics["ok"], metrics["dimension"]) == (60, 60, 3)
    assert metrics["ground_truth"] is None
    assert (tmp_path / "a" / "recording.rrd").stat().st_size / 60 < 150_000
