"""Trajectory, landmarks and noise estimated from a log of wheel velocities, ranges and bearings."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from scanchain.clock import working_s
from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.kernels.landmarks import factors
from scanchain.landmarks.estimate import Minimum, StudentLoss, from_odometry, growing, minimize
from scanchain.landmarks.files import RangeLog
from scanchain.landmarks.problem import BearingRangeProblem, Calibration, Measurements, Values
from scanchain.landmarks.solvers import ESTIMATOR, Covariance, create_solver
from scanchain.trajectory import LEAST_VARIANCE

_AT_REST = np.square([1e-3, 1e-3, 1e-3])  # m², m², rad² per second, whether or not the robot moves

WHEELS = 5  # number of unknowns of the wheels, which come before those of the sensor
OWN = (
    "forward scale", "forward lost in turning", "turn scale", "drift", "delay",
    "range scale", "depth share", "range offset", "bearing offset", "bearing scale", "lever arm",
)  # fmt: skip
OWN_UNITS = ("", " m/rad", "", " rad/m", " s", "", "", " m", " rad", "", " m")
PRIOR_SIGMA = np.array([0.1, 0.1, 0.1, 0.1, 0.3, 0.02, 1.0, 0.05, 0.03, 0.03, 0.1])  # differential drives, cameras
_STEP = np.array([1e-3, 1e-3, 1e-3, 1e-3, 0.05])  # steps of the finite differences


@dataclass(frozen=True, slots=True)
class OdometryNoise:
    """White noise of a robot's wheels: standard deviations of its motion after a meter, and after a radian turned.

    They grow with the square root of either. The defaults are for a small differential drive on a smooth floor.
    """

    forward_m: float = 0.03
    sideways_m: float = 0.01
    drift_rad: float = 0.05
    turn_rad: float = 0.1

    @property
    def densities(self) -> NDArray[np.float64]:
        """Variances after a meter, a meter, a meter and a radian, (4,)."""
        return np.square([self.forward_m, self.sideways_m, self.drift_rad, self.turn_rad])


@dataclass(frozen=True, slots=True)
class Reckoning:
    """Dead-reckoned motions between the observations of a log.

    motion : (K − 1, 3) from each node to the next, in the frame of the former
    sources, rest : (K − 1, 4, 3, 3), (K − 1, 3, 3) its covariance by each source of unit density, and the rest
    own, slope : (5,) errors of the robot's velocities that are corrected, (K − 1, 3, 5) the motion's Jacobian
    """

    motion: Matrix
    sources: Matrix
    rest: Matrix
    own: NDArray[np.float64]
    slope: Matrix

    def covariance(self, densities: NDArray[np.float64]) -> Matrix:
        """Covariance of every motion, (K − 1, 3, 3)."""
        return np.einsum("c,kcab->kab", densities, self.sources) + self.rest


def reckon(log: RangeLog, nodes_s: NDArray[np.float64], own: NDArray[np.float64]) -> Reckoning:
    """Motions by integration of the velocities, corrected by ``own`` (5,), from one node (K,) to the next.

    With (v, ω) as logged and c as ``own``, the robot drives, a delay c₄ later, at
        (1 + c₀) v + c₁ |ω|   and   (1 + c₂) ω + c₃ v.
    """
    motion, sources = _integrated(log, nodes_s, own, sources=len(OdometryNoise().densities))
    slope = np.empty((*motion.shape, len(own)))
    for column, step in enumerate(np.diag(_STEP)):
        ahead, _ = _integrated(log, nodes_s, own + step, sources=0)
        slope[..., column] = (ahead - motion) / _STEP[column]
    rest = np.diff(nodes_s)[:, None, None] * np.diag(_AT_REST) + LEAST_VARIANCE * np.eye(3)
    return Reckoning(motion, sources, rest, own, slope)


def _integrated(
    log: RangeLog, nodes_s: NDArray[np.float64], own: NDArray[np.float64], *, sources: int
) -> tuple[Matrix, Matrix]:
    """Motions (K − 1, 3) and their covariances by each noise source of unit density, (K − 1, sources, 3, 3)."""
    v, turn_rate = log.velocities.T
    driven = np.stack(
        [(1.0 + own[0]) * v + own[1] * np.abs(turn_rate), (1.0 + own[2]) * turn_rate + own[3] * v], axis=1
    )
    steps = len(nodes_s) - 1
    motion, spread = np.empty((steps, 3)), np.empty((steps, sources, 3, 3))
    factors.integrate(log.times_s + own[4], driven, nodes_s, motion, spread)
    return motion, spread


_LAGS_S = np.array([0.0, 0.5, 1.0, 2.0, 4.0, 8.0, 16.0])  # bin edges; errors farther apart count as independent
_DRAWS = 8  # samples of the uncertainty of the state
_FEWEST = 30  # least number of pairs from which a correlation is estimated
_STATED = np.array([10.0, 10.0, 10.0, 10.0, 1.0, 1.0, 1.0])  # degrees of freedom that the prior noise counts as
_LEAST_REDUNDANCY = 0.05  # least redundancy as a share of the sightings


class SightingPairs:
    """Pairs of sightings of one landmark within some seconds of each other, computed once."""

    def __init__(self, seen_s: NDArray[np.float64], landmarks: NDArray[np.int64]) -> None:
        """Times and landmarks of the sightings, (N,) each."""
        since = seen_s - seen_s.min(initial=np.inf)
        key = since + landmarks * (since.max(initial=0.0) + 2.0 * _LAGS_S[-1])  # disjoint for landmarks
        order = np.argsort(key, kind="stable")
        places = np.arange(len(key))
        after = np.searchsorted(key[order], key[order] + _LAGS_S[-1]) - places - 1
        first = np.repeat(places, after)
        second = first + 1 + np.arange(len(first)) - np.repeat(np.cumsum(after) - after, after)
        self._first, self._second = order[first], order[second]
        self._lag = np.searchsorted(_LAGS_S, seen_s[self._second] - seen_s[self._first], side="right") - 1
        self._count = len(seen_s)

    def correlation(self, residuals: Matrix, absorbed: Matrix) -> NDArray[np.float64]:
        """Correlation of errors by lag, pooled over bearings and ranges; it never grows with the lag.

        The state absorbs a part of errors of covariance Σ: residuals have E[r rᵀ] = Σ − J C Jᵀ. That part is added
        as the mean of samples.

        residuals, absorbed : (N, 2), (S, N, 2) r in units of the noise, and J x for steps x of covariance C
        """
        counts = np.bincount(self._lag, minlength=len(_LAGS_S) - 1)
        known = np.flatnonzero(counts >= _FEWEST)
        if not len(known):
            return np.zeros(len(counts))
        every = np.concatenate([residuals[None], absorbed / len(absorbed) ** 0.5])
        every /= np.sqrt(2.0 * np.square(every).sum(axis=0).mean(axis=0))
        every = np.ascontiguousarray(every.transpose(1, 0, 2).reshape(len(residuals), -1))
        sums = np.zeros(len(counts))
        factors.lagged_products(self._first, self._second, self._lag, every, sums)
        found = np.interp(np.arange(len(counts)), known, sums[known] / counts[known])
        return np.minimum.accumulate(np.clip(found, 0.0, 1.0)).astype(np.float64)

    def share(self, correlation: NDArray[np.float64]) -> NDArray[np.float64]:
        """Weight of each sighting as a share of an independent one, (N,): 1 / Σ of correlations (Kish 1965)."""
        shared = correlation[self._lag]
        sums = np.bincount(self._first, shared, self._count) + np.bincount(self._second, shared, self._count)
        return (1.0 / (1.0 + sums)).astype(np.float64)


@dataclass(frozen=True, slots=True)
class Consistency:
    """Consistency of an estimate's residuals with its noise model.

    motion, sensor : χ² of the motions, of bearings and ranges, weighed
    motion_freedom, sensor_freedom : degrees of freedom of these: measurements minus those absorbed by the state
    sources, sources_freedom : (7,) the parts of these due to each source of noise
    """

    motion: float
    motion_freedom: float
    sensor: float
    sensor_freedom: float
    sources: NDArray[np.float64]
    sources_freedom: NDArray[np.float64]

    def growth(self, stated: NDArray[np.float64]) -> NDArray[np.float64]:
        """Factors by which the variances, those of odometry first, should grow, (7,); one where they are right.

        stated : (7,) their prior values, in units of the present ones
        """
        return (self.sources + _STATED * stated) / (self.sources_freedom + _STATED)


def consistency(
    problem: BearingRangeProblem,
    minimum: Minimum,
    covariance: Covariance,
    sources: Matrix,
    seen_sources: Matrix,
    share: NDArray[np.float64],
    efficiency: float,
) -> Consistency:
    """Compare residuals with their expectation under the noise model.

    With r a whitened motion, W its whitening, H = J C Jᵀ its leverage and V = Σ Vₛ its covariance by sources, the
    part of source s is rᵀ(W Vₛ Wᵀ)r, and tr(W Vₛ Wᵀ(I − H)) its expectation (Harville 1977). For observations
    with weights w and efficiency e, each counting as the share ``share`` (N,) of an independent one, they are
    Σ w r² and Σ share − e w h (Lange et al. 1989), divided in proportion to the sources' variances.

    sources, seen_sources : (K − 1, 4, 3, 3), (N, 3, 2) covariance of motions, variances of bearings and ranges
    """
    at, W = minimum.estimate.at, problem.motion_whitening
    parts = W[:, None] @ sources @ np.swapaxes(W, 1, 2)[:, None]
    leverage = at.odometry_rows @ covariance.of(problem.motion_columns) @ np.swapaxes(at.odometry_rows, 1, 2)
    r = at.odometry
    rows, weights = at.observation_rows, minimum.estimate.weights[:, None]
    h = ((rows @ covariance.of(problem.observation_columns)) * rows).sum(axis=-1)
    seen, freedom = weights * at.observations**2, share[:, None] - efficiency * weights * h
    seen_parts = seen_sources / seen_sources.sum(axis=1, keepdims=True)
    least = _LEAST_REDUNDANCY * (seen_parts * share[:, None, None]).sum(axis=(0, 2))
    of_motion = ((r[:, None, None, :] @ parts)[:, :, 0] * r[:, None]).sum(axis=(0, 2))
    motion_freedom = (parts * (np.eye(3) - leverage)[:, None]).sum(axis=(0, 2, 3))
    of_seen, seen_freedom = ((seen_parts * each[:, None]).sum(axis=(0, 2)) for each in (seen, freedom))
    return Consistency(
        motion=float(np.square(r).sum()),
        motion_freedom=float(r.size - np.trace(leverage, axis1=1, axis2=2).sum()),
        sensor=float(seen.sum()),
        sensor_freedom=float(freedom.sum()),
        sources=np.concatenate([of_motion, of_seen]),
        sources_freedom=np.concatenate([motion_freedom, np.maximum(seen_freedom, least)]),
    )


_ANCHOR = 1e-8  # m², rad²: the first pose defines the world frame
SENSOR = np.square([0.03, 0.05, 0.02])  # rad², m², 1; initial value of the noise of bearings, ranges, ranges per m
_LEAST = np.square([1e-3, 1e-3, 1e-3, 1e-3, 3e-4, 3e-4, 1e-4])  # odometry as in OdometryNoise, sensor; rad, m
_LEAST_FREEDOM = 1e-3  # least redundancy of the observations
_TURNS, _CHANGE = 20, 0.1  # largest number of noise estimates, and the relative change that ends them
_RECKONED = 2  # number of these after which dead reckoning is repeated with the calibration found so far
_MOST, _ROUGH, _FINE, _LITTLE = 50, 1e-2, 1e-5, 1e-10  # iterations; change of χ² that ends them; first damping


@dataclass(frozen=True, slots=True)
class RangeSolution:
    """A minimum, the noise it was found for, and their consistency.

    nodes_s : (K,) times of the poses, those of the observations
    reckoned : dead reckoning by the logged velocities, every landmark where it was first seen
    problem, guess, minimum : problem with the estimated noise; initial guess of the first minimization; result of
        the last one, with the first pose at the origin
    variances : (7,) of the odometry's sources as in ``OdometryNoise``, of bearings, of ranges, of these per meter
    iterations, time_s : steps after the guess; total time, without reading
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
    def sigmas(self) -> list[float]:
        """Standard deviations of the odometry's sources, of bearing in rad, range in m and range per m."""
        return np.sqrt(self.variances).tolist()


def units_of_noise(measured: Matrix) -> Matrix:
    """Variances (N, 3, 2) of bearings and ranges by sources of unit density: bearing, range, range per meter."""
    unit = np.zeros((len(measured), 3, 2))
    unit[:, 0, 0], unit[:, 1, 1], unit[:, 2, 1] = 1.0, 1.0, measured[:, 1] ** 2
    return unit


def solve_range_log(
    log: RangeLog, noise: OdometryNoise | None, nodes_s: NDArray[np.float64] | None = None
) -> RangeSolution:
    """Estimate poses, landmarks, the robot's own errors and the noise of odometry and sensor together.

    noise : of the odometry; None to estimate it
    nodes_s : (K,) times of the poses; None for those of the observations

    Bearings and ranges follow Student's t (``StudentLoss``); its scales and the variances of the odometry are
    found by restricted maximum likelihood (``consistency``). Errors of a landmark's successive sightings are
    correlated, as estimated from the residuals (``SightingPairs``): each sighting counts as a share of an
    independent one. Raises InputError if there are too few observations for that.
    """
    begin, solver = working_s(), create_solver(ESTIMATOR)
    nodes_s = np.unique(log.seen_s) if nodes_s is None else nodes_s
    landmarks, landmark = np.unique(log.subjects, return_inverse=True)
    observed = np.stack([np.searchsorted(nodes_s, log.seen_s), landmark], axis=1)
    sightings = SightingPairs(log.seen_s, landmark)
    unit, every = units_of_noise(log.measured), np.arange(len(OWN))

    def measurements(reckoning: Reckoning, variances: NDArray[np.float64]) -> Measurements:
        own = Calibration(
            OWN, np.append(reckoning.own, np.zeros(len(OWN) - WHEELS)), PRIOR_SIGMA,
            np.tile(every[:WHEELS], (len(nodes_s) - 1, 1)), reckoning.slope,
            np.tile(every[WHEELS:], (len(observed), 1)),
        )  # fmt: skip
        return Measurements(
            first_pose=np.zeros(3),
            first_covariance=_ANCHOR * np.eye(3),
            motion=reckoning.motion,
            motion_covariance=reckoning.covariance(variances[:4]),
            calibration=own,
            observed=observed,
            measured=log.measured,
            measured_covariance=(variances[4:] @ unit)[..., None] * np.eye(2),
            landmarks=landmarks,
        )

    stated = np.concatenate([(noise or OdometryNoise()).densities, SENSOR])
    reckoning, variances = reckon(log, nodes_s, np.zeros(WHEELS)), stated
    loss, problem = StudentLoss(np.ones(len(observed))), BearingRangeProblem(measurements(reckoning, stated))
    reckoned, guess = from_odometry(problem.measurements), growing(problem.measurements, solver)
    state, iterations, turn, is_last = guess, 0, 0, False
    while True:
        minimum = minimize(
            problem, state, solver, loss=loss, tolerance=_FINE if is_last else _ROUGH, first_damping=_LITTLE,
            max_iterations=_MOST,
        )  # fmt: skip
        iterations += minimum.iterations
        at, weights = minimum.estimate.at, minimum.estimate.weights
        efficiency = loss.efficiency(at.chi2)
        covariance = Covariance(problem.system(at, efficiency * weights))
        sources, seen_sources = variances[:4, None, None] * reckoning.sources, variances[4:, None] * unit
        found = consistency(problem, minimum, covariance, sources, seen_sources, loss.share, efficiency)
        if turn == 0 and not found.sensor_freedom > _LEAST_FREEDOM:
            raise InputError(
                "the landmarks were seen too seldom to estimate the sensor's noise; give a longer log"
            )
        if is_last:
            break
        growth = found.growth(stated / variances)
        if noise is not None:
            growth[:4] = 1.0
        turn += 1
        is_last = turn == _TURNS or bool(np.abs(np.sqrt(growth) - 1.0).max() < _CHANGE)
        variances = np.maximum(variances * growth, _LEAST)
        root, rng = np.sqrt(weights / loss.share)[:, None], np.random.default_rng(0)
        steps = np.array([covariance.sample(rng)[problem.observation_columns] for _ in range(_DRAWS)])
        absorbed = np.sqrt(efficiency) * root * (at.observation_rows @ steps[..., None])[..., 0]
        loss = StudentLoss(sightings.share(sightings.correlation(root * at.observations, absorbed)))
        state = minimum.estimate.state
        if turn <= _RECKONED:
            reckoning = reckon(log, nodes_s, state.calibration[:WHEELS])
        problem = BearingRangeProblem(measurements(reckoning, variances))
    return RangeSolution(
        nodes_s, reckoned, problem, guess, minimum, variances, loss, covariance, found, iterations,
        working_s() - begin,
    )  # fmt: skip
