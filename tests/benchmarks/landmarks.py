"""The landmark problems of the course report by every linear solver, and an MRCLAM log against GTSAM.

linear: each round solves every problem by every method in turn; times are medians of whole solutions of A x = b,
a new solver each time; "again" is with the same solver once more, which keeps what it found out about the
pattern. The report's seconds are of another machine (and its QR is SuiteSparseQR): ratios within a column
compare.

log: a batch in GTSAM gets the same dead reckoning and guess, Huber weights (k = 1.345), noise of 0.03 rad and
0.12 m, and the odometry's noise as it is thought to be beforehand. Its time is that of building the graph and of
its optimizer, with the covariance of every pose and landmark where it says so. "ours as given" does just the
same, "ours" the whole estimate: dead reckoning, guess, the robot's own errors, all noise, all covariances.
Methods take turns.

anonymous: that log, its halves and simulated ones without barcodes, and of how many wrong and right results the
program warns by landmarks that are missed on most visits.

robots: several robots of one simulated folder in one problem, and each alone: mean and range of seeds.

nees: normalized estimation errors squared (tests.support.nees) of that log, and of simulated ones
(tests.support.mrclam) whose systematic errors and noise are drawn anew for every seed: mean and range of seeds.
"""

import time
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory

import gtsam
import numpy as np

from scanchain.graph.losses import RobustLoss
from scanchain.landmarks.association import associated, contradicted
from scanchain.landmarks.estimate import from_odometry, minimize
from scanchain.landmarks.files import read_landmark_data, read_mrclam, read_mrclams
from scanchain.landmarks.problem import BearingRangeProblem, Values, linear_system, no_calibration
from scanchain.landmarks.ranges import OdometryNoise, reckon, solve_range_log, solve_range_logs
from scanchain.landmarks.solvers import METHODS, compare, create_solver
from scanchain.landmarks.study import against_truth
from tests.benchmarks.harness import options_of, table
from tests.support.mrclam import World, write_mrclam
from tests.support.nees import HEADING_RAD, nees, truth_at, truth_of
from tests.support.scenes import DATA

OF_THE_REPORT = ("default", "pinv", "lu", "lu_colamd", "qr", "qr_colamd")
REPORT_S = {
    "2d_linear": (0.04870, 1.1802, 0.0260, 0.1152, 0.3671, 0.2509),
    "2d_linear_loop": (0.0054, 0.1629, 0.0295, 0.0087, 0.2487, 0.0190),
}
AGREEMENT = 1e-8


def report(name, results):
    published = dict(zip(OF_THE_REPORT, REPORT_S[name], strict=True))
    print(f"\n{name}")
    row = table(
        "method", "report s", "total ms", "build", "factor", "solve", "again ms", "nnz factor", "differs by"
    )
    for result in results:
        spent_s = result.total_s, result.build_s, result.factor_s, result.solve_s, result.again_s
        spent = [f"{1e3 * seconds:.2f}" for seconds in spent_s]
        row(result.method, published.get(result.method, "-"), *spent, f"{result.factor.nnz:,}",
            f"{result.difference:.1e}")  # fmt: skip
    spread = max(float(np.abs(a.x - b.x).max()) for a in results for b in results)
    print(f"  all agree to {spread:.1e}" + ("" if spread <= AGREEMENT else f": MORE THAN {AGREEMENT:g}"))
    fastest = min((result for result in results if result.method in OF_THE_REPORT), key=lambda r: r.total_s)
    for result in results:
        if result.method in ("cholesky", "schur"):
            print(f"  {result.method}: {fastest.total_s / result.total_s:.1f} × as fast as {fastest.method},"
                  f" {fastest.total_s / result.again_s:.1f} × with its analysis kept")  # fmt: skip


def linear(options):
    for name in REPORT_S:
        system = linear_system(read_landmark_data(DATA / "landmarks" / f"{name}.npz").measurements)
        report(name, compare(lambda solver, it=system: solver.solve(it), METHODS, options.repeats))


# ---------------------------------------------------------------- the log


HUBER = 1.345
SIGMAS = np.array([0.03, 0.12])
LANDMARK = 10_000_000  # first key of a landmark


def measurements_of(log):
    solved = solve_range_log(log, None)
    reckoning = reckon(log, solved.nodes_s, np.zeros(5))
    return replace(
        solved.problem.measurements, motion=reckoning.motion,
        calibration=no_calibration(reckoning.motion, log.measured),
        motion_covariance=reckoning.covariance(OdometryNoise().densities),
        measured_covariance=np.tile(np.diag(SIGMAS**2), (len(log.measured), 1, 1)),
    )  # fmt: skip


def as_given(log):
    given = measurements_of(log)
    begin = time.perf_counter()
    found = minimize(
        BearingRangeProblem(given), from_odometry(given), create_solver("schur"),
        loss=RobustLoss("huber", HUBER, 1.0), tolerance=1e-6, first_damping=1e-10,
    )  # fmt: skip
    return time.perf_counter() - begin, found.estimate.state


def ours(log):
    begin = time.perf_counter()
    solution = solve_range_log(log, None)
    return time.perf_counter() - begin, solution.minimum.estimate.state


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


OF_THE_LOG = {
    "ours": ours,
    "ours as given": as_given,
    "gtsam LM": lambda log: with_gtsam(log, gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams()),
    "gtsam LM, covariances": lambda log: with_gtsam(
        log, gtsam.LevenbergMarquardtOptimizer, gtsam.LevenbergMarquardtParams(), covariances=True
    ),
    "gtsam GN": lambda log: with_gtsam(log, gtsam.GaussNewtonOptimizer, gtsam.GaussNewtonParams()),
}


def real_log(options):
    log = read_mrclam(DATA / "landmarks" / "utias_mrclam6", options.robot)
    nodes_s, landmarks = np.unique(log.seen_s), np.unique(log.subjects)
    seconds = {name: [] for name in OF_THE_LOG}
    for method in OF_THE_LOG.values():
        method(log)  # compiles
    for _ in range(options.repeats):
        for name, method in OF_THE_LOG.items():
            spent, state = method(log)
            seconds[name].append((spent, state))
    row = table(log.name, "median ms", "min ms", "ATE m", "landmarks m")
    for name, runs in seconds.items():
        ((accuracy,), *_) = against_truth((runs[-1][1],), [nodes_s], landmarks, [log])
        spent = 1e3 * np.array([run[0] for run in runs])
        errors = f"{accuracy.poses_m:.4f}", f"{accuracy.landmarks_m:.4f}"
        row(name, f"{np.median(spent):.1f}", f"{spent.min():.1f}", *errors)


LOST_M = 0.2  # ATE above which a log without barcodes is lost; with barcodes it is at most 0.09
WORLDS = {
    "as MRCLAM": {},
    "no systematic errors": {"systematic": 0.0},
    "450 s": {"duration_s": 450.0},
    "twice the noise": {"noise": 2.0},
    "6 landmarks": {"landmarks": 6},
    "white noise": {"correlated": 0.0},
    "distances with 5 cm": {"range_m": 0.05, "range_share": 0.0, "depth": 0.0},
}


def errors_of_log(log, heading_rad):
    solution = solve_range_log(log, None)
    place = dict(zip(log.true_subjects.tolist(), log.true_landmarks, strict=True))
    landmarks = np.array([place[each] for each in solution.problem.measurements.landmarks.tolist()])
    return nees(solution, truth_at(log, solution.nodes_s), landmarks, heading_rad)


def consistency(options):
    row = table("", "ATE m", "positions", "headings", "poses", "landmarks", "map")
    row("MRCLAM 6", *(f"{each:.3f}" for each in errors_of_log(
        read_mrclam(DATA / "landmarks" / "utias_mrclam6", options.robot), HEADING_RAD)))  # fmt: skip
    for name, world in WORLDS.items():
        every = []
        for seed in range(options.seeds):
            with TemporaryDirectory() as folder:
                write_mrclam(Path(folder), World(seed, **world))
                every.append(errors_of_log(read_mrclam(Path(folder), 1), 0.005))
        each = np.array(every)
        spread = zip(each.mean(axis=0), each.min(axis=0), each.max(axis=0), strict=True)
        row(name, *(f"{mean:.2f} ({low:.2f} to {high:.2f})" for mean, low, high in spread))


def several_robots(options):
    row = table("robots", "ATE alone m", "together m", "positions", "headings", "poses", "landmarks", "map")
    for count, name in (
        *((count, "as MRCLAM") for count in (2, 3, 5)),
        (3, "twice the noise"),
        (3, "6 landmarks"),
    ):
        every = []
        for seed in range(options.first, options.first + options.seeds):
            with TemporaryDirectory() as folder:
                robots = range(1, count + 1)
                write_mrclam(Path(folder), World(seed, robots=tuple(robots), duration_s=300.0, **WORLDS[name]))
                logs = read_mrclams(Path(folder), robots)
            alone = [errors_of_log(log.seen(log.subjects > 0), 0.005).ate_m for log in logs]
            solution = solve_range_logs(logs, None)
            landmarks = logs[0].true_landmarks[solution.problem.measurements.landmarks - 6]
            found = nees(solution, truth_of(logs, solution), landmarks, 0.005)
            every.append((np.mean(alone), *found))
        each = np.array(every)
        spread = zip(each.mean(axis=0), each.min(axis=0), each.max(axis=0), strict=True)
        cells = [f"{mean:.2f} ({low:.2f} to {high:.2f})" for mean, low, high in spread]
        row(f"{count}, {name}", *(f"{mean:.3f}" for mean in each[:, :2].mean(axis=0)), *cells[2:])


def without_barcodes(options):
    row = table("without barcodes", "ATE m", "landmarks found", "logged", "sightings of none", "contradicted")

    def found(name, log):
        part, solution = associated(log, None)
        ((accuracy,), *_) = against_truth((solution.minimum.estimate.state,), [solution.nodes_s], None, [log])
        count, wrong = len(solution.problem.measurements.landmarks), len(contradicted(part, solution))
        logged = len(np.unique(log.subjects))
        row(name, f"{accuracy.poses_m:.3f}", count, logged, len(log.seen_s) - len(part.seen_s), wrong)
        return accuracy.poses_m, count > logged, wrong > 0

    log = read_mrclam(DATA / "landmarks" / "utias_mrclam6", options.robot)
    is_early = log.seen_s < np.median(log.seen_s)
    for name, kept in ("", is_early | True), (", first half", is_early), (", second half", ~is_early):
        found(f"MRCLAM 6{name}", log.seen(kept))
    every = dict[str, list[tuple[float, bool, bool]]]()
    for name in ("as MRCLAM", "twice the noise", "450 s", "6 landmarks"):
        for seed in range(options.first, options.first + options.seeds):
            with TemporaryDirectory() as folder:
                write_mrclam(Path(folder), World(seed, **WORLDS[name]))
                every.setdefault(name, []).append(found(f"{name}, seed {seed}", read_mrclam(Path(folder), 1)))
    row = table(
        "simulated", "logs", "ATE m, median", "largest", "lost", "with duplicates", "warned of: lost", "not lost"
    )
    for name, each in every.items():
        ate_m, is_larger, is_warned = np.array(each).T
        is_lost = ate_m > LOST_M
        warned = (is_warned * is_lost).sum(), (is_warned * ~is_lost).sum()
        row(name, len(each), f"{np.median(ate_m):.3f}", f"{ate_m.max():.3f}", is_lost.sum(),
            int((is_larger * ~is_lost).sum()), *map(int, warned))  # fmt: skip


def main():
    choices = {
        "linear": linear, "log": real_log, "nees": consistency, "robots": several_robots,
        "anonymous": without_barcodes,
    }  # fmt: skip
    options = options_of(__doc__, "which", cache=False, which=tuple(choices), robot=1, repeats=9, seeds=6, first=0)
    choices[options.which](options)


if __name__ == "__main__":
    main()
