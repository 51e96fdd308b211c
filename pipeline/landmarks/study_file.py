"""Studies the landmark problems of the course."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from scanchain import lie
from scanchain.clock import working_s
from scanchain.landmarks import guess as guesses
from scanchain.landmarks.accuracy import of_positions
from scanchain.landmarks.bearing_range import BearingRangeProblem, world_referenced
from scanchain.landmarks.compare import MethodResult, compare_linear, compare_nonlinear
from scanchain.landmarks.covariance import Covariance
from scanchain.landmarks.minimize import minimize
from scanchain.landmarks.problem import LandmarkData, Values
from scanchain.landmarks.relative_position import linear_system, state_of
from scanchain.landmarks.solvers import create_solver, methods_for
from scanchain.landmarks.study import Estimate, Fact, Guess, Options, Study, left_out_fact
from scanchain.landmarks.system import LinearSystem, landmark_columns, pose_columns
from scanchain.words import FREEDOM, counted

_SHIFT_M, _TURN_RAD = 1.0, 0.5  # of the disturbed guess


def study_file(data: LandmarkData, options: Options) -> Study:
    """Solve the problem of a file by every requested method, compare with the truth in the file."""
    return _write_up(data, _linear(data, options) if data.kind == "linear" else _nonlinear(data, options))


@dataclass(frozen=True, slots=True)
class _Solved:
    before: Values
    after: Values
    converged: bool
    system: LinearSystem
    build_s: float
    methods: tuple[MethodResult, ...]
    facts: tuple[Fact, ...]


def _linear(data: LandmarkData, options: Options) -> _Solved:
    begin = working_s()
    system = linear_system(data)
    build_s = working_s() - begin
    names, left_out = methods_for(options.methods, system.pattern.shape[1])
    methods = compare_linear(system, names, options.repeats)
    chi2 = float(np.square(system.A @ methods[0].x - system.b).sum())
    facts = (
        Fact("problem", "linear: steps between poses, landmarks' positions relative to them"),
        chi2_fact(chi2, len(system.b), system.pattern.shape[1]),
        *left_out_fact(left_out),
    )
    before, after = guesses.of_relative_positions(data), state_of(data, methods[0].x)
    return _Solved(before, after, True, system, build_s, methods, facts)


def _nonlinear(data: LandmarkData, options: Options) -> _Solved:
    problem = BearingRangeProblem(world_referenced(data))
    guess = _guess(problem, options.guess)
    names, left_out = methods_for(options.methods, problem.pattern.shape[1])
    minimum = minimize(problem, guess, create_solver(names[0]), optimizer=options.optimizer)
    begin = working_s()
    system = problem.system(problem.linearize(minimum.state), minimum.weights)
    build_s = working_s() - begin
    if options.optimizer == "gradient-descent" or not minimum.iterations:  # solves none: take its end
        methods = compare_linear(system, names, options.repeats)
    else:
        methods = compare_nonlinear(problem, guess, options.optimizer, names, options.repeats)
    ended = "converged" if minimum.converged else "DID NOT CONVERGE"
    facts = (
        Fact("problem", "nonlinear: steps between poses, bearing and range of landmarks; headings known"),
        Fact("guess", options.guess),
        Fact(
            "iteration",
            f"{options.optimizer} {ended} after {counted(minimum.iterations, 'step')}: {minimum.reason}",
        ),
        chi2_fact(minimum.cost, len(system.b), system.pattern.shape[1]),
        *left_out_fact(left_out),
    )
    return _Solved(guess, minimum.state, minimum.converged, system, build_s, methods, facts)


def chi2_fact(chi2: float, rows: int, unknowns: int) -> Fact:
    """χ² over its degrees of freedom, and its meaning."""
    freedom = max(rows - unknowns, 1)
    verdict = (
        "the noise model fits"
        if 0.5 <= chi2 / freedom <= 2.0
        else "the noise model does not fit, or a poor minimum"
    )
    return Fact("χ²", f"{chi2:.4f} over {counted(freedom, *FREEDOM)}: {chi2 / freedom:.3f}; {verdict}")


def _guess(problem: BearingRangeProblem, guess: Guess) -> Values:
    state = guesses.from_odometry(problem.measurements)
    if guess == "disturbed":
        return guesses.disturbed(state, _SHIFT_M, _TURN_RAD)
    if guess == "origin":
        return replace(state, landmarks=np.zeros_like(state.landmarks))
    return state


def _write_up(data: LandmarkData, solved: _Solved) -> Study:
    layout, covariance = solved.system.pattern.layout, Covariance(solved.system)
    before, after = (
        Estimate(state, of_positions(state, data), lie.identity(2)) for state in (solved.before, solved.after)
    )
    return Study(
        name=data.name,
        facts=solved.facts,
        before=before,
        after=after,
        converged=solved.converged,
        pose_covariance=covariance.of(pose_columns(layout, np.arange(layout.poses))),
        landmark_covariance=covariance.of(landmark_columns(layout, np.arange(len(layout.landmarks)))),
        true_poses=data.true_poses,
        true_landmarks=data.true_landmarks,
        landmarks=layout.landmarks,
        rows=len(solved.system.b),
        columns=layout.columns,
        entries=len(solved.system.values),
        build_s=solved.build_s,
        methods=solved.methods,
        trajectory=None,
    )
