"""A log of wheel velocities, ranges and bearings to trajectory and landmarks, each with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from pipeline.data import Matrix
from pipeline.errors import InputError
from pipeline.graph.robust import RobustLoss
from pipeline.landmarks.assembly import landmark_columns, pose_columns
from pipeline.landmarks.bearing_range import BearingRangeProblem, Measurements
from pipeline.landmarks.covariance import Covariance
from pipeline.landmarks.dead_reckoning import OdometryNoise, chain, reckon
from pipeline.landmarks.guess import growing
from pipeline.landmarks.minimise import Minimum, minimise
from pipeline.landmarks.mrclam import RangeLog
from pipeline.landmarks.problem import State
from pipeline.landmarks.solvers import LinearSolver, create_solver

_ANCHOR = 1e-8  # m², rad²: the first pose is where the world begins
_FIRST_SIGMAS = np.array([0.03, 0.12])  # rad, m; where the estimate of the sensor's noise begins
_LEAST_SIGMAS = np.array([3e-4, 3e-4])  # rad, m; what rounding to three digits alone amounts to
_LEAST_REDUNDANCY = 1e-3  # observations beyond what the state takes up
_FREEDOM = 4.0  # of Student's t
STUDENT = RobustLoss("cauchy", np.sqrt(_FREEDOM + 2.0), 1.0)
_TURNS, _STEPS, _MOST = 12, 2, 50  # estimates of the noise; steps in between, and after the last
_SETTLED, _POWER = 0.02, 1.4  # relative change of the noise that ends them; it nears its limit slowly: go further
_TOLERANCE, _LITTLE = 1e-6, 1e-10  # relative change of χ²; damping for a state that is settled


@dataclass(frozen=True, slots=True)
class RangeSolution:
    """What became of a range log.

    Attributes
    ----------
    nodes_s : (K,) times of the poses, those of the observations
    state, reckoned : the estimate, first pose at the origin; dead reckoning alone, (K, 3)
    landmarks : (L,) subjects
    pose_covariance, landmark_covariance : (K, 3, 3), (L, 2, 2) relative to the first pose
    bearing_sigma_rad, range_sigma_m : noise of the sensor, estimated
    weights : (N,) robust weight of every observation
    motion_chi2, observation_chi2 : χ² per degree of freedom of either kind, observations weighed; 1 is a noise
        model that fits
    iterations, converged, reason, time_s : of the whole, reading left out
    problem, guess : the problem with that noise, and where its minimisation began
    """

    nodes_s: NDArray[np.float64]
    state: State
    reckoned: Matrix
    landmarks: NDArray[np.int64]
    pose_covariance: Matrix
    landmark_covariance: Matrix
    bearing_sigma_rad: float
    range_sigma_m: float
    weights: NDArray[np.float64]
    motion_chi2: float
    observation_chi2: float
    iterations: int
    converged: bool
    reason: str
    time_s: float
    problem: BearingRangeProblem
    guess: State


def solve_range_log(log: RangeLog, noise: OdometryNoise, method: str = "schur") -> RangeSolution:
    """Estimate poses, landmarks and the sensor's noise together.

    The odometry's noise is stated. That of bearings and ranges follows Student's t with ν = 4 degrees of freedom,
    whose scales are estimated with the state. The weight (ν + 2) / (ν + χ²) of an observation is, but for a
    factor that the scale takes up, Cauchy's with s² = ν + 2. The variance is Σ w r² over the redundancy
    Σ (1 − w h), h the leverage of an observation: restricted maximum likelihood (Lange et al. 1989;
    Harville 1977). Raises InputError where the observations are too few for that.
    """
    begin = perf_counter()
    reckoning = reckon(log, noise)
    measurements = Measurements(
        first_pose=np.zeros(3),
        first_covariance=_ANCHOR * np.eye(3),
        motion=reckoning.motion,
        motion_covariance=reckoning.covariance,
        observed=reckoning.observed,
        measured=log.measured,
        measured_covariance=_diagonal(_FIRST_SIGMAS, len(log.measured)),
        landmarks=reckoning.landmarks,
    )
    solver = create_solver(method)
    guess = growing(measurements, solver)
    fit = _fit(BearingRangeProblem(measurements), guess, solver)
    layout, minimum = fit.problem.pattern.layout, fit.minimum
    return RangeSolution(
        nodes_s=reckoning.nodes_s,
        state=minimum.state,
        reckoned=chain(np.zeros(3), reckoning.motion),
        landmarks=reckoning.landmarks,
        pose_covariance=fit.covariance.of(pose_columns(layout, np.arange(layout.poses))),
        landmark_covariance=fit.covariance.of(landmark_columns(layout, np.arange(len(layout.landmarks)))),
        bearing_sigma_rad=float(fit.sigmas[0]),
        range_sigma_m=float(fit.sigmas[1]),
        weights=minimum.weights,
        motion_chi2=fit.motion_chi2(),
        observation_chi2=float(np.mean(fit.observation_chi2())),
        iterations=fit.iterations,
        converged=minimum.converged,
        reason=minimum.reason,
        time_s=perf_counter() - begin,
        problem=fit.problem,
        guess=guess,
    )


@dataclass(frozen=True, slots=True)
class _Fit:
    """A minimum with the noise it was found for, the covariance there, and the linear solves so far."""

    problem: BearingRangeProblem
    minimum: Minimum
    sigmas: NDArray[np.float64]
    covariance: Covariance
    iterations: int

    def motion_chi2(self) -> float:
        """χ² per degree of freedom of the motions."""
        rows, residuals = self.minimum.at.odometry_rows, self.minimum.at.odometry
        leverage = _leverage(rows, self.covariance.of(self.problem.motion_columns))
        return float(np.square(residuals).sum() / (residuals.size - leverage.sum()))

    def redundancy(self) -> NDArray[np.float64]:
        """Degrees of freedom of bearings and of ranges, weighed, (2,)."""
        weights = self.minimum.weights[:, None]
        rows = self.minimum.at.observation_rows
        leverage = _leverage(rows, self.covariance.of(self.problem.observation_columns))
        return (1.0 - weights * leverage).sum(axis=0)

    def observation_chi2(self) -> NDArray[np.float64]:
        """χ² per degree of freedom of bearings and of ranges, weighed, (2,)."""
        return _squares(self.minimum) / self.redundancy()


def _fit(problem: BearingRangeProblem, state: State, solver: LinearSolver) -> _Fit:
    """Estimate state and sensor noise in turn until neither changes any more."""
    sigmas, iterations, turn, redundancy = _FIRST_SIGMAS, 0, 1, np.ones(2)
    while True:
        minimum = minimise(
            problem, state, solver, loss=STUDENT, tolerance=_TOLERANCE, first_damping=_LITTLE,
            max_iterations=_STEPS if turn < _TURNS else _MOST,
        )  # fmt: skip
        state, iterations = minimum.state, iterations + minimum.iterations
        near = minimum.converged and _settled(_squares(minimum) / redundancy)
        if near or turn == _TURNS or turn.bit_count() == 1:  # the redundancy changes slowly: at 1, 2, 4, 8 will do
            covariance = Covariance(problem.system(minimum.at, minimum.weights))
            fit = _Fit(problem, minimum, sigmas, covariance, iterations)
            redundancy = fit.redundancy()
            if not np.all(redundancy > _LEAST_REDUNDANCY):
                raise InputError(
                    "the landmarks were seen too seldom to tell the sensor's noise; give a longer log"
                )
            if turn == _TURNS or (minimum.converged and _settled(_squares(minimum) / redundancy)):
                return fit
        ratio = np.sqrt(_squares(minimum) / redundancy)
        sigmas = np.maximum(sigmas * ratio**_POWER, _LEAST_SIGMAS)
        problem = problem.with_noise(_diagonal(sigmas, len(minimum.weights)))
        turn += 1


def _squares(minimum: Minimum) -> NDArray[np.float64]:
    """Σ w r² of bearings and of ranges, whitened, (2,)."""
    return (minimum.weights[:, None] * minimum.at.observations**2).sum(axis=0)


def _settled(chi2: NDArray[np.float64]) -> bool:
    """Whether χ² per degree of freedom is as near to 1 as it need be."""
    return bool(np.abs(np.sqrt(chi2) - 1.0).max() < _SETTLED)


def _diagonal(sigmas: NDArray[np.float64], count: int) -> Matrix:
    """The covariance of every observation, (N, 2, 2)."""
    return np.broadcast_to(np.diag(sigmas**2), (count, 2, 2))


def _leverage(rows: Matrix, covariance: Matrix) -> Matrix:
    """Diagonals of J C Jᵀ, the share of each measurement in its own estimate, (N, rows)."""
    return np.einsum("nrm,nml,nrl->nr", rows, covariance, rows, optimize=True)
