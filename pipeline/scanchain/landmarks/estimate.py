"""Initial guesses of landmark problems, and their minimization by the step rules of pose graphs."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from scanchain.data import Matrix
from scanchain.graph.cholesky import SingularMatrixError
from scanchain.graph.losses import RobustLoss
from scanchain.graph.minimizer import Descent, LocalModel, Optimizer, descend, step_rule
from scanchain.landmarks.problem import BearingRangeProblem, Linearization, Measurements, Values
from scanchain.landmarks.solvers import LinearSolver, UndeterminedError

_FIRST, _GROWTH = 16, 1.7  # number of poses of the first part, and growth factor of each further one
_STEPS, _ROUGHLY, _LIGHT = 4, 0.1, 1e-6  # of the optimizer on each part: iterations, change of the cost that ends
# them, first damping
_CONVEX = RobustLoss("huber", 1.345, 1.0)


def from_odometry(measurements: Measurements) -> Values:
    """Poses chained by the motions, every landmark by its first observation."""
    if measurements.motion.shape[1] == 3:
        poses = chain(measurements.first_pose, measurements.motion)
    else:
        poses = measurements.first_pose + np.cumsum(np.vstack([np.zeros(2), measurements.motion]), axis=0)
    own = measurements.calibration.value
    return Values(poses, _first_seen(measurements, poses, _relative(measurements, poses)), own)


def of_relative_positions(measurements: Measurements) -> Values:
    """The same for a linear problem."""
    poses = np.cumsum(np.vstack([np.zeros(2), measurements.motion]), axis=0)
    return Values(poses, _first_seen(measurements, poses, measurements.measured))


def disturbed(state: Values, shift_m: float, turn_rad: float) -> Values:
    """The state with all poses except the first turned about the origin and shifted along both axes."""
    c, s = np.cos(turn_rad), np.sin(turn_rad)
    poses = state.poses.copy()
    poses[1:, :2] = poses[1:, :2] @ np.array([[c, s], [-s, c]]) + shift_m
    poses[1:, 2:] += turn_rad
    return replace(state, poses=poses)


def growing(measurements: Measurements, solver: LinearSolver) -> Values:
    """Initial values by incremental optimization: the solution so far is extended and optimized, up to the end.

    Dead reckoning over the whole log may be meters off, so that a robust loss finds only a local minimum; over the
    second half of a part, from optimized poses and landmarks, it is not. The loss is convex in the residuals.
    Systematic errors of the sensor are left out, as a short part does not constrain them.
    """
    count = len(measurements.motion) + 1
    poses, landmarks = measurements.first_pose[None], np.full((len(measurements.landmarks), 2), np.nan)
    calibration, reach = measurements.calibration, _FIRST
    own = np.zeros_like(calibration.sigma)
    while True:
        reach = min(reach, count)
        motion = calibration.moved(measurements.motion, own)
        poses = np.vstack([poses, chain(poses[-1], motion[len(poses) - 1 : reach - 1])[1:]])
        part, known = _beginning(measurements, reach)
        guess = _first_seen(part, poses, _relative(part, poses))
        settled = np.isfinite(landmarks[known, 0])
        guess[settled] = landmarks[known[settled]]
        state = minimize(
            BearingRangeProblem(part), Values(poses, guess, own), solver, loss=_CONVEX, max_iterations=_STEPS,
            tolerance=_ROUGHLY, first_damping=_LIGHT,
        ).estimate.state  # fmt: skip
        poses, landmarks[known], own = state.poses, state.landmarks, state.calibration
        if reach == count:
            return Values(poses, landmarks, own)
        reach = int(reach * _GROWTH)


def _beginning(measurements: Measurements, poses: int) -> tuple[Measurements, NDArray[np.int64]]:
    """The problem of the first ``poses`` poses, and the landmarks observed from them."""
    kept, own = measurements.observed[:, 0] < poses, measurements.calibration
    known, landmark = np.unique(measurements.observed[kept, 1], return_inverse=True)
    part = replace(
        measurements,
        motion=measurements.motion[: poses - 1],
        motion_covariance=measurements.motion_covariance[: poses - 1],
        calibration=replace(
            own, moving=own.moving[: poses - 1], slope=own.slope[: poses - 1], sensing=own.sensing[kept, :0]
        ),
        observed=np.stack([measurements.observed[kept, 0], landmark], axis=1),
        measured=measurements.measured[kept],
        measured_covariance=measurements.measured_covariance[kept],
        landmarks=measurements.landmarks[known],
    )
    return part, known


def _first_seen(measurements: Measurements, poses: Matrix, relative: Matrix) -> Matrix:
    """Position (L, 2) of every landmark by the first of its observations, positions (N, 2) from their poses."""
    _, first = np.unique(measurements.observed[:, 1], return_index=True)
    return poses[measurements.observed[first, 0], :2] + relative[first]


def _relative(measurements: Measurements, poses: Matrix) -> Matrix:
    """Positions (N, 2) of the landmarks, from the poses that saw them and in the world's axes."""
    bearing, reach = measurements.measured.T
    direction = bearing + (poses[measurements.observed[:, 0], 2] if poses.shape[1] == 3 else 0.0)
    return reach[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=1)


def chain(start: NDArray[np.float64], motion: Matrix) -> Matrix:
    """Poses (K, 3) chained by these motions (K − 1, 3) from ``start``, the first pose."""
    poses = np.tile(start, (len(motion) + 1, 1))
    poses[1:, 2] += np.cumsum(motion[:, 2])
    c, s = np.cos(poses[:-1, 2]), np.sin(poses[:-1, 2])
    poses[1:, 0] += np.cumsum(c * motion[:, 0] - s * motion[:, 1])
    poses[1:, 1] += np.cumsum(s * motion[:, 0] + c * motion[:, 1])
    return poses


_FREEDOM = 4.0  # ν of Student's t: heavy tails with a finite variance
_SCALINGS, _LEAST_CHI2 = 10, 1e-12  # iterations of a scale; χ² of exact data, which have no scale
_SCALE2 = _FREEDOM + 2.0  # up to a factor absorbed by σ, the weight (ν + 2) / (ν + χ²) is s² / (s² + χ²)


@dataclass(frozen=True, slots=True)
class StudentLoss:
    """Student's t loss ρ(χ²) of a bearing and a range jointly, ν = 4.

    share : (N,) factor of each observation, the share of an independent one that it counts as, above 0 up to 1
    """

    share: NDArray[np.float64]

    def weight(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weight from 0 to the share, (N,)."""
        return self.share * _SCALE2 / (_SCALE2 + chi2)

    def loss(self, chi2: NDArray[np.float64]) -> NDArray[np.float64]:
        """Loss, which is the share times χ² near zero, (N,)."""
        return self.share * _SCALE2 * np.log1p(chi2 / _SCALE2)

    def efficiency(self, chi2: NDArray[np.float64]) -> float:
        """Information of an observation over its weight: E[ψ′]² / (E[ψ²] E[w]), ψ = w r (Huber 1981, 7.6).

        With r in two dimensions and the same in each, E[ψ′] = E[w + w′ χ²] and E[ψ²] = E[w² χ²] / 2.
        """
        chi2 = np.maximum(chi2, _LEAST_CHI2)
        for _ in range(_SCALINGS):  # to E[w χ²] = 2: the residuals lack what the state absorbed
            chi2 = chi2 * 2.0 / np.average(_SCALE2 / (_SCALE2 + chi2) * chi2, weights=self.share)
        w = _SCALE2 / (_SCALE2 + chi2)
        slope, square = np.average([w - w**2 * chi2 / _SCALE2, w**2 * chi2 / 2.0], axis=1, weights=self.share)
        return float(slope**2 / (square * np.average(w, weights=self.share)))


QUADRATIC = RobustLoss("none", 1.0, 1.0)


@dataclass(frozen=True, slots=True)
class Evaluation:
    """A state with residuals and A there, and the robust weights (N,) of the observations.

    ``cost`` is Σ r² of priors and odometry plus Σ ρ(χ²) of the observations.
    """

    state: Values
    at: Linearization
    weights: NDArray[np.float64]
    cost: float


Minimum = Descent[Evaluation]


def minimize(
    problem: BearingRangeProblem,
    guess: Values,
    solver: LinearSolver,
    *,
    loss: RobustLoss | StudentLoss = QUADRATIC,
    optimizer: Optimizer = "levenberg-marquardt",
    max_iterations: int = 100,
    tolerance: float = 1e-10,
    first_damping: float = 1e-4,
) -> Minimum:
    """Minimum by descent from the guess, one linearized step at a time, each solved by ``solver``.

    It ends as ``descend`` does. The default of the first damping is for a guess that may be poor; near the minimum
    1e-10 is better, since a long chain's weakest modes have 1e-9 of diag(AᵀA).
    """

    def evaluate(state: Values) -> Evaluation:
        at = problem.linearize(state)
        quadratic = sum(float(np.square(r).sum()) for r in (at.prior, at.calibration, at.odometry))
        chi2 = at.chi2
        return Evaluation(state, at, loss.weight(chi2), quadratic + float(loss.loss(chi2).sum()))

    def model_at(now: Evaluation) -> LocalModel:
        """H = AᵀA and g = −Aᵀb."""
        system = problem.system(now.at, now.weights)
        lengths = np.bincount(system.pattern.columns, system.values**2, system.pattern.shape[1])
        A, diagonal = system.A, np.asarray(lengths, np.float64)

        def solve(damping: float) -> NDArray[np.float64]:
            if not damping:
                return solver.solve(system)
            try:
                return solver.solve(problem.damped(system, damping * diagonal))
            except UndeterminedError as error:
                column = int(error.columns[0])
                raise SingularMatrixError(column, column) from error

        return LocalModel(-(A.T @ system.b), diagonal, solve, lambda step: A.T @ (A @ step))

    return descend(
        model_at,
        lambda now, step: evaluate(now.state.moved(step)),
        evaluate(guess),
        step_rule(optimizer, first_damping),
        max_iterations,
        tolerance,
    )
