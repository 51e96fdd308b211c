"""Studies of landmark problems: before and after, every method, accuracy; as text, JSON and CSV."""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from scanchain import lie
from scanchain.clock import working_s
from scanchain.data import Matrix, Pose, Trajectory
from scanchain.errors import FREEDOM, InputError, counted
from scanchain.evaluation import Alignment, absolute_error, pair
from scanchain.landmarks.association import associated, contradicted
from scanchain.landmarks.estimate import (
    Minimum,
    Optimizer,
    disturbed,
    from_odometry,
    minimize,
    of_relative_positions,
)
from scanchain.landmarks.files import RangeLog, read_mrclams, robots_of
from scanchain.landmarks.problem import BearingRangeProblem, LandmarkData, LinearSystem, Values, linear_system
from scanchain.landmarks.ranges import (
    OWN,
    OWN_UNITS,
    TO_ROBOTS,
    WHEELS,
    OdometryNoise,
    RangeSolution,
    solve_range_logs,
)
from scanchain.landmarks.solvers import Covariance, LinearSolver, MethodResult, compare, create_solver, methods_for
from scanchain.trajectory import write_tum

_WIDEST_GAP_S = 0.5  # largest gap between motion-capture poses that is interpolated


@dataclass(frozen=True, slots=True)
class Estimate:
    """Poses and landmarks, and their accuracy.

    T_truth_estimate : (3, 3) aligns them to the truth
    poses_m, landmarks_m : root mean squared distances from the truth, NaN without it, as defined by ``definition``
    """

    state: Values
    T_truth_estimate: Pose
    poses_m: float
    landmarks_m: float
    definition: str

    def in_truth(self) -> tuple[Matrix, Matrix]:
        """Positions (K, 2) of the poses and (L, 2) of the landmarks in the truth's frame."""
        T = self.T_truth_estimate
        return lie.transform(T, self.state.poses[:, :2]), lie.transform(T, self.state.landmarks)


def of_positions(state: Values, data: LandmarkData) -> Estimate:
    """Estimate compared with the true positions of an npz file, if it has them; both are in the same frame."""
    if np.isnan(data.true_poses).all() and np.isnan(data.true_landmarks).all():
        return Estimate(state, lie.identity(2), np.nan, np.nan, "no true positions in the file")
    errors_m = _rms(state.poses - data.true_poses), _rms(state.landmarks - data.true_landmarks)
    definition = "root mean squared distance from the true positions, nothing aligned"
    return Estimate(state, lie.identity(2), *errors_m, definition)


def against_truth(
    states: Sequence[Values],
    nodes_s: Sequence[NDArray[np.float64]],
    landmarks: NDArray[np.int64] | None,
    logs: Sequence[RangeLog],
) -> tuple[list[Estimate], Matrix, Matrix]:
    """Estimates with ATE against motion capture after rigid alignment, which is applied to the landmarks as well.

    nodes_s : (K,) times of the poses of each robot
    landmarks : (L,) their numbers; None where these are not known and each is compared with the surveyed one
        nearest to it in the last state
    Also returns the true positions (K, 2) of poses and (L, 2) of landmarks, NaN where unknown.
    """
    place, unknown = dict[int, NDArray[np.float64]](), np.full(2, np.nan)
    for log in logs:
        place |= zip(log.true_subjects.tolist(), log.true_landmarks, strict=True)
    surveyed = np.full_like(states[0].landmarks, np.nan)
    if landmarks is not None:
        surveyed = np.array([place.get(subject, unknown) for subject in landmarks.tolist()])
    truth = _trajectory([log.true_s for log in logs], np.concatenate([log.true_poses for log in logs]))
    true_poses, estimates = np.full_like(states[0].poses[:, :2], np.nan), list[Estimate]()
    try:
        pairs = [pair(_trajectory(nodes_s, each.poses), truth, gap_s=_WIDEST_GAP_S) for each in states]
        errors = [absolute_error(each, Alignment.RIGID) for each in pairs]
    except InputError:
        why = "no motion capture at these times"
        estimates += [Estimate(each, lie.identity(2), np.nan, np.nan, why) for each in states]
        return estimates, true_poses, surveyed
    true_poses[pairs[0].places] = pairs[0].reference[:, :2, 3]
    if landmarks is None and place:
        T_truth_estimate, known = lie.flatten(errors[-1].T_reference_estimate), np.array([*place.values()])
        surveyed = known[KDTree(known).query(lie.transform(T_truth_estimate, states[-1].landmarks))[1]]
    for state, error in zip(states, errors, strict=True):
        T_truth_estimate = lie.flatten(error.T_reference_estimate)
        landmarks_m = _rms(lie.transform(T_truth_estimate, state.landmarks) - surveyed)
        definition = f"{error.definition}, over {error.pairing}"
        estimates.append(Estimate(state, T_truth_estimate, error.translation_m.rmse, landmarks_m, definition))
    return estimates, true_poses, surveyed


_APART_S = 1e6  # time that puts one robot's poses behind those of another, for their common alignment


def _trajectory(times_s: Sequence[NDArray[np.float64]], poses: Matrix) -> Trajectory:
    """Poses x, y, heading (K, 3) of one robot after the other, at times that were logged in milliseconds."""
    apart_s = np.concatenate([each + _APART_S * robot for robot, each in enumerate(times_s)])
    stamps_ns = np.round(apart_s * 1e3).astype(np.int64) * 1_000_000
    return Trajectory(stamps_ns, np.array([lie.pose_2d(*pose) for pose in poses]).reshape(-1, 3, 3))


def _rms(differences: Matrix) -> float:
    """Root mean square over the rows that are known; NaN if none is."""
    known = differences[np.isfinite(differences).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else float("nan")


_SHIFT_M, _TURN_RAD = 1.0, 0.5  # of the disturbed guess
_DOWNWEIGHTED = 0.25  # share of its expected weight below which an observation is reported as downweighted
_FITS = (0.5, 2.0)  # range of χ² per degree of freedom in which a noise model fits


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a study.

    ``methods`` are the linear solvers by name, or "all"; the first one makes the estimate of a file.
    ``robots``, ``noise`` and ``ignore_barcodes`` are for MRCLAM folders: all robots if none is named; the noise is
    estimated if it is None.
    ``guess`` and ``optimizer`` are for nonlinear files.
    """

    methods: tuple[str, ...]
    repeats: int
    robots: tuple[int, ...]
    noise: OdometryNoise | None
    guess: Literal["odometry", "disturbed", "origin"]
    optimizer: Optimizer
    ignore_barcodes: bool = False


@dataclass(frozen=True, slots=True)
class Study:
    """Results of a study.

    facts : descriptive lines by label
    covariance : after optimization
    true_poses, true_landmarks : (K, 2), (L, 2) m, NaN where unknown
    system, build_s : A x = b as the methods solved it, and the time to assemble it
    converged : False also if landmarks are contradicted
    trajectories : by robot, the poses after optimization with their stamps; none for a file, which has no stamps
    contradicted : landmarks found without barcodes that are missed on most visits
    """

    name: str
    facts: dict[str, str]
    before: Estimate
    after: Estimate
    converged: bool
    covariance: Covariance
    true_poses: Matrix
    true_landmarks: Matrix
    system: LinearSystem
    build_s: float
    methods: tuple[MethodResult, ...]
    trajectories: dict[int, Trajectory] = field(default_factory=dict[int, Trajectory])
    contradicted: tuple[int, ...] = ()

    def paths(self, points: Matrix) -> list[Matrix]:
        """Points of all poses, (K, 2), split by robot."""
        counts = [len(each) for each in self.trajectories.values()]
        return np.split(points, np.cumsum(counts)[:-1])


def study_file(data: LandmarkData, options: Options) -> Study:
    """Solve the problem of a file by every requested method, compare with the truth in the file."""
    return _linear(data, options) if data.kind == "linear" else _nonlinear(data, options)


def _linear(data: LandmarkData, options: Options) -> Study:
    begin = working_s()
    system = linear_system(data.measurements)
    build_s = working_s() - begin
    names, left_out = methods_for(options.methods, system.pattern.shape[1])
    methods = compare(lambda solver: solver.solve(system), names, options.repeats)
    chi2 = float(np.square(system.A @ methods[0].x - system.b).sum())
    problem = "linear: steps between poses, landmarks' positions relative to them"
    facts = {"problem": problem, "χ²": _chi2(chi2, system), **left_out}
    poses, landmarks = (part.reshape(-1, 2) for part in np.split(methods[0].x, [system.pattern.layout.split]))
    before, after = (
        of_positions(each, data) for each in (of_relative_positions(data.measurements), Values(poses, landmarks))
    )
    return Study(
        data.name, facts, before, after, True, Covariance(system), data.true_poses, data.true_landmarks, system,
        build_s, methods,
    )  # fmt: skip


def _nonlinear(data: LandmarkData, options: Options) -> Study:
    problem = BearingRangeProblem(data.measurements)
    guess = from_odometry(problem.measurements)
    if options.guess == "disturbed":
        guess = disturbed(guess, _SHIFT_M, _TURN_RAD)
    elif options.guess == "origin":
        guess = replace(guess, landmarks=np.zeros_like(guess.landmarks))
    names, left_out = methods_for(options.methods, problem.pattern.shape[1])
    minimum = minimize(problem, guess, create_solver(names[0]), optimizer=options.optimizer)
    begin = working_s()
    system = problem.system(problem.linearize(minimum.estimate.state), minimum.estimate.weights)
    build_s = working_s() - begin

    def solve(solver: LinearSolver) -> NDArray[np.float64]:
        if options.optimizer == "gradient-descent" or not minimum.iterations:  # no linear solves: use its end
            return solver.solve(system)
        return minimize(problem, guess, solver, optimizer=options.optimizer).estimate.state.unknowns

    facts = {
        "problem": "nonlinear: steps between poses, bearing and range of landmarks; headings known",
        "guess": options.guess,
        "iteration": f"{options.optimizer} {_ended(minimum, minimum.iterations)}",
        "χ²": _chi2(minimum.estimate.cost, system),
        **left_out,
    }
    before, end = (of_positions(each, data) for each in (guess, minimum.estimate.state))
    return Study(
        data.name, facts, before, end, minimum.converged, Covariance(system), data.true_poses,
        data.true_landmarks, system, build_s, compare(solve, names, options.repeats),
    )  # fmt: skip


def _chi2(chi2: float, system: LinearSystem) -> str:
    """χ² over its degrees of freedom, and its meaning."""
    rows, unknowns = system.pattern.shape
    freedom = max(rows - unknowns, 1)
    is_fit = _FITS[0] <= chi2 / freedom <= _FITS[1]
    verdict = "the noise model fits" if is_fit else "the noise model does not fit, or a poor minimum"
    return f"{chi2:.4f} over {counted(freedom, *FREEDOM)}: {chi2 / freedom:.3f}; {verdict}"


def _ended(minimum: Minimum, iterations: int) -> str:
    how = "converged" if minimum.converged else "DID NOT CONVERGE"
    return f"{how} after {counted(iterations, 'step')}: {minimum.reason}"


def study_log(folder: Path, options: Options) -> Study:
    """Read the log, estimate trajectory, landmarks and noise, compare with motion capture.

    The requested linear solvers are compared on the first step from the initial guess, with the estimated noise;
    ``ESTIMATOR`` makes the estimate.
    """
    robots = options.robots or robots_of(folder) or (1,)
    if options.ignore_barcodes and len(robots) > 1:
        raise InputError("--ignore-barcodes is for one robot; name it with --robot")
    given = read_mrclams(folder, robots)
    if options.ignore_barcodes:
        log, solution = associated(given[0], options.noise)
        logs = [log]
    else:
        logs, solution = given, solve_range_logs(given, options.noise)
    begin = working_s()
    at = solution.problem.linearize(solution.guess)
    system = solution.problem.system(at, solution.loss.weight(at.chi2))
    build_s = working_s() - begin
    names, left_out = methods_for(options.methods, system.pattern.shape[1])
    facts = _facts(logs, solution, is_stated=options.noise is not None) | left_out
    minimum, wrong = solution.minimum, tuple[int, ...]()
    starts = solution.problem.measurements.starts
    nodes_s, poses = (np.split(each, starts[1:]) for each in (solution.nodes_s, minimum.estimate.state.poses))
    states, landmarks = (solution.reckoned, minimum.estimate.state), system.pattern.layout.landmarks
    if options.ignore_barcodes:
        wrong = tuple(contradicted(logs[0], solution).tolist())
        left = counted(len(given[0].seen_s) - len(logs[0].seen_s), "sighting")
        facts["association"] = f"without barcodes: {len(landmarks)} landmarks; {left} of none of them"
    if wrong:
        which = f"{counted(len(wrong), 'landmark')} ({', '.join(map(str, wrong))})"
        facts["CONTRADICTED"] = f"{which} not seen on most visits: duplicates, or poses that are wrong"
    named = None if options.ignore_barcodes else landmarks
    (before, after), true_poses, surveyed = against_truth(states, nodes_s, named, logs)
    name = logs[0].name if len(logs) == 1 else f"{folder.resolve().name} robots {', '.join(map(str, robots))}"
    return Study(
        name, facts, before, after, minimum.converged and not wrong, solution.covariance, true_poses,
        surveyed, system, build_s, compare(lambda solver: solver.solve(system), names, options.repeats),
        {log.robot: _trajectory([times_s], own) for log, times_s, own in zip(logs, nodes_s, poses, strict=True)},
        wrong,
    )  # fmt: skip


def _facts(logs: Sequence[RangeLog], solution: RangeSolution, *, is_stated: bool) -> dict[str, str]:
    noise, estimate, share = solution.consistency, solution.minimum.estimate, solution.loss.share
    wheels, sensors = solution.sigmas
    unknowns = len(estimate.state.calibration) // len(logs)
    names, units = ((each * len(logs)) for each in ((*OWN, TO_ROBOTS)[:unknowns], OWN_UNITS[:unknowns]))
    own = [
        f"{name} {value:+.3f} ± {sigma:.3f}{unit}"
        for name, value, sigma, unit in zip(
            names, estimate.state.calibration, solution.covariance.calibration, units, strict=True
        )
    ]
    downweighted = int(np.count_nonzero(estimate.weights < _DOWNWEIGHTED * share))
    state, sensor = "stated" if is_stated else "estimated", noise.sensor / noise.sensor_freedom
    of_wheels, of_sensors = list(map(_wheel_noise, wheels)), list(map(_sensor_noise, sensors))
    fits = _verdict(noise.motion / noise.motion_freedom), _verdict(sensor)
    if len(logs) == 1:
        of_robots = {
            "robot": f"estimated: {', '.join(own[:WHEELS])}",
            "sensor": f"estimated: {', '.join(own[WHEELS:])}",
            "odometry noise": f"{state}: {of_wheels[0]}; {fits[0]}",
            "sensor noise": f"estimated: {of_sensors[0]} (Student's t); {fits[1]}",
        }
    else:
        of_robots = {
            f"robot {log.robot}": f"estimated: {', '.join(own[k * unknowns : (k + 1) * unknowns])}; "
            f"noise: {of_wheels[k]}; {of_sensors[k]} (Student's t)"
            for k, log in enumerate(logs)
        }
        to_robots = f"of robots {of_sensors[-1]}; " if len(sensors) > len(logs) else ""
        of_robots |= {"odometry noise": f"{state}: {fits[0]}", "sensor noise": f"estimated: {to_robots}{fits[1]}"}
    nodes, met = counted(len(solution.nodes_s), "pose"), sum(int((log.subjects < 0).sum()) for log in logs)
    of_others, unknown, outside = (
        sum(counts) for counts in zip(*((log.of_robots, log.unknown, log.outside) for log in logs), strict=True)
    )
    return {
        "observations": (
            f"{len(share) - met:,} of {len(estimate.state.landmarks)} landmarks"
            f"{f' and {met:,} of robots' if met else ''} from {nodes}; they count as "
            f"{share.sum():.0f}, as errors of a landmark's successive sightings are correlated"
        ),
        "left out": f"{of_others} of other robots, {unknown} of unknown barcodes, {outside} without odometry",
        "estimate": f"{1e3 * solution.time_s:.0f} ms, {_ended(solution.minimum, solution.iterations)}",
        **of_robots,
        "downweighted": (
            f"{counted(downweighted, 'observation')} with less than {_DOWNWEIGHTED:g} of the weight of others"
        ),
    }


def _wheel_noise(sigmas: NDArray[np.float64]) -> str:
    forward_m, sideways_m, drift_rad, turn_rad = sigmas
    return (
        f"{forward_m:.3g} m forward, {sideways_m:.3g} m sideways, {drift_rad:.3g} rad"
        f" after a meter, {turn_rad:.3g} rad after a radian"
    )


def _sensor_noise(sigmas: NDArray[np.float64]) -> str:
    bearing_rad, range_m, range_share = sigmas
    return f"bearing {bearing_rad:.4f} rad, range {range_m:.4f} m and {range_share:.2%}"


def _verdict(chi2: float) -> str:
    """χ² per degree of freedom as text."""
    verdict = "fits" if _FITS[0] <= chi2 <= _FITS[1] else f"off by a factor {chi2**0.5:.2f}"
    return f"χ² per degree of freedom {chi2:.2f}: {verdict}"


_HEADINGS = (
    "method", "build ms", "factor ms", "solve ms", "total ms", "again ms", "solves", "nnz factor", "differs by",
)  # fmt: skip


def file_stem(name: str) -> str:
    """A name as a valid stem of a file name."""
    return re.sub(r"[^A-Za-z0-9._-]+", "_", name).strip("._") or "problem"


def table_of(study: Study) -> list[tuple[str, ...]]:
    """Headings, then one row per method; without the column of differences for a single method."""
    rows: list[tuple[str, ...]] = [_HEADINGS]
    for each in study.methods:
        times_s = (each.build_s, each.factor_s, each.solve_s, each.total_s, each.again_s)
        counts = str(each.iterations), f"{each.factor.nnz:,}"
        rows.append(
            (each.method, *(f"{1e3 * time_s:.2f}" for time_s in times_s), *counts, f"{each.difference:.1e}")
        )
    return rows if len(study.methods) > 1 else [row[:-1] for row in rows]


def text_of(study: Study) -> str:
    """The whole study for a terminal."""
    lines = [study.name, *(f"  {label:<16}{value}" for label, value in study.facts.items())]
    lines += [f"  {label:<16}{value}" for label, value in accuracy_lines(study)]
    lines.append(f"  {'A':<16}{size_of(study)}")
    rows = table_of(study)
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    for method, *figures in rows:
        cells = [f"{cell:>{width}}" for cell, width in zip(figures, widths[1:], strict=True)]
        lines.append("  ".join(["", f"{method:<{widths[0]}}", *cells]))
    return "\n".join(lines)


def size_of(study: Study) -> str:
    """Size of A as text."""
    rows, columns = study.system.pattern.shape
    entries = counted(len(study.system.values), "entry", "entries")
    build = f"assembled in {1e3 * study.build_s:.1f} ms"
    return f"{counted(rows, 'row')}, {counted(columns, 'column')}, {entries}, {build}"


def accuracy_lines(study: Study) -> list[tuple[str, str]]:
    """Label and value of the accuracy before and after, and how it is defined."""
    return [
        ("before", _accuracy(study.before)),
        ("after", _accuracy(study.after)),
        ("accuracy", study.after.definition),
    ]


def tree_of(study: Study) -> dict[str, object]:
    """The figures for JSON."""
    rows, columns = study.system.pattern.shape
    names = ("method", "build_s", "factor_s", "solve_s", "again_s", "iterations")
    return {
        "name": study.name,
        "facts": study.facts,
        "converged": study.converged,
        "contradicted": study.contradicted,
        "before": _figures(study.before),
        "after": _figures(study.after),
        "A": {"rows": rows, "columns": columns, "entries": len(study.system.values), "build_s": study.build_s},
        "methods": [
            {
                **{name: getattr(method, name) for name in names},
                "factor": method.factor.name,
                "factor_entries": method.factor.nnz,
                "difference": method.difference,
            }
            for method in study.methods
        ],
    }


def write_estimate(directory: Path, study: Study) -> None:
    """Poses and landmarks with their covariances as CSV, and the poses as TUM where they have stamps, by robot."""
    stem, state, covariance = directory / file_stem(study.name), study.after.state, study.covariance
    parts = zip(study.trajectories or (0,), study.paths(state.poses), study.paths(covariance.poses), strict=True)
    for robot, poses, covariances in parts:
        path = f"{stem}_robot_{robot}" if len(study.trajectories) > 1 else f"{stem}"
        _write_csv(f"{path}_poses.csv", "pose", np.arange(len(poses)), poses, covariances)
        if robot in study.trajectories:
            write_tum(Path(f"{path}.tum"), study.trajectories[robot], force=True)
    names = study.system.pattern.layout.landmarks
    _write_csv(f"{stem}_landmarks.csv", "landmark", names, state.landmarks, covariance.landmarks)


def _write_csv(path: str, kind: str, numbers: np.ndarray, values: Matrix, covariance: Matrix) -> None:
    """One line each: number, values, upper triangle of the covariance."""
    names = ["x_m", "y_m", "heading_rad"][: values.shape[1]]
    rows, columns = np.triu_indices(len(names))
    header = [kind, *names, *(f"cov_{names[i]}_{names[j]}" for i, j in zip(rows, columns, strict=True))]
    table = np.column_stack([numbers, values, covariance[:, rows, columns]])
    np.savetxt(path, table, ["%d"] + (table.shape[1] - 1) * ["%.9g"], ",", header=",".join(header), comments="")


def _accuracy(estimate: Estimate) -> str:
    poses, landmarks = (
        "unknown" if math.isnan(error_m) else f"{error_m:.4f} m off"
        for error_m in (estimate.poses_m, estimate.landmarks_m)
    )
    return "unknown" if poses == landmarks == "unknown" else f"poses {poses}, landmarks {landmarks}"


def _figures(estimate: Estimate) -> dict[str, float | str | None]:
    return {
        "poses_m": None if math.isnan(estimate.poses_m) else estimate.poses_m,
        "landmarks_m": None if math.isnan(estimate.landmarks_m) else estimate.landmarks_m,
        "definition": estimate.definition,
    }
