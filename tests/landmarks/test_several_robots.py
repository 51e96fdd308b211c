"""Several robots of one MRCLAM folder in one problem: they see the same landmarks, and each other."""

import json
from dataclasses import replace

import numpy as np
import pytest

from scanchain.errors import InputError
from scanchain.landmarks.estimate import QUADRATIC
from scanchain.landmarks.files import read_mrclam, read_mrclams, robots_of
from scanchain.landmarks.ranges import TO_ROBOTS, solve_range_log, solve_range_logs
from scanchain.landmarks.solvers import Covariance, create_solver
from scanchain.trajectory import read_tum
from tests.support.mrclam import BODY_M, World, write_mrclam
from tests.support.nees import nees, truth_at, truth_of

ROBOTS = 1, 2, 3


@pytest.fixture(scope="module")
def world(tmp_path_factory):
    """A folder of three robots, and their true systematic errors."""
    folder = tmp_path_factory.mktemp("several") / "world"
    return folder, write_mrclam(folder, World(60, robots=ROBOTS, duration_s=300.0))


@pytest.fixture(scope="module")
def together(world):
    logs = read_mrclams(world[0], ROBOTS)
    return logs, solve_range_logs(logs, None)


def test_several_robots_are_closer_to_the_truth_together_than_each_alone_and_their_errors_as_large_as_stated(
    together,
):
    logs, solution = together
    surveyed = logs[0].true_landmarks[solution.problem.measurements.landmarks - 6]
    found = nees(solution, truth_of(logs, solution), surveyed, 0.005)
    alone = [solve_range_log(log.seen(log.subjects > 0), None) for log in logs]
    each = [
        nees(one, truth_at(log, one.nodes_s), surveyed, 0.005).ate_m for log, one in zip(logs, alone, strict=True)
    ]
    assert solution.minimum.converged and found.ate_m < 0.8 * np.mean(each)
    assert found.position < 3.0 and found.landmarks < 3.0  # few common errors dominate them
    assert 0.3 < found.heading < 1.6 and 0.3 < found.map < 1.6


def test_the_offset_of_the_ranges_to_bodies_is_found(world, together):
    _, solution = together
    layout = solution.problem.pattern.layout
    at = [k for k, name in enumerate(layout.calibration) if name.endswith(TO_ROBOTS)]
    assert [layout.calibration[k] for k in at] == [f"robot {robot} {TO_ROBOTS}" for robot in ROBOTS]
    true = np.array([world[1][robot][1][1] - BODY_M for robot in ROBOTS])  # of the camera, less the radius
    found, sigma = solution.minimum.estimate.state.calibration[at], solution.covariance.calibration[at]
    assert np.all(np.abs(found - true) < 3.5 * sigma) and np.all(sigma < 0.03)


def test_jacobians_of_motions_and_of_robots_that_are_seen_equal_central_differences(together):
    _, solution = together
    problem, state = solution.problem, solution.minimum.estimate.state
    A = problem.system(problem.linearize(state), np.ones(len(problem.measurements.observed))).A
    rng = np.random.default_rng(0)
    for _ in range(5):
        step = 1e-6 * rng.normal(size=A.shape[1])
        ahead, behind = (
            problem.system(
                problem.linearize(state.moved(sign * step)), np.ones(len(problem.measurements.observed))
            )
            for sign in (1.0, -1.0)
        )
        assert np.allclose(-0.5 * (ahead.b - behind.b), A @ step, atol=2e-3 * np.abs(A @ step).max())
        step[rng.random(len(step)) < 0.5] = 0.0


def test_covariances_equal_the_inverse_where_robots_see_each_other(world):
    logs = [log.seen(log.seen_s < log.seen_s[0] + 60.0) for log in read_mrclams(world[0], ROBOTS)]
    solution = solve_range_logs(logs, None)
    problem, at = solution.problem, solution.minimum.estimate.at
    system = problem.system(at, QUADRATIC.weight(at.chi2))
    covariance, C = Covariance(system), np.linalg.inv((system.A.T @ system.A).toarray())
    for columns in (problem.motion_columns, problem.observation_columns):
        expected = C[columns[:, :, None], columns[:, None]]
        found = covariance.of(columns)
        size = np.sqrt(np.einsum("nii->ni", expected))
        assert np.all(np.abs(found - expected) <= 1e-6 * size[:, :, None] * size[:, None])
    assert np.isnan(covariance.of(np.array([[0, 3 * len(solution.nodes_s) - 1]]))[0, 0, 1])
    rng = np.random.default_rng(1)
    drawn = np.array([covariance.sample(rng) for _ in range(4000)])
    assert np.allclose(drawn.std(axis=0), np.sqrt(C.diagonal()), rtol=0.1)
    x = create_solver("schur").solve(system)
    assert np.allclose(x, np.linalg.lstsq(system.A.toarray(), system.b, rcond=None)[0], atol=1e-6)


def test_sightings_of_robots_that_take_no_part_or_had_no_odometry_are_counted(world):
    (folder, _), logs = world, read_mrclams(world[0], (1, 2))
    one = read_mrclam(folder, 1)
    met = [int((log.subjects == -other).sum()) for log, other in zip(logs, (2, 1), strict=True)]
    assert robots_of(folder) == ROBOTS and min(met) > 20 and logs[0].of_robots == one.of_robots - met[0]
    assert not np.any(one.subjects < 0) and not np.any(logs[0].subjects == -3)
    rows = (folder / "Robot2_Odometry.dat").read_text().splitlines(keepends=True)
    short = folder.with_name("short")
    short.mkdir()
    for path in folder.glob("*.dat"):
        (short / path.name).write_bytes(path.read_bytes())
    (short / "Robot2_Odometry.dat").write_text("".join(rows[: len(rows) // 2]))
    part = read_mrclams(short, (1, 2))[0]
    end_s = float(rows[len(rows) // 2 - 1].split()[0])
    lost = int(((logs[0].subjects == -2) & (logs[0].seen_s > end_s)).sum())
    assert lost > 5 and part.outside == logs[0].outside + lost
    assert solve_range_logs(read_mrclams(short, (1, 2)), None).minimum.converged


def test_a_robot_without_two_landmarks_in_common_with_the_others_is_named(world):
    logs = read_mrclams(world[0], (1, 2))
    known = np.unique(logs[0].subjects[logs[0].subjects > 0])
    parts = logs[0].seen(np.isin(logs[0].subjects, known[:8])), logs[1].seen(~np.isin(logs[1].subjects, known[:7]))
    with pytest.raises(InputError, match="robot 2: saw fewer than two landmarks that other robots saw"):
        solve_range_logs(parts, None)


def test_robots_that_never_meet_are_joined_by_their_landmarks(world):
    logs = [log.seen(log.subjects > 0) for log in read_mrclams(world[0], (1, 2))]
    solution = solve_range_logs(logs, None)
    assert solution.minimum.converged and len(solution.sigmas[1]) == 2
    surveyed = logs[0].true_landmarks[solution.problem.measurements.landmarks - 6]
    assert nees(solution, truth_of(logs, solution), surveyed, 0.005).ate_m < 0.12


def test_the_noise_of_sightings_of_robots_is_their_own(together):
    logs, solution = together
    rng, worse = np.random.default_rng(0), []
    for log in logs:
        noise = (log.subjects < 0)[:, None] * rng.normal(size=log.measured.shape) * [0.05, 0.1]
        worse.append(replace(log, measured=log.measured + noise))
    noisy = solve_range_logs(worse, None)
    assert noisy.sigmas[1][-1, 0] > 3.0 * solution.sigmas[1][-1, 0]
    assert np.allclose(noisy.sigmas[1][:-1], solution.sigmas[1][:-1], rtol=0.3)


def test_the_command_writes_a_trajectory_of_each_robot_in_one_frame(call, world, together, tmp_path):
    logs, solution = together
    out, recording = tmp_path / "out", tmp_path / "together.rrd"
    words = ["--out", out, "--repeat", "1", "--recording", recording]
    code, output, _ = call("landmarks", world[0], "--robot", "all", *words)
    output = " ".join(output.split())
    assert code == 0 and "world robots 1, 2, 3" in output and " of robots from " in output
    assert all(f"robot {robot} estimated: forward scale" in output for robot in ROBOTS)
    (problem,) = json.loads((out / "metrics.json").read_text())["problems"]
    assert problem["after"]["poses_m"] < 0.05 < problem["before"]["poses_m"]
    paths = [read_tum(out / f"world_robots_1_2_3_robot_{robot}.tum") for robot in ROBOTS]
    poses = np.concatenate([path.poses[:, :2, 3] for path in paths])
    assert np.allclose(poses, solution.minimum.estimate.state.poses[:, :2], atol=1e-5)
    assert abs(paths[1].stamps_ns[0] * 1e-9 - min(logs[1].seen_s[0], solution.nodes_s[len(paths[0])])) < 1e-3
    assert (out / "world_robots_1_2_3_robot_2_poses.csv").is_file() and recording.is_file()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (["--robot", "1,1"], "--robot is '1,1'; give a number, several as 1,2,5, or all"),
        (["--robot", "some"], "--robot is 'some'"),
        (["--robot", "1,4"], "has no Robot4_Odometry.dat; --robot must be one of those logged there: 1, 2, 3"),
        (["--robot", "all", "--ignore-barcodes"], "--ignore-barcodes is for one robot; name it with --robot"),
    ],
)
def test_robots_that_cannot_be_are_refused_in_one_line(call, world, tmp_path, words, said):
    code, output, errors = call("landmarks", world[0], "--out", tmp_path / "out", *words)
    assert code == 2 and output == "" and said in errors and errors.count("\n") == 1
