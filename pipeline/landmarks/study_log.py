"""Studies the log of one robot of an MRCLAM folder."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.clock import working_s
from scanchain.data import Trajectory
from scanchain.landmarks.accuracy import Accuracy, Truth, against_truth, nanoseconds, pose_matrices, truth_at
from scanchain.landmarks.compare import compare_linear
from scanchain.landmarks.files.mrclam import RangeLog, read_mrclam
from scanchain.landmarks.problem import Values
from scanchain.landmarks.ranges.dead_reckoning import OWN, OWN_UNITS
from scanchain.landmarks.ranges.slam import RangeSolution, solve_range_log
from scanchain.landmarks.solvers import methods_for
from scanchain.landmarks.study import Estimate, Fact, Options, Study, left_out_fact
from scanchain.words import counted

_DOWNWEIGHTED = 0.25  # share of its expected weight below which an observation is reported as downweighted
_FITS = (0.5, 2.0)  # χ² per degree of freedom between which a noise model fits


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
    truth = truth_at(log, solution.nodes_s, solution.landmarks)
    return Study(
        name=log.name,
        facts=(*_facts(log, solution, is_stated=options.noise is not None), *left_out_fact(left_out)),
        before=_estimate(solution.reckoned, solution.nodes_s, truth),
        after=_estimate(solution.state, solution.nodes_s, truth),
        converged=solution.converged,
        pose_covariance=solution.pose_covariance,
        landmark_covariance=solution.landmark_covariance,
        true_poses=truth.poses[:, :2],
        true_landmarks=truth.landmarks,
        landmarks=solution.landmarks,
        rows=len(system.b),
        columns=system.pattern.shape[1],
        entries=len(system.values),
        build_s=build_s,
        methods=compare_linear(system, names, options.repeats),
        trajectory=Trajectory(nanoseconds(solution.nodes_s), pose_matrices(solution.state.poses)),
    )


def _estimate(state: Values, nodes_s: NDArray[np.float64], truth: Truth) -> Estimate:
    if np.count_nonzero(truth.known) < 2:
        nothing = Accuracy(np.nan, np.nan, "no motion capture at these times")
        return Estimate(state, nothing, lie.identity(2))
    accuracy, T_truth_estimate = against_truth(state, nodes_s, truth)
    return Estimate(state, accuracy, T_truth_estimate)


def _facts(log: RangeLog, solution: RangeSolution, *, is_stated: bool) -> tuple[Fact, ...]:
    ended = "converged" if solution.converged else "DID NOT CONVERGE"
    count = len(log.seen_s)
    worth = f"count as {solution.loss.share.sum():.0f}, as errors of a landmark's successive sightings are alike"
    nodes = counted(len(solution.nodes_s), "pose")
    seen = f"{count:,} of {len(solution.landmarks)} landmarks from {nodes}; they {worth}"
    left = f"{log.of_robots} of other robots, {log.unknown} of unknown barcodes, {log.outside} without odometry"
    noise = solution.odometry_noise
    wheels = (
        f"{noise.forward_m:.3g} m forward, {noise.sideways_m:.3g} m sideways, {noise.drift_rad:.3g} rad"
        f" after a meter, {noise.turn_rad:.3g} rad after a radian"
    )
    own = zip(OWN, solution.state.calibration, OWN_UNITS, strict=True)
    found = f"bearing {solution.bearing_sigma_rad:.4f} rad, range {solution.range_sigma_m:.4f} m (Student's t)"
    after = f"{ended} after {counted(solution.iterations, 'step')}: {solution.reason}"
    downweighted = int(np.count_nonzero(solution.weights < _DOWNWEIGHTED * solution.loss.share))
    return (
        Fact("observations", seen),
        Fact("left out", left),
        Fact("estimate", f"{1e3 * solution.time_s:.0f} ms, {after}"),
        Fact("robot", "estimated: " + ", ".join(f"{name} {value:+.3f}{unit}" for name, value, unit in own)),
        Fact(
            "odometry noise",
            f"{'stated' if is_stated else 'estimated'}: {wheels}; {_verdict(solution.motion_chi2)}",
        ),
        Fact("sensor noise", f"estimated: {found}; {_verdict(solution.observation_chi2)}"),
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
