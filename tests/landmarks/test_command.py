"""``scanchain landmarks`` as its users meet it."""

import csv
import json
import re

import numpy as np
import pytest

from scanchain.landmarks.solvers import ESTIMATOR, METHODS
from scanchain.trajectory import read_tum
from tests.support.browser import look
from tests.support.scenes import shared_data

RrdReader = pytest.importorskip("rerun.chunk").RrdReader

image = pytest.importorskip("matplotlib.image")


def linear_problem(path, poses_count, landmarks_count):
    """A linear problem in which every fifth pose sees every landmark."""
    rng = np.random.default_rng(0)
    poses = np.cumsum(rng.normal(size=(poses_count, 2)), axis=0)
    landmarks = 4.0 * rng.normal(size=(landmarks_count, 2))
    poses -= poses[0]
    grid = np.meshgrid(np.arange(0, poses_count, 5), np.arange(landmarks_count), indexing="ij")
    pairs = np.stack(grid, -1).reshape(-1, 2)
    seen = landmarks[pairs[:, 1]] - poses[pairs[:, 0]] + 0.1 * rng.normal(size=pairs.shape)
    np.savez(
        path, gt_traj=poses, gt_landmarks=landmarks, observations=np.concatenate([pairs, seen], axis=1),
        odom=np.diff(poses, axis=0) + 0.1 * rng.normal(size=(poses_count - 1, 2)), sigma_odom=0.01 * np.eye(2),
        sigma_landmark=0.01 * np.eye(2),
    )  # fmt: skip
    return path


@pytest.fixture
def small(tmp_path):
    """A problem whose name would be markup if it were not escaped."""
    return linear_problem(tmp_path / "a<b>&c.npz", 30, 5)


def methods_of(out):
    return [
        method["method"] for method in json.loads((out / "metrics.json").read_text())["problems"][0]["methods"]
    ]


def test_a_problem_gives_table_pictures_page_and_estimate(call, small, tmp_path):
    out = tmp_path / "out"
    code, output, _ = call("landmarks", small, "--out", out, "--repeat", "1", "--methods", "all")
    assert code == 0
    for method in METHODS:
        assert re.search(rf"^  {method} .* \d\.\de[+-]\d\d$", output, re.MULTILINE), method
    page = (out / "report.html").read_text()
    assert "a&lt;b&gt;&amp;c" in page and "<b>" not in page
    assert not re.search(r"(src|href)=\"(?!data:|#)", page)
    with (out / "a_b_c_landmarks.csv").open() as file:
        rows = list(csv.DictReader(file))
    assert len(rows) == 5 and 0.0 < float(rows[0]["cov_x_m_x_m"]) < 0.01
    pixels = image.imread(out / "a_b_c.png")
    assert np.mean(np.all(np.abs(pixels[..., :3] - [0.25, 0.47, 0.84]) < 0.1, axis=-1)) > 0.001
    assert json.loads((out / "run.json").read_text())["complete"]
    seen = look(out / "report.html", tmp_path, width=500)
    assert seen["wide"] <= seen["width"] and seen["outside"] == [] and len(seen["svgs"]) == 2 + len(METHODS)
    for drawing in seen["svgs"][:2]:
        assert drawing["width"] > 300 and drawing["cut"] == drawing["overlapping"] == []


def test_one_solver_runs_unless_more_are_asked_for(call, small, tmp_path):
    out = tmp_path / "out"
    code, output, _ = call("landmarks", small, "--out", out)
    assert code == 0 and methods_of(out) == [ESTIMATOR] and "differs by" not in output
    page = (out / "report.html").read_text()
    assert "--methods all" in page and "Differs by" not in page and "of every method" in page
    for option in ("--method", "--methods"):
        assert call("landmarks", small, "--out", out, "--force", option, "lu,qr")[0] == 0
        assert methods_of(out) == ["lu", "qr"]
    page = (out / "report.html").read_text()
    assert "--methods all" not in page and "Differs by" in page


def test_pinv_is_left_out_of_all_above_its_limit_and_refused_by_name(call, small, tmp_path, monkeypatch):
    for module in ("solvers", "solvers.direct"):
        monkeypatch.setattr(f"scanchain.landmarks.{module}.PINV_BELOW", 70)
    words = ["landmarks", small, "--repeat", "1", "--out", tmp_path / "out", "--methods"]
    code, _, errors = call(*words, "lu,pinv")
    assert code == 2 and "70 unknowns" in errors and "name other --methods" in errors
    assert not (tmp_path / "out").exists()
    code, output, _ = call(*words, "all")
    assert code == 0 and "not compared   pinv" in output and "70 unknowns, its limit is 70" in output
    assert methods_of(tmp_path / "out") == [method for method in METHODS if method != "pinv"]


def test_a_recording_holds_truth_before_and_after_and_is_not_overwritten(call, small, tmp_path):
    path = tmp_path / "landmarks.rrd"
    words = ["landmarks", small, "--method", "schur", "--repeat", "1", "--recording", path]
    assert call(*words, "--out", tmp_path / "out")[0] == 0
    entities = {chunk.entity_path.lstrip("/"): chunk for chunk in RrdReader(path).stream()}
    for name in ("truth/trajectory", "truth/landmarks", "trajectory", "landmarks", "ellipses"):
        assert f"world/a_b_c/{name}" in entities
    code, _, errors = call(*words, "--out", tmp_path / "again")
    assert code == 2 and "exists; choose another name" in errors and not (tmp_path / "again").exists()


@pytest.mark.parametrize(
    ("optimizer", "ended"), [("dogleg", "converged"), ("gradient-descent", "DID NOT CONVERGE")]
)
def test_every_optimizer_tells_how_it_ended(call, tmp_path, optimizer, ended):
    words = ["--out", tmp_path / "out", "--optimizer", optimizer, "--repeat", "1"]
    code, output, _ = call("landmarks", shared_data("landmarks/2d_nonlinear.npz"), *words)
    assert code == (ended != "converged") and f"{optimizer} {ended} after" in output


def test_two_problems_stand_side_by_side_and_the_figures_come_as_json(call, small, tmp_path):
    other = tmp_path / "other.npz"
    other.write_bytes(small.read_bytes())
    code, output, _ = call(
        "landmarks", small, other, "--out", tmp_path / "out", "--repeat", "1", "--method", "qr,schur", "--json"
    )
    assert code == 0
    problems = json.loads(output)["problems"]
    assert [problem["name"] for problem in problems] == ["a<b>&c", "other"]
    for problem in problems:
        assert [method["method"] for method in problem["methods"]] == ["qr", "schur"]
        assert problem["after"]["poses_m"] < problem["before"]["poses_m"]
        assert problem["methods"][1]["difference"] < 1e-8
    assert (tmp_path / "out" / "factors.png").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--method", "chol"], "there is no method 'chol'"),
        (["--odometry-noise", "0.1,0.1,-1,1"], "give four positive numbers"),
        (["--robot", "3"], "--robot is for MRCLAM folders alone"),
        (["--guess", "odometry"], "--guess is for nonlinear files alone"),
    ],
)
def test_bad_arguments_are_one_line_and_leave_nothing(call, small, tmp_path, words, said):
    code, output, errors = call("landmarks", small, "--out", tmp_path / "out", *words)
    assert code == 2 and output == "" and said in errors and errors.count("\n") == 1
    assert not (tmp_path / "out").exists()


def test_two_problems_of_one_name_and_a_directory_that_exists_are_refused(call, small, tmp_path):
    code, _, errors = call("landmarks", small, small, "--out", tmp_path / "out", "--method", "schur")
    assert code == 2 and "two problems are called a<b>&c" in errors
    (tmp_path / "out").mkdir()
    code, _, errors = call("landmarks", small, "--out", tmp_path / "out")
    assert code == 2 and "--force" in errors


def test_an_mrclam_folder_gives_a_stamped_trajectory(call, tmp_path):
    folder = shared_data("landmarks/utias_mrclam6")
    code, output, _ = call("landmarks", folder, "--out", tmp_path / "out", "--method", "schur", "--repeat", "1")
    assert code == 0 and "407 of other robots" in output
    trajectory = read_tum(tmp_path / "out" / "utias_mrclam6_robot_1.tum")
    assert len(trajectory) == 1012 and trajectory.stamps_ns[0] == 1248444189_599_000_000
