"""``scanchain landmarks`` as its users meet it."""

import csv
import json
import re
from dataclasses import replace

import numpy as np
import pytest

from scanchain.landmarks.ranges import solve_range_log
from scanchain.landmarks.solvers import ESTIMATOR, METHODS
from scanchain.trajectory import read_tum
from tests.support.browser import look
from tests.support.mrclam import World, write_mrclam
from tests.support.scenes import shared_data

RrdReader = pytest.importorskip("rerun.chunk").RrdReader

image = pytest.importorskip("matplotlib.image")


@pytest.fixture
def small(tmp_path):
    """A linear problem in which every fifth pose sees every landmark; its name would be markup."""
    rng, path = np.random.default_rng(0), tmp_path / "a<b>&c.npz"
    poses, landmarks = np.cumsum(rng.normal(size=(30, 2)), axis=0), 4.0 * rng.normal(size=(5, 2))
    pairs = np.stack(np.meshgrid(np.arange(0, 30, 5), np.arange(5), indexing="ij"), -1).reshape(-1, 2)
    seen = landmarks[pairs[:, 1]] - poses[pairs[:, 0]] + 0.1 * rng.normal(size=pairs.shape)
    odometry = np.diff(poses, axis=0) + 0.1 * rng.normal(size=(29, 2))
    np.savez(
        path, gt_traj=poses - poses[0], gt_landmarks=landmarks - poses[0], odom=odometry,
        observations=np.column_stack([pairs, seen]), sigma_odom=0.01 * np.eye(2), sigma_landmark=0.01 * np.eye(2),
    )  # fmt: skip
    return path


def methods_of(out):
    (problem,) = json.loads((out / "metrics.json").read_text())["problems"]
    return [method["method"] for method in problem["methods"]]


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
    assert "--methods all" in page and "Differs by" not in page and "nonzero entries" in page
    for option in ("--method", "--methods"):
        assert call("landmarks", small, "--out", out, "--force", option, "lu,qr")[0] == 0
        assert methods_of(out) == ["lu", "qr"]
    page = (out / "report.html").read_text()
    assert "--methods all" not in page and "Differs by" in page


def test_pinv_is_left_out_of_all_above_its_limit_and_refused_by_name(call, small, tmp_path, monkeypatch):
    monkeypatch.setattr("scanchain.landmarks.solvers.PINV_BELOW", 70)
    words = ["landmarks", small, "--repeat", "1", "--out", tmp_path / "out", "--methods"]
    code, _, errors = call(*words, "lu,pinv")
    assert code == 2 and "70 unknowns" in errors and "name other --methods" in errors
    assert not (tmp_path / "out").exists()
    code, output, _ = call(*words, "all")
    assert code == 0 and "not compared    pinv" in output and "70 unknowns, its limit is 70" in output
    assert methods_of(tmp_path / "out") == [method for method in METHODS if method != "pinv"]


@pytest.mark.parametrize(
    ("optimizer", "ended"), [("gauss-newton", "converged"), ("gradient-descent", "DID NOT CONVERGE")]
)
def test_every_optimizer_tells_how_it_ended(call, tmp_path, optimizer, ended):
    words = ["--out", tmp_path / "out", "--optimizer", optimizer, "--repeat", "1"]
    code, output, _ = call("landmarks", shared_data("landmarks/2d_nonlinear.npz"), *words)
    assert code == (ended != "converged") and f"{optimizer} {ended} after" in output


def test_two_problems_stand_side_by_side_in_a_recording_too_and_the_figures_come_as_json(call, small, tmp_path):
    other, recording = small.with_name("other.npz"), tmp_path / "landmarks.rrd"
    other.write_bytes(small.read_bytes())
    words = ["--repeat", "1", "--method", "qr,schur", "--json", "--recording", recording]
    code, output, _ = call("landmarks", small, other, "--out", tmp_path / "out", *words)
    assert code == 0
    problems = json.loads(output)["problems"]
    assert [problem["name"] for problem in problems] == ["a<b>&c", "other"]
    for problem in problems:
        assert [method["method"] for method in problem["methods"]] == ["qr", "schur"]
        assert problem["after"]["poses_m"] < problem["before"]["poses_m"]
        assert problem["methods"][1]["difference"] < 1e-8
    entities = {chunk.entity_path.lstrip("/") for chunk in RrdReader(recording).stream()}
    for name in ("truth/trajectory", "truth/landmarks", "trajectory", "landmarks", "ellipses"):
        assert {f"world/a_b_c/{name}", f"world/other/{name}"} <= entities


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--method", "chol"], "there is no method 'chol'"),
        (["--odometry-noise", "0.1,0.1,-1,1"], "give four positive numbers"),
        (["{small}", "--method", "schur"], "two problems are called a<b>&c"),
        (["--recording", "{small}.rrd"], "exists; choose another name"),
    ],
)
def test_bad_arguments_are_one_line_and_leave_nothing(call, small, tmp_path, words, said):
    small.with_suffix(".npz.rrd").touch()
    out, words = tmp_path / "out", [word.format(small=small) for word in words]
    code, output, errors = call("landmarks", small, "--out", out, *words)
    assert code == 2 and output == "" and said in errors and errors.count("\n") == 1
    assert not out.exists()


def test_an_mrclam_folder_gives_a_stamped_trajectory(call, tmp_path):
    folder = shared_data("landmarks/utias_mrclam6")
    code, output, _ = call("landmarks", folder, "--out", tmp_path / "out", "--method", "schur", "--repeat", "1")
    assert code == 0 and "407 of other robots" in output
    trajectory = read_tum(tmp_path / "out" / "utias_mrclam6_robot_1.tum")
    assert len(trajectory) == 1012 and trajectory.stamps_ns[0] == 1248444189_599_000_000


@pytest.mark.parametrize("is_wrong", [True, False])
def test_landmarks_that_are_missed_on_most_visits_are_named_and_the_exit_code_is_1(
    call, tmp_path, monkeypatch, is_wrong
):
    def with_barcodes(log, noise):
        """A solution in which the landmark seen most often has another number at first, if it is to be wrong."""
        subjects = log.subjects.copy()
        own = np.flatnonzero(subjects == np.bincount(subjects).argmax())
        subjects[own[: len(own) // 5]] = 99 if is_wrong else subjects[own[0]]
        part = replace(log, subjects=subjects)
        return part, solve_range_log(part, noise)

    monkeypatch.setattr("scanchain.landmarks.study.associated", with_barcodes)
    write_mrclam(tmp_path / "world", World(51, duration_s=600.0))
    code, output, _ = call("landmarks", tmp_path / "world", "--ignore-barcodes", "--out", tmp_path / "out")
    (problem,) = json.loads((tmp_path / "out" / "metrics.json").read_text())["problems"]
    assert code == is_wrong and problem["converged"] is not is_wrong
    assert problem["contradicted"] == ([99] if is_wrong else [])
    assert ("1 landmark (99) not seen on most visits" in " ".join(output.split())) == is_wrong
