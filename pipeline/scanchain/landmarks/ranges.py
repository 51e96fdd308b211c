"""Trajectory, landmarks and noise estimated from a log of wheel velocities, ranges and bearings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np
from numpy.typing import NDArray

from scanchain import lie
from scanchain.clock import working_s
from scanchain.data import Matrix, Pose
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
TO_ROBOTS = "range offset to robots"  # on whose bodies the barcodes are; of robots that see each other
OWN_UNITS = ("", " m/rad", "", " rad/m", " s", "", "", " m", " rad", "", " m", " m")
PRIOR_SIGMA = np.array([0.1, 0.1, 0.1, 0.1, 0.3, 0.02, 1.0, 0.05, 0.03, 0.03, 0.1])  # differential drives, cameras
_TO_ROBOTS_M = 0.2  # the same of the offset to robots
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
_STATED = 10.0, 1.0  # degrees of freedom that the prior noise of odometry and sensors counts as
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
    sources, sources_freedom : (S,) the parts of these due to each source of noise, of odometry first
    """

    motion: float
    motion_freedom: float
    sensor: float
    sensor_freedom: float
    sources: NDArray[np.float64]
    sources_freedom: NDArray[np.float64]

    def growth(self, stated: NDArray[np.float64], freedom: NDArray[np.float64]) -> NDArray[np.float64]:
        """Factors by which the variances, those of odometry first, should grow, (S,); one where they are right.

        stated, freedom : (S,) prior values in units of the present ones, and the degrees of freedom they count as
        """
        return (self.sources + freedom * stated) / (self.sources_freedom + freedom)


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

    sources, seen_sources : (M, s, 3, 3), (N, S − s, 2) covariance of motions, variances of bearings and ranges
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
_LEAST = np.square([1e-3, 1e-3, 1e-3, 1e-3]), np.square([3e-4, 3e-4, 1e-4])  # odometry as in OdometryNoise, sensor
_LEAST_FREEDOM = 1e-3  # least redundancy of the observations
_TURNS, _CHANGE = 20, 0.1  # largest number of noise estimates, and the relative change that ends them
_RECKONED = 2  # number of these after which dead reckoning is repeated with the calibration found so far
_MOST, _ROUGH, _FINE, _LITTLE = 50, 1e-2, 1e-5, 1e-10  # iterations; change of χ² that ends them; first damping


@dataclass(frozen=True, slots=True)
class RangeSolution:
    """A minimum, the noise it was found for, and their consistency.

    nodes_s : (K,) times of the poses, those of the observations, robot after robot
    reckoned : dead reckoning by the logged velocities, every landmark where it was first seen
    problem, guess, minimum : problem with the estimated noise; initial guess of the first minimization; result of
        the last one, with the first pose at the origin
    variances : (4 R + 3 G,) of each robot's odometry by sources as in ``OdometryNoise``; of each sensor's
        bearings, ranges, and these per meter: G = R or, with observations of robots, a sensor more, R + 1
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
    def sigmas(self) -> tuple[Matrix, Matrix]:
        """Standard deviations (R, 4) of the robots' odometry and (G, 3) of the sensors, m and rad."""
        wheels, sensors = np.split(np.sqrt(self.variances), [4 * len(self.problem.measurements.starts)])
        return wheels.reshape(-1, 4), sensors.reshape(-1, 3)


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
    begin = working_s()
    model = _Model([log], [np.unique(log.seen_s) if nodes_s is None else nodes_s])
    reckoning, stated = model.reckon(np.zeros((1, WHEELS))), model.stated(noise)
    given = model.measurements(reckoning, stated)
    guess = growing(given, create_solver(ESTIMATOR))
    return _solved(model, noise, reckoning, stated, from_odometry(given), guess, begin)


def solve_range_logs(logs: Sequence[RangeLog], noise: OdometryNoise | None) -> RangeSolution:
    """Estimate several robots in one problem: they see the same landmarks, and each other.

    Each has errors and noise of its own; observations of robots are a sensor more, whose ranges have an offset, as
    the barcodes are on the robots' bodies. The guess is what each robot estimates alone, moved onto the others by
    the landmarks they have in common. Raises InputError as ``solve_range_log`` does, and for a robot without two
    landmarks in common with the others.
    """
    if len(logs) == 1:
        return solve_range_log(logs[0], noise)
    begin = working_s()
    seen = [[each.seen_s[each.subjects == -log.robot] for each in logs] for log in logs]
    nodes = [np.unique(np.concatenate([log.seen_s, *others])) for log, others in zip(logs, seen, strict=True)]
    alone = [
        solve_range_log(log.seen(log.subjects > 0), noise, nodes_s)
        for log, nodes_s in zip(logs, nodes, strict=True)
    ]
    model = _Model(logs, nodes)
    own = np.array([each.minimum.estimate.state.calibration[:WHEELS] for each in alone])
    wheels, sensors = zip(*(np.split(each.variances, [4]) for each in alone), strict=True)
    variances = np.concatenate([*wheels, *sensors, *[SENSOR] * (model.sensors - len(logs))])
    reckoned, guess = _together(logs, alone, model)
    return _solved(model, noise, model.reckon(own), variances, reckoned, guess, begin)


class _Model:
    """Observations of all robots, and the measurements for given systematic errors and noise."""

    def __init__(self, logs: Sequence[RangeLog], nodes: Sequence[NDArray[np.float64]]) -> None:
        """Logs of the robots, and times (K,) of the poses of each."""
        self.logs, self.nodes, robots = logs, nodes, np.arange(len(logs))
        starts = np.cumsum([0, *map(len, nodes[:-1])])
        seen_s, subjects, self.measured = (
            np.concatenate(each)
            for each in zip(*((log.seen_s, log.subjects, log.measured) for log in logs), strict=True)
        )
        robot = np.repeat(robots, [len(log.seen_s) for log in logs])
        self.landmarks, landmark = np.unique(subjects[subjects > 0], return_inverse=True)
        pose, target = np.empty_like(subjects), np.empty_like(subjects)
        target[subjects > 0] = landmark
        for r, (log, nodes_s, start) in enumerate(zip(logs, nodes, starts, strict=True)):
            of, to = robot == r, subjects == -log.robot
            pose[of] = start + np.searchsorted(nodes_s, seen_s[of])
            target[to] = len(self.landmarks) + start + np.searchsorted(nodes_s, seen_s[to])
        sensor = np.where(subjects > 0, robot, len(logs))
        self.observed, self.starts, self.sensors = np.stack([pose, target], axis=1), starts, int(sensor.max()) + 1
        _, pair = np.unique(np.stack([robot, subjects], axis=1), axis=0, return_inverse=True)
        self.sightings = SightingPairs(seen_s, pair)
        self.unit = _by_group(units_of_noise(self.measured), sensor, self.sensors)
        self._driver = np.repeat(robots, [len(each) - 1 for each in nodes])
        is_met = self.sensors > len(logs)
        own, sigma = ((*OWN, TO_ROBOTS), (*PRIOR_SIGMA, _TO_ROBOTS_M)) if is_met else (OWN, PRIOR_SIGMA)
        self.unknowns = len(own)
        sensing = np.tile(np.arange(WHEELS, len(OWN)), (len(subjects), 1))
        sensing[subjects < 0, OWN.index("range offset") - WHEELS] = len(OWN)
        self._sensing, self._sigma = self.unknowns * robot[:, None] + sensing, np.tile(sigma, len(logs))
        self._names = own if len(logs) == 1 else tuple(f"robot {log.robot} {name}" for log in logs for name in own)

    def stated(self, noise: OdometryNoise | None) -> NDArray[np.float64]:
        """Variances (4 R + 3 G,) that are assumed beforehand."""
        wheels = (noise or OdometryNoise()).densities
        return np.concatenate([np.tile(wheels, len(self.logs)), np.tile(SENSOR, self.sensors)])

    def reckon(self, own: Matrix) -> Reckoning:
        """Motions of all robots, with the errors (R, 5) of their wheels; the sources of each are its own."""
        each = [reckon(*given) for given in zip(self.logs, self.nodes, own, strict=True)]
        motion, sources, rest, slope = (
            np.concatenate(parts)
            for parts in zip(*((one.motion, one.sources, one.rest, one.slope) for one in each), strict=True)
        )
        return Reckoning(motion, _by_group(sources, self._driver, len(each)), rest, own.ravel(), slope)

    def measurements(self, reckoning: Reckoning, variances: NDArray[np.float64]) -> Measurements:
        """All measurements, with variances (4 R + 3 G,)."""
        wheels, sensors = np.split(variances, [4 * len(self.logs)])
        own = reckoning.own.reshape(-1, WHEELS)
        value = np.pad(own, ((0, 0), (0, self.unknowns - WHEELS))).ravel()
        moving = self.unknowns * self._driver[:, None] + np.arange(WHEELS)
        return Measurements(
            first_pose=np.zeros(3),
            first_covariance=_ANCHOR * np.eye(3),
            motion=reckoning.motion,
            motion_covariance=reckoning.covariance(wheels),
            calibration=Calibration(self._names, value, self._sigma, moving, reckoning.slope, self._sensing),
            observed=self.observed,
            measured=self.measured,
            measured_covariance=(sensors @ self.unit)[..., None] * np.eye(2),
            landmarks=self.landmarks,
            starts=self.starts,
        )


def _by_group(parts: Matrix, group: NDArray[np.int64], groups: int) -> Matrix:
    """Parts (N, k, ...) each at the place of its group (N,), zeros elsewhere, (N, k · groups, ...)."""
    result = np.zeros((len(parts), groups, *parts.shape[1:]))
    result[np.arange(len(parts)), group] = parts
    return result.reshape(len(parts), groups * parts.shape[1], *parts.shape[2:])


def _together(logs: Sequence[RangeLog], alone: Sequence[RangeSolution], model: _Model) -> tuple[Values, Values]:
    """Dead reckoning and estimates of all robots in the world of the first."""
    where = [np.searchsorted(model.landmarks, each.problem.measurements.landmarks) for each in alone]
    poses, waiting = np.empty((2, sum(map(len, model.nodes)), 3)), list(range(len(logs)))
    landmarks = np.full((2, len(model.landmarks), 2), np.nan)
    T, r = lie.identity(2), 0
    while True:
        waiting.remove(r)
        for k, state in enumerate((alone[r].reckoned, alone[r].minimum.estimate.state)):
            turned = state.poses[:, 2] + np.arctan2(T[1, 0], T[0, 0])
            of = slice(model.starts[r], model.starts[r] + len(turned))
            poses[k, of] = np.column_stack([lie.transform(T, state.poses[:, :2]), turned])
            known = np.isfinite(landmarks[k, where[r]])
            landmarks[k, where[r]] = np.where(known, landmarks[k, where[r]], lie.transform(T, state.landmarks))
        if not waiting:
            break
        is_known = np.isfinite(landmarks[1, :, 0])
        r = max(waiting, key=lambda each: is_known[where[each]].sum())
        common = is_known[where[r]]
        if common.sum() < 2:
            raise InputError(f"{logs[r].name}: saw fewer than two landmarks that other robots saw; leave it out")
        T = _onto(alone[r].minimum.estimate.state.landmarks[common], landmarks[1, where[r][common]])
    own = np.array([each.minimum.estimate.state.calibration for each in alone])
    own = np.pad(own, ((0, 0), (0, model.unknowns - len(OWN)))).ravel()
    return Values(poses[0], landmarks[0], np.zeros_like(own)), Values(poses[1], landmarks[1], own)


def _onto(points: Matrix, others: Matrix) -> Pose:
    """Rigid motion of points (n, 2) onto others by two of them, of least median distance (Rousseeuw 1984)."""
    candidates = list[tuple[float, Pose]]()
    for pair in map(list, combinations(range(len(points)), 2)):
        (ax, ay), (bx, by) = points[pair[1]] - points[pair[0]], others[pair[1]] - others[pair[0]]
        T = lie.pose_2d(0.0, 0.0, np.arctan2(ax * by - ay * bx, ax * bx + ay * by))
        T[:2, 2] = (others[pair] - lie.transform(T, points[pair])).mean(axis=0)
        off_m = np.linalg.norm(lie.transform(T, points) - others, axis=1)
        candidates.append((float(np.median(off_m)), T))
    return min(candidates, key=lambda each: each[0])[1]


def _solved(
    model: _Model,
    noise: OdometryNoise | None,
    reckoning: Reckoning,
    variances: NDArray[np.float64],
    reckoned: Values,
    guess: Values,
    begin: float,
) -> RangeSolution:
    """The minimum from a guess, with the noise found for it by restricted maximum likelihood."""
    solver, stated, wheels = create_solver(ESTIMATOR), model.stated(noise), 4 * len(model.logs)
    counted = np.repeat(_STATED, [wheels, len(stated) - wheels])
    least = np.concatenate([np.tile(_LEAST[0], len(model.logs)), np.tile(_LEAST[1], model.sensors)])
    loss = StudentLoss(np.ones(len(model.observed)))
    problem = BearingRangeProblem(model.measurements(reckoning, variances))
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
        sources = variances[:wheels, None, None] * reckoning.sources
        seen_sources = variances[wheels:, None] * model.unit
        found = consistency(problem, minimum, covariance, sources, seen_sources, loss.share, efficiency)
        if turn == 0 and not found.sensor_freedom > _LEAST_FREEDOM:
            raise InputError(
                f"{model.logs[0].name}: the landmarks were seen too seldom to estimate the sensor's noise; "
                "give a longer log"
            )
        if is_last:
            break
        growth = found.growth(stated / variances, counted)
        if noise is not None:
            growth[:wheels] = 1.0
        turn += 1
        is_last = turn == _TURNS or bool(np.abs(np.sqrt(growth) - 1.0).max() < _CHANGE)
        variances = np.maximum(variances * growth, least)
        root, rng = np.sqrt(weights / loss.share)[:, None], np.random.default_rng(0)
        steps = np.array([covariance.sample(rng)[problem.observation_columns] for _ in range(_DRAWS)])
        absorbed = np.sqrt(efficiency) * root * (at.observation_rows @ steps[..., None])[..., 0]
        loss = StudentLoss(model.sightings.share(model.sightings.correlation(root * at.observations, absorbed)))
        state = minimum.estimate.state
        if turn <= _RECKONED:
            reckoning = model.reckon(state.calibration.reshape(-1, model.unknowns)[:, :WHEELS])
        problem = BearingRangeProblem(model.measurements(reckoning, variances))
    return RangeSolution(
        np.concatenate(model.nodes), reckoned, problem, guess, minimum, variances, loss, covariance, found,
        iterations, working_s() - begin,
    )  # fmt: skip
