"""An MRCLAM log against a batch in GTSAM, interleaved: python -m tests.benchmarks.landmark_log [FOLDER].

GTSAM gets the same dead reckoning and guess, Huber weights (k = 1.345), noise of 0.03 rad and 0.12 m, and the
odometry's noise as it is thought to be beforehand. Its time is that of building the graph and of its optimizer,
with the covariance of every pose and landmark where it says so. "ours as given" does just the same, "ours" the
whole estimate: dead reckoning, guess, the robot's own errors, all noise, all covariances.
"""

import argparse
import time
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np

from scanchain.graph.losses import RobustLoss
from scanchain.landmarks.estimate import from_odometry, minimize
from scanchain.landmarks.files import read_mrclam
from scanchain.landmarks.problem import BearingRangeProblem, Values, no_calibration
from scanchain.landmarks.ranges import OWN, LogModel, OdometryNoise, solve_range_log
from scanchain.landmarks.solvers import create_solver
from scanchain.landmarks.study import against_truth, truth_at

ROOT = Path(__file__).resolve().parents[2]
HUBER = 1.345
SIGMAS = np.array([0.03, 0.12])
LANDMARK = 10_000_000  # first key of a landmark


def measurements_of(log):
    model = LogModel(log)
    variances = np.concatenate([OdometryNoise().densities, SIGMAS**2])
    given = model.measurements(model.reckoned(np.zeros(len(OWN))), variances)
    return replace(given, calibration=no_calibration(given.motion))


def as_given(log):
    given = measurements_of(log)
    begin = time.perf_counter()
    found = minimize(
        BearingRangeProblem(given), from_odometry(given), create_solver("schur"),
        loss=RobustLoss("huber", HUBER, 1.0), tolerance=1e-6, first_damping=1e-10,
    )  # fmt: skip
    return time.perf_counter() - begin, found.state


def ours(log):
    begin = time.perf_counter()
    solution = solve_range_log(log, None)
    return time.perf_counter() - begin, solution.minimum.state


def with_gtsam(log, optimizer, parameters, *, covariances=False):
    given = measurements_of(log)
    guess = from_odometry(given)
    begin = time.perf_counter()
    graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
    anchor = gtsam.noiseModel.Isotropic.Sigma(3, 1e-4)
    graph.add(gtsam.PriorFactorPose2(0, gtsam.Pose2(), anchor))
    for k, (move, covariance) in enumerate(zip(given.motion, given.motion_covariance, strict=True)):
        noise = gtsam.noiseModel.Gaussian.Covariance(covariance)
        graph.add(gtsam.BetweenFactorPose2(k, k + 1, gtsam.Pose2(*move), noise))
    noise = gtsam.noiseModel.Robust.Create(
        gtsam.noiseModel.mEstimator.Huber.Create(HUBER), gtsam.noiseModel.Diagonal.Sigmas(SIGMAS)
    )
    for (pose, landmark), (bearing, reach) in zip(given.observed.tolist(), given.measured, strict=True):
        key = LANDMARK + landmark
        graph.add(gtsam.BearingRangeFactor2D(pose, key, gtsam.Rot2(bearing), reach, noise))
    for k, pose in enumerate(guess.poses):
        values.insert(k, gtsam.Pose2(*pose))
    for k, position in enumerate(guess.landmarks):
        values.insert(LANDMARK + k, position)
    found = optimizer(graph, values, parameters).optimize()
    if covariances:
        marginals = gtsam.Marginals(graph, found)
        for key in found.keys():  # noqa: SIM118
            marginals.marginalCovariance(key)
    seconds = time.perf_counter() - begin
    poses = [found.atPose2(k) for k in range(len(guess.poses))]
    landmarks = np.array([found.atPoint2(LANDMARK + k) for k in range(len(guess.landmarks))])
    return seconds, Values(np.array([[pose.x(), pose.y(), pose.theta()] for pose in poses]), landmarks)


METHODS = {
    "ours": ours,
    "ours as given": as_given,
    "gtsam LM": lambda log: with_gtsam(log, gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams()),
    "gtsam LM, covariances": lambda log: with_gtsam(
        log, gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams(), covariances=True
    ),
    "gtsam GN": lambda log: with_gtsam(log, gtsam.GaussNewtonOptimizer, gtsam.GaussNewtonParams()),
}


def main():
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument(
        "folder", nargs="?", type=Path, default=ROOT.parent / "shared" / "data" / "landmarks" / "utias_mrclam6"
    )
    parser.add_argument("--robot", type=int, default=1)
    parser.add_argument("--repeats", type=int, default=9)
    options = parser.parse_args()
    log = read_mrclam(options.folder, options.robot)
    model = LogModel(log)
    truth = truth_at(log, model.nodes_s, model.landmarks)
    seconds = {name: [] for name in METHODS}
    for method in METHODS.values():
        method(log)  # compiles
    for _ in range(options.repeats):
        for name, method in METHODS.items():
            spent, state = method(log)
            seconds[name].append((spent, state))
    print(f"{log.name}: {'method':22} {'median ms':>10} {'min ms':>8} {'ATE m':>8} {'landmarks m':>12}")
    for name, runs in seconds.items():
        accuracy = against_truth(runs[-1][1], model.nodes_s, truth)
        spent = 1e3 * np.array([run[0] for run in runs])
        print(f"{log.name}: {name:22} {np.median(spent):10.1f} {spent.min():8.1f} {accuracy.poses_m:8.4f}"
              f" {accuracy.landmarks_m:12.4f}")  # fmt: skip


if __name__ == "__main__":
    main()
