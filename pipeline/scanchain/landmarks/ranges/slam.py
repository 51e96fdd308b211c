"""A log of wheel velocities, ranges and bearings to trajectory and landmarks, and to the noise of either."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.clock import working_s
from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.landmarks.bearing_range import BearingRangeProblem, Measurements
from scanchain.landmarks.files.mrclam import RangeLog
from scanchain.landmarks.guess import from_odometry, growing
from scanchain.landmarks.minimize import Minimum, minimize
from scanchain.landmarks.problem import Values
from scanchain.landmarks.ranges.dead_reckoning import OWN, OdometryNoise, Reckoning, reckon
from scanchain.landmarks.ranges.noise_model import Consistency, SightingPairs, StudentLoss, consistency
from scanchain.landmarks.solvers import ESTIMATOR, LinearSolver, create_solver
from scanchain.landmarks.solvers.schur import Covariance
from scanchain.landmarks.system import landmark_columns, pose_columns

_ANCHOR = 1e-8  # m², rad²: the first pose is where the world begins
_SENSOR = np.square([0.03, 0.12])  # rad², m²; where the estimate of the sensor's noise begins
_LEAST = np.square([1e-3, 1e-3, 1e-3, 1e-3, 3e-4, 3e-4])  # of the odometry's, as OdometryNoise has them; rad, m
_LEAST_FREEDOM = 1e-3  # least redundancy of the observations
_TURNS, _CHANGE = 20, 0.1  # estimates of the noise, and the relative change that ends them
_RECKONED = 2  # of them begin with a new dead reckoning, by the robot as it is known then
_MOST, _ROUGH, _FINE, _LITTLE = 50, 1e-2, 1e-5, 1e-10  # iterations; change of χ² that ends them; first damping


class LogModel:
    """The part of a log's problem independent of its noise: nodes, landmarks, observations."""

    def __init__(self, log: RangeLog) -> None:
        self._log = log
        self.nodes_s, node = np.unique(log.seen_s, return_inverse=True)
        self.landmarks, landmark = np.unique(log.subjects, return_inverse=True)
        self.observed = np.stack([node, landmark], axis=1)
        self.sighting_pairs = SightingPairs(log.seen_s, landmark)

    def reckoned(self, own: NDArray[np.float64]) -> Reckoning:
        """Dead reckoning from node to node by a robot with these errors of its own, (5,)."""
        return reckon(self._log, self.nodes_s, own)

    def measurements(self, reckoning: Reckoning, variances: NDArray[np.float64]) -> Measurements:
        """The problem with these variances (6,), the odometry's first."""
        return Measurements(
            first_pose=np.zeros(3),
            first_covariance=_ANCHOR * np.eye(3),
            motion=reckoning.motion,
            motion_covariance=reckoning.covariance(variances[:4]),
            calibration=reckoning.calibration,
            observed=self.observed,
            measured=self._log.measured,
            measured_covariance=np.diag(variances[4:]),
            landmarks=self.landmarks,
        )


@dataclass(frozen=True, slots=True)
class RangeSolution:
    """A minimum, the noise it was found for, and their consistency.

    Attributes
    ----------
    nodes_s : (K,) times of the poses, those of the observations
    reckoned : by the velocities as they were logged, every landmark where it was first seen
    problem, guess, minimum : with the noise as estimated; where the first minimization began; where the last
        ended, the first pose at the origin
    variances : (6,) of the odometry's sources as ``OdometryNoise`` has them, of bearing and range
    loss : with which the observations were weighed; with the share of each
    covariance, consistency : at the minimum
    iterations, time_s : steps after the guess; of the whole, reading left out
    """

    nodes_s: NDArray[np.float64]
    reckoned: Values
    problem: BearingRangeProblem
    guess: Values
    minimum: Minimum
    variances: NDArray[np.float64]
    loss: StudentLoss
    covariance: Covariance
    consistency: Consistency
    iterations: int
    time_s: float

    @property
    def pose_covariance(self) -> Matrix:
        """(K, 3, 3) relative to the first pose."""
        return self.covariance.of(pose_columns(self.problem.pattern.layout, np.arange(len(self.nodes_s))))

    @property
    def landmark_covariance(self) -> Matrix:
        """(L, 2, 2) relative to the first pose."""
        layout = self.problem.pattern.layout
        return self.covariance.of(landmark_columns(layout, np.arange(len(layout.landmarks))))

    @property
    def sigmas(self) -> list[float]:
        """Standard deviations of the odometry's sources, of bearing in rad and range in m."""
        return np.sqrt(self.variances).tolist()


def solve_range_log(log: RangeLog, noise: OdometryNoise | None, method: str = ESTIMATOR) -> RangeSolution:
    """Estimate poses, landmarks, the robot's own errors and the noise of odometry and sensor together.

    noise : of the odometry; None for an estimate of it

    Bearings and ranges follow Student's t (``StudentLoss``); the scales of it and the variances of the odometry
    are found by restricted maximum likelihood (``consistency``). Errors of one landmark's sightings are alike for
    a while, by what the residuals show (``SightingPairs``): each sighting counts as a share of an independent one.
    Raises InputError where the observations are too few for that.
    """
    begin, model, solver = working_s(), LogModel(log), create_solver(method)
    stated = np.concatenate([(noise or OdometryNoise()).densities, _SENSOR])
    reckoning = model.reckoned(np.zeros(len(OWN)))
    problem = BearingRangeProblem(model.measurements(reckoning, stated))
    reckoned, guess = from_odometry(problem.measurements), growing(problem.measurements, solver)
    variances, loss = stated, StudentLoss(np.ones(len(model.observed)))
    minimum, covariance, found = _settled(problem, guess, loss, variances, reckoning, solver, _ROUGH)
    if not np.all(found.redundancy > _LEAST_FREEDOM):
        raise InputError("the landmarks were seen too seldom to estimate the sensor's noise; give a longer log")
    iterations = minimum.iterations
    for turn in range(_TURNS):
        growth = found.growth(stated / variances)
        if noise is not None:
            growth[:4] = 1.0
        is_last = turn == _TURNS - 1 or bool(np.abs(np.sqrt(growth) - 1.0).max() < _CHANGE)
        variances = np.maximum(variances * growth, _LEAST)
        residuals = np.sqrt(minimum.weights / loss.share)[:, None] * minimum.at.observations
        loss = StudentLoss(model.sighting_pairs.share(model.sighting_pairs.correlation(residuals)))
        state = minimum.state
        if turn < _RECKONED:
            reckoning = model.reckoned(state.calibration)
        problem = problem.of(model.measurements(reckoning, variances))
        tolerance = _FINE if is_last else _ROUGH
        minimum, covariance, found = _settled(problem, state, loss, variances, reckoning, solver, tolerance)
        iterations += minimum.iterations
        if is_last:
            break
    return RangeSolution(
        model.nodes_s, reckoned, problem, guess, minimum, variances, loss, covariance, found, iterations,
        working_s() - begin,
    )  # fmt: skip


def _settled(
    problem: BearingRangeProblem,
    state: Values,
    loss: StudentLoss,
    variances: NDArray[np.float64],
    reckoning: Reckoning,
    solver: LinearSolver,
    tolerance: float,
) -> tuple[Minimum, Covariance, Consistency]:
    """The minimum for a given noise, the covariance there, and the consistency of its residuals."""
    minimum = minimize(
        problem, state, solver, loss=loss, tolerance=tolerance, first_damping=_LITTLE, max_iterations=_MOST
    )
    covariance = Covariance(problem.system(minimum.at, minimum.weights))
    sources = variances[:4, None, None] * reckoning.sources
    return minimum, covariance, consistency(problem, minimum, covariance, sources, loss.share)
