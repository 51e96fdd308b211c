"""``scanchain evaluate``: metrics with their definitions, tables, scale and offset, relations."""

import json
import math

import numpy as np
import pytest

from scanchain import lie
from scanchain.data import Trajectory
from scanchain.evaluation.metrics import evaluate
from scanchain.trajectory import write_tum
from tests.support.messages import says, unfolded
from tests.support.naive_logs import SECOND, STAMP_NS


def quarter(path, scale=1.0, count=40):
    """Poses on a quarter of a circle of 20 m, tangential, a second apart."""
    lines = []
    for k in range(count):
        a = 0.5 * math.pi * k / (count - 1)
        x, y = 20.0 * scale * math.sin(a), 20.0 * scale * (1.0 - math.cos(a))
        lines.append(f"{100 + k}.0 {x!r} {y!r} 0 0 0 {math.sin(0.5 * a)!r} {math.cos(0.5 * a)!r}\n")
    path.write_text("".join(lines))
    return path


@pytest.fixture
def tree(call):
    """What evaluate prints as JSON."""
    return lambda *words: json.loads(call("evaluate", *words, "--json")[1])


def test_evaluate_prints_every_metric_with_its_definition(call, tree, tmp_path, monkeypatch):
    monkeypatch.setenv("COLUMNS", "100")
    estimate, truth = quarter(tmp_path / "est.tum", 1.1), quarter(tmp_path / "gt.tum")
    code, output, errors = call("evaluate", estimate, truth)
    assert code == 0
    (warning,) = errors.splitlines()
    says(warning, "warning: far from the ground truth: ATE 0.89 m on a path of 31.4 m")
    heads, units, *rows = (line.split() for line in output.splitlines()[1:9])
    assert heads == ["ATE", "RPE", "1", "pose", "RPE", "1", "s", "RPE", "10", "m"] and units == ["m", "deg"] * 4
    assert [row[0] for row in rows] == ["rmse", "mean", "median", "std", "min", "max"]
    assert output.count("40 of 40 estimated poses") == 1 and "‖t_ref − t_est‖" not in output
    assert all(len(line) <= 100 for line in output.splitlines()) and len(output.splitlines()) <= 25
    says(output, "KITTI translation 10", "not computed: RPE over 100 m")
    says(unfolded(call("evaluate", estimate, truth, "--verbose")[1]), "‖t_ref − t_est‖", "KITTI: translation")
    found = tree(estimate, truth, "--align", "first")
    assert found["start_m"] == pytest.approx(0.08, rel=0.02)
    assert set(found) - {"start_m"} == {"ate", "rpe_1_pose", "rpe_1_s", "rpe_10_m", "rpe_100_m", "kitti"}
    assert found["ate"]["path_length_m"] == pytest.approx(10.0 * math.pi, rel=1e-3)
    assert found["ate"]["translation_m"]["maximum"] == pytest.approx(0.1 * 20.0 * 2**0.5, rel=1e-6)
    assert found["kitti"]["translation_share"] == pytest.approx(0.1, rel=0.05)
    same = tree(truth, truth)
    assert same["ate"]["translation_m"]["rmse"] < 1e-9 and same["rpe_10_m"]["translation_m"]["rmse"] < 1e-9


def test_evaluate_finds_scale_and_time_offset_and_measures_without_them(call, refused, tree, tmp_path):
    t_s, truth = np.arange(400) / 10.0, tmp_path / "gt.tum"
    rows = (8.0 * np.sin(0.4 * t_s) + 2.0 * np.sin(1.1 * t_s), 6.0 * np.cos(0.3 * t_s), 0.2 * t_s)
    true = lie.lift(np.array([lie.pose_2d(*row) for row in zip(*rows, strict=True)]))
    stamps_ns = STAMP_NS + np.arange(400) * SECOND // 10
    write_tum(truth, Trajectory(stamps_ns, true))
    poses = lie.lift(lie.pose_2d(3.0, -2.0, 0.7)) @ true
    poses[:, :3, 3] /= 4.0
    estimate = tmp_path / "est.tum"
    write_tum(estimate, Trajectory(stamps_ns + 130_000_000, poses))
    assert tree(estimate, truth)["ate"]["translation_m"]["rmse"] > 1.0
    found = tree(estimate, truth, "--scale", "--time-offset", "auto")
    assert (found["scale"], found["time_offset_s"]) == pytest.approx((4.0, -0.13), rel=1e-3, abs=1e-3)
    assert found["ate"]["translation_m"]["rmse"] < 1e-3
    _, output, _ = call("evaluate", estimate, truth, "--scale", "--time-offset", "-0.13")
    says(output, "time offset -0.1300 s added", "scale 4 put on", "\nrmse     0.0000")
    result = evaluate(estimate, truth, scale=True, time_offset="auto")
    assert (result.scale, result.time_offset_s) == (found["scale"], found["time_offset_s"])
    write_tum(tmp_path / "still.tum", Trajectory(stamps_ns, np.tile(np.eye(4), (400, 1, 1))))
    says(refused("evaluate", tmp_path / "still.tum", truth, "--scale"), "undetermined")


def test_evaluate_agrees_with_the_run_and_puts_several_estimates_into_a_table_and_a_picture(
    call, refused, tree, tmp_path, office, ran
):
    run = ran(office, "--every", "2")
    truth, png = office.with_suffix(".tum"), tmp_path / "paths.png"
    files = {"optimized": run.folder, "odometry": run.folder / "odometry.tum"}
    code, output, _ = call("evaluate", *files.values(), truth, "--png", png)
    rows = output.splitlines()
    assert code == 0 and rows[0].split()[:2] == ["estimate", "paired"] and png.stat().st_size > 10_000
    assert [row.split()[:2] for row in rows[2:4]] == [[str(file), "30"] for file in files.values()]
    found = tree(*files.values(), "--gt", truth)
    for (key, file), row in zip(files.items(), rows[2:4], strict=True):
        rmse_m = found[str(file)]["ate"]["translation_m"]["rmse"]
        assert rmse_m == pytest.approx(run.metrics["ground_truth"][key]["ate_rmse_m"], abs=1e-6)
        assert row.split()[4] == f"{rmse_m:.4f}"
    assert tree(run.folder / "trajectory.tum", truth) == found[str(run.folder)]
    says(refused("evaluate", run.folder, truth, "--png", png), "paths.png: exists")


def test_evaluate_warns_of_a_truth_that_stands_and_refuses_kitti_files_of_different_lengths(
    call, refused, tmp_path
):
    truth = quarter(tmp_path / "gt.tum")
    standing = "".join(f"{100 + k}.0 {k % 2}e-3 {k % 3}e-3 0 0 0 0 1\n" for k in range(40))
    (tmp_path / "standing.tum").write_text(standing)
    says(call("evaluate", truth, tmp_path / "standing.tum")[2], "on a path of 0.1 m", "or does not move")
    rows = "1 0 0 {} 0 1 0 0 0 0 1 0\n"
    for name, count in (("est.txt", 30), ("gt.txt", 29)):
        (tmp_path / name).write_text("".join(rows.format(k) for k in range(count)))
    said = refused("evaluate", tmp_path / "est.txt", tmp_path / "gt.txt", "--kitti")
    says(said, "gt.txt: has 29 lines for 30 scans")


def test_evaluate_says_which_metric_a_short_way_leaves_out(call, tree, tmp_path):
    short = quarter(tmp_path / "gt.tum", 0.1)
    code, output, _ = call("evaluate", short, short)
    assert code == 0
    says(
        unfolded(output), "ATE", "not computed: RPE over 10 m along the reference: no segment of that length fits",
        "not computed: KITTI metric: no segment of 10 m fits into a path of ",
    )  # fmt: skip
    assert tree(short, short)["kitti"] is None


def test_evaluate_measures_relations_alone_and_beside_the_truth(call, tree, tmp_path):
    truth = quarter(tmp_path / "gt.tum")
    step = 0.5 * math.pi / 39
    x, y = 20.0 * math.sin(step) + 0.05, 20.0 * (1.0 - math.cos(step))  # wrong by 5 cm
    (tmp_path / "set.relations").write_text(f"103.0 104.0 {x} {y} 0 0 0 {step}\n")
    code, output, _ = call("evaluate", truth, "--relations", tmp_path / "set.relations")
    assert code == 0 and "ATE" not in output
    says(unfolded(output), "relations", "1 relation, 0 missing")
    assert "Kümmerle" in call("evaluate", truth, "--relations", tmp_path / "set.relations", "--verbose")[1]
    found = tree(truth, truth, "--relations", tmp_path / "set.relations")
    assert found["relations"]["translation_m"]["mean"] == pytest.approx(0.05, abs=1e-9)
    assert found["relations"]["rotation_rad"]["mean"] < 1e-9 and "ate" in found
