"""A log of wheel velocities, ranges and bearings to trajectory and landmarks, each with its covariance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.clock import working_s
from scanchain.data import Matrix
from scanchain.landmarks.bearing_range import BearingRangeProblem
from scanchain.landmarks.files.mrclam import RangeLog
from scanchain.landmarks.problem import Values
from scanchain.landmarks.ranges.dead_reckoning import OdometryNoise
from scanchain.landmarks.ranges.fit import LogModel, fit_log
from scanchain.landmarks.ranges.noise_model import StudentLoss
from scanchain.landmarks.solvers import ESTIMATOR, create_solver
from scanchain.landmarks.system import landmark_columns, pose_columns


@dataclass(frozen=True, slots=True)
class RangeSolution:
    """Solution of a range log.

    Attributes
    ----------
    nodes_s : (K,) times of the poses, those of the observations
    state, reckoned : the estimate, first pose at the origin; dead reckoning alone, landmarks where first seen
    landmarks : (L,) subjects
    pose_covariance, landmark_covariance : (K, 3, 3), (L, 2, 2) relative to the first pose
    odometry_noise : estimated, or as stated
    bearing_sigma_rad, range_sigma_m : noise of the sensor, estimated
    loss : with which the observations were weighed; with the share of each
    weights : (N,) robust weight of every observation, times its share
    motion_chi2, observation_chi2 : χ² per degree of freedom of either kind, observations weighed; 1 is a noise
        model that fits
    iterations, converged, reason, time_s : of the whole, reading left out
    problem, guess : the problem with that noise, and where its minimization began
    """

    nodes_s: NDArray[np.float64]
    state: Values
    reckoned: Values
    landmarks: NDArray[np.int64]
    pose_covariance: Matrix
    landmark_covariance: Matrix
    odometry_noise: OdometryNoise
    bearing_sigma_rad: float
    range_sigma_m: float
    loss: StudentLoss
    weights: NDArray[np.float64]
    motion_chi2: float
    observation_chi2: float
    iterations: int
    converged: bool
    reason: str
    time_s: float
    problem: BearingRangeProblem
    guess: Values


def solve_range_log(log: RangeLog, noise: OdometryNoise | None, method: str = ESTIMATOR) -> RangeSolution:
    """Estimate poses, landmarks, the robot's own errors and the noise of odometry and sensor together.

    noise : of the odometry; None for an estimate of it

    Bearings and ranges follow Student's t (``StudentLoss``); the scales of it and the variances of the odometry
    are found by restricted maximum likelihood (``consistency``). Errors of one landmark's sightings are alike for
    a while, by what the residuals show (``SightingPairs``): each sighting counts as a share of an independent one.
    Raises InputError where the observations are too few for that.
    """
    begin = working_s()
    model = LogModel(log)
    fit = fit_log(model, noise, create_solver(method))
    layout, minimum, found = fit.problem.pattern.layout, fit.minimum, fit.consistency
    bearing_sigma_rad, range_sigma_m = np.sqrt(fit.variances[4:]).tolist()
    return RangeSolution(
        nodes_s=model.nodes_s,
        state=minimum.state,
        reckoned=fit.reckoned,
        landmarks=model.landmarks,
        pose_covariance=fit.covariance.of(pose_columns(layout, np.arange(layout.poses))),
        landmark_covariance=fit.covariance.of(landmark_columns(layout, np.arange(len(layout.landmarks)))),
        odometry_noise=OdometryNoise(*np.sqrt(fit.variances[:4]).tolist()),
        bearing_sigma_rad=bearing_sigma_rad,
        range_sigma_m=range_sigma_m,
        loss=fit.loss,
        weights=minimum.weights,
        motion_chi2=found.motion / found.motion_freedom,
        observation_chi2=float(np.mean(found.sensor / found.sensor_freedom)),
        iterations=fit.iterations,
        converged=minimum.converged,
        reason=minimum.reason,
        time_s=working_s() - begin,
        problem=fit.problem,
        guess=fit.guess,
    )
