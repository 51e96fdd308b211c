"""Studies of landmark problems by ``scanchain landmarks``: before and after, every method, accuracy."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.clock import working_s
from scanchain.data import Matrix, Pose, Trajectory
from scanchain.errors import FREEDOM, counted
from scanchain.evaluation import Alignment, absolute_error, pair
from scanchain.landmarks.estimate import (
    Minimum,
    Optimizer,
    disturbed,
    from_odometry,
    minimize,
    of_relative_positions,
)
from scanchain.landmarks.files import RangeLog, read_mrclam
from scanchain.landmarks.problem import (
    BearingRangeProblem,
    LandmarkData,
    LinearSystem,
    Values,
    linear_system,
    world_referenced,
)
from scanchain.landmarks.ranges import OWN, OWN_UNITS, OdometryNoise, RangeSolution, solve_range_log
from scanchain.landmarks.solvers import LinearSolver, MethodResult, compare, create_solver, methods_for
from scanchain.landmarks.solvers.direct import Covariance

_WIDEST_GAP_S = 0.5  # between motion-capture poses that are interpolated


@dataclass(frozen=True, slots=True)
class Estimate:
    """Poses and landmarks, and their accuracy.

    Attributes
    ----------
    T_truth_estimate : (3, 3) aligns them to the truth
    poses_m, landmarks_m : root mean squared distances from the truth, NaN without; ``definition`` defines them
    """

    state: Values
    T_truth_estimate: Pose
    poses_m: float
    landmarks_m: float
    definition: str


@dataclass(frozen=True, slots=True)
class Truth:
    """Motion capture at the times of an estimate.

    Attributes
    ----------
    known : (K,) bool, poses of the estimate for which there is a truth
    poses : (k, 3) x, y, heading of those
    landmarks : (L, 2), NaN where a landmark was not surveyed
    """

    known: NDArray[np.bool_]
    poses: Matrix
    landmarks: Matrix


def of_positions(state: Values, data: LandmarkData) -> Estimate:
    """Against the positions of an npz file, where it has them; both lie in one frame."""
    known = len(data.true_poses) > 0
    if not known and np.isnan(data.true_landmarks).all():
        return Estimate(state, lie.identity(2), np.nan, np.nan, "no true positions in the file")
    poses_m = _rms(state.poses - data.true_poses) if known else np.nan
    definition = "root mean squared distance from the true positions, nothing aligned"
    return Estimate(state, lie.identity(2), poses_m, _rms(state.landmarks - data.true_landmarks), definition)


def truth_at(log: RangeLog, nodes_s: NDArray[np.float64], landmarks: NDArray[np.int64]) -> Truth:
    """Motion capture interpolated to these times, surveyed positions of these landmarks."""
    place = {
        int(subject): position for subject, position in zip(log.true_subjects, log.true_landmarks, strict=True)
    }
    surveyed = np.array([place.get(int(subject), np.full(2, np.nan)) for subject in landmarks])
    if len(log.true_s) < 2:
        return Truth(np.zeros(len(nodes_s), np.bool_), np.empty((0, 3)), surveyed)
    after = np.clip(np.searchsorted(log.true_s, nodes_s), 1, len(log.true_s) - 1)
    inside = (nodes_s >= log.true_s[0]) & (nodes_s <= log.true_s[-1])
    known = inside & (log.true_s[after] - log.true_s[after - 1] <= _WIDEST_GAP_S)
    heading = np.unwrap(log.true_poses[:, 2])
    columns = (log.true_poses[:, 0], log.true_poses[:, 1], heading)
    poses = np.stack([np.interp(nodes_s[known], log.true_s, column) for column in columns], axis=-1)
    return Truth(known, poses, surveyed)


def against_truth(state: Values, nodes_s: NDArray[np.float64], truth: Truth) -> Estimate:
    """ATE of the poses after rigid alignment, landmarks by the same alignment."""
    if np.count_nonzero(truth.known) < 2:
        return Estimate(state, lie.identity(2), np.nan, np.nan, "no motion capture at these times")
    known_s = nodes_s[truth.known]
    pairs = pair(trajectory_of(known_s, state.poses[truth.known]), trajectory_of(known_s, truth.poses))
    error = absolute_error(pairs, Alignment.RIGID)
    T_truth_estimate = lie.flatten(error.T_reference_estimate)
    landmarks_m = _rms(lie.transform(T_truth_estimate, state.landmarks) - truth.landmarks)
    definition = f"{error.definition}, over {error.pairing}"
    return Estimate(state, T_truth_estimate, error.translation_m.rmse, landmarks_m, definition)


def trajectory_of(nodes_s: NDArray[np.float64], poses: Matrix) -> Trajectory:
    """Poses x, y, heading (K, 3) at times that were written with milliseconds."""
    stamps_ns = np.round(nodes_s * 1e3).astype(np.int64) * 1_000_000
    return Trajectory(stamps_ns, np.array([lie.pose_2d(*pose) for pose in poses]))


def _rms(differences: Matrix) -> float:
    """Root mean square over the rows that are known; NaN if none is."""
    known = differences[np.isfinite(differences).all(axis=1)]
    return float(np.sqrt(np.mean(np.sum(known**2, axis=1)))) if len(known) else float("nan")


Guess = Literal["odometry", "disturbed", "origin"]

_SHIFT_M, _TURN_RAD = 1.0, 0.5  # of the disturbed guess
_DOWNWEIGHTED = 0.25  # share of its expected weight below which an observation is reported as downweighted
_FITS = (0.5, 2.0)  # χ² per degree of freedom between which a noise model fits


@dataclass(frozen=True, slots=True)
class Options:
    """Options of a study.

    ``methods`` are the linear solvers by name, or "all"; the first one estimates what a file holds.
    ``robot`` and ``noise`` are for MRCLAM folders, where a noise of None is to be estimated; ``guess`` and
    ``optimizer`` for nonlinear files.
    """

    methods: tuple[str, ...]
    repeats: int
    robot: int
    noise: OdometryNoise | None
    guess: Guess
    optimizer: Optimizer


class Fact(NamedTuple):
    """A line about a problem: label, and value as text."""

    label: str
    value: str


@dataclass(frozen=True, slots=True)
class Study:
    """Results of a study.

    Attributes
    ----------
    name, facts : of the problem, and lines about it
    before, after : optimization
    converged : whether every iteration came to an end by itself
    covariance : of poses and landmarks after it
    true_poses, true_landmarks : (k, 2), (L, 2) m; empty or NaN where unknown
    system, build_s : A x = b as the methods solved it, and the time to put it together
    methods : how every method fared
    trajectory : the poses after it with their stamps; None for a file, which has no stamps
    """

    name: str
    facts: tuple[Fact, ...]
    before: Estimate
    after: Estimate
    converged: bool
    covariance: Covariance
    true_poses: Matrix
    true_landmarks: Matrix
    system: LinearSystem
    build_s: float
    methods: tuple[MethodResult, ...]
    trajectory: Trajectory | None = None


def study_file(data: LandmarkData, options: Options) -> Study:
    """Solve the problem of a file by every requested method, compare with the truth in the file."""
    return _linear(data, options) if data.kind == "linear" else _nonlinear(data, options)


def _linear(data: LandmarkData, options: Options) -> Study:
    begin = working_s()
    system = linear_system(data)
    build_s = working_s() - begin
    names, left_out = methods_for(options.methods, system.pattern.shape[1])
    methods = compare(lambda solver: solver.solve(system), names, options.repeats)
    chi2 = float(np.square(system.A @ methods[0].x - system.b).sum())
    facts = (
        Fact("problem", "linear: steps between poses, landmarks' positions relative to them"),
        _chi2(chi2, system),
        *_left_out(left_out),
    )
    poses, landmarks = (part.reshape(-1, 2) for part in np.split(methods[0].x, [system.pattern.layout.split]))
    before, after = (of_positions(each, data) for each in (of_relative_positions(data), Values(poses, landmarks)))
    return Study(
        data.name, facts, before, after, True, Covariance(system), data.true_poses, data.true_landmarks, system,
        build_s, methods,
    )  # fmt: skip


def _nonlinear(data: LandmarkData, options: Options) -> Study:
    problem = BearingRangeProblem(world_referenced(data))
    guess = _guess(problem, options.guess)
    names, left_out = methods_for(options.methods, problem.pattern.shape[1])
    minimum = minimize(problem, guess, create_solver(names[0]), optimizer=options.optimizer)
    begin = working_s()
    system = problem.system(problem.linearize(minimum.state), minimum.weights)
    build_s = working_s() - begin

    def solve(solver: LinearSolver) -> NDArray[np.float64]:
        if options.optimizer == "gradient-descent" or not minimum.iterations:  # solves none: take its end
            return solver.solve(system)
        return minimize(problem, guess, solver, optimizer=options.optimizer).state.unknowns

    after = f"after {counted(minimum.iterations, 'step')}: {minimum.reason}"
    facts = (
        Fact("problem", "nonlinear: steps between poses, bearing and range of landmarks; headings known"),
        Fact("guess", options.guess),
        Fact("iteration", f"{options.optimizer} {_ended(minimum)} {after}"),
        _chi2(minimum.cost, system),
        *_left_out(left_out),
    )
    before, end = (of_positions(each, data) for each in (guess, minimum.state))
    return Study(
        data.name, facts, before, end, minimum.converged, Covariance(system), data.true_poses,
        data.true_landmarks, system, build_s, compare(solve, names, options.repeats),
    )  # fmt: skip


def _guess(problem: BearingRangeProblem, guess: Guess) -> Values:
    state = from_odometry(problem.measurements)
    if guess == "disturbed":
        return disturbed(state, _SHIFT_M, _TURN_RAD)
    if guess == "origin":
        return replace(state, landmarks=np.zeros_like(state.landmarks))
    return state


def _chi2(chi2: float, system: LinearSystem) -> Fact:
    """χ² over its degrees of freedom, and its meaning."""
    rows, unknowns = system.pattern.shape
    freedom = max(rows - unknowns, 1)
    low, high = _FITS
    is_fit = low <= chi2 / freedom <= high
    verdict = "the noise model fits" if is_fit else "the noise model does not fit, or a poor minimum"
    return Fact("χ²", f"{chi2:.4f} over {counted(freedom, *FREEDOM)}: {chi2 / freedom:.3f}; {verdict}")


def _ended(minimum: Minimum) -> str:
    return "converged" if minimum.converged else "DID NOT CONVERGE"


def study_log(folder: Path, options: Options) -> Study:
    """Read the log, estimate trajectory, landmarks and noise, compare with motion capture.

    The requested linear solvers run on the first step from where the estimate began, with the noise that
    it found; ``ESTIMATOR`` makes the estimate.
    """
    log = read_mrclam(folder, options.robot)
    solution = solve_range_log(log, options.noise)
    begin = working_s()
    at = solution.problem.linearize(solution.guess)
    system = solution.problem.system(at, solution.loss.weight(at.observation_chi2))
    build_s = working_s() - begin
    names, left_out = methods_for(options.methods, system.pattern.shape[1])
    facts = (*_facts(log, solution, is_stated=options.noise is not None), *_left_out(left_out))
    minimum, nodes_s = solution.minimum, solution.nodes_s
    truth = truth_at(log, nodes_s, system.pattern.layout.landmarks)
    before, after = (against_truth(each, nodes_s, truth) for each in (solution.reckoned, minimum.state))
    return Study(
        log.name, facts, before, after, minimum.converged, solution.covariance, truth.poses[:, :2],
        truth.landmarks, system, build_s, compare(lambda solver: solver.solve(system), names, options.repeats),
        trajectory_of(nodes_s, minimum.state.poses),
    )  # fmt: skip


def _facts(log: RangeLog, solution: RangeSolution, *, is_stated: bool) -> tuple[Fact, ...]:
    noise = solution.consistency
    count = len(log.seen_s)
    worth = f"count as {solution.loss.share.sum():.0f}, as errors of a landmark's successive sightings are alike"
    nodes = counted(len(solution.nodes_s), "pose")
    seen = f"{count:,} of {len(solution.minimum.state.landmarks)} landmarks from {nodes}; they {worth}"
    left = f"{log.of_robots} of other robots, {log.unknown} of unknown barcodes, {log.outside} without odometry"
    forward_m, sideways_m, drift_rad, turn_rad, bearing_rad, range_m = solution.sigmas
    wheels = (
        f"{forward_m:.3g} m forward, {sideways_m:.3g} m sideways, {drift_rad:.3g} rad"
        f" after a meter, {turn_rad:.3g} rad after a radian"
    )
    own = zip(OWN, solution.minimum.state.calibration, OWN_UNITS, strict=True)
    found = f"bearing {bearing_rad:.4f} rad, range {range_m:.4f} m (Student's t)"
    after = f"{_ended(solution.minimum)} after {counted(solution.iterations, 'step')}: {solution.minimum.reason}"
    downweighted = int(np.count_nonzero(solution.minimum.weights < _DOWNWEIGHTED * solution.loss.share))
    return (
        Fact("observations", seen),
        Fact("left out", left),
        Fact("estimate", f"{1e3 * solution.time_s:.0f} ms, {after}"),
        Fact("robot", "estimated: " + ", ".join(f"{name} {value:+.3f}{unit}" for name, value, unit in own)),
        Fact(
            "odometry noise",
            f"{'stated' if is_stated else 'estimated'}: {wheels}; {_verdict(noise.motion / noise.motion_freedom)}",
        ),
        Fact(
            "sensor noise", f"estimated: {found}; {_verdict(float(np.mean(noise.sensor / noise.sensor_freedom)))}"
        ),
        Fact(
            "downweighted",
            f"{counted(downweighted, 'observation')} with less than {_DOWNWEIGHTED:g} of the weight of others",
        ),
    )


def _verdict(chi2: float) -> str:
    """χ² per degree of freedom as text."""
    low, high = _FITS
    verdict = "fits" if low <= chi2 <= high else f"off by a factor {chi2**0.5:.2f}"
    return f"χ² per degree of freedom {chi2:.2f}: {verdict}"


def _left_out(what: str) -> list[Fact]:
    """The line about a method that was not compared, none where all were."""
    return [Fact("not compared", what)] if what else []
