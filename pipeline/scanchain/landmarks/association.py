"""Data association without barcodes: a Kalman filter with joint compatibility, then the batch estimate."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import combinations, permutations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components
from scipy.spatial import KDTree

from scanchain.data import Matrix
from scanchain.errors import InputError
from scanchain.kernels.landmarks import factors
from scanchain.landmarks.estimate import chain
from scanchain.landmarks.files import RangeLog
from scanchain.landmarks.problem import Values, landmark_columns
from scanchain.landmarks.ranges import (
    OWN,
    PRIOR_SIGMA,
    SENSOR,
    WHEELS,
    OdometryNoise,
    RangeSolution,
    reckon,
    solve_range_log,
    units_of_noise,
)  # fmt: skip

_GATES = np.array([0.0, 11.8, 16.3, 20.1, 23.5, 26.7, 29.7, 32.6])  # 99.7 % of χ² of up to 7 sightings
_NEW = 25.0  # χ² of the nearest landmark above which a sighting is of another one
_INFLATION = 3.0  # of the filter's noise, as errors of successive sightings are correlated
_CANDIDATES = 4  # largest number of landmarks that a sighting may be of
_CLEAR = 6.0  # least difference of χ² from the second-best hypothesis
_FEWEST = 4  # least number of sightings of a landmark
_CLOSE_M = 0.08  # distance of sightings of one new landmark
_TRACKED_S = 5.0  # longest time out of sight within a track
_RIM = 0.05  # share of the sightings at either end of bearings and ranges
_VISIT = 5  # shortest visit in instants, missed by chance in 3 % if half of the sightings drop out
_ROUNDS = 8  # largest number of batch estimates
_FIRST = 3 + len(OWN)  # unknowns of the filter before those of the landmarks


def associated(log: RangeLog, noise: OdometryNoise | None) -> tuple[RangeLog, RangeSolution]:
    """The log with landmarks as data association numbers them, without sightings of none, and its solution.

    The filter decides on the sightings of an instant jointly (Neira & Tardós 2001): as many compatible ones as
    possible, then the least χ²; those on which the second-best hypothesis is almost as good are left open. Every
    sighting is then associated again with landmarks of the batch estimate, or with a new one, and landmarks that
    are the same are merged, until nothing changes or a few times. As long as landmarks are missed where they
    should be in view, the filter begins again, with better systematic errors, then at the end of the log; the
    estimate with the least share of missed visits is returned. Raises InputError if no landmark is seen again.
    """
    best: tuple[RangeLog, RangeSolution] | None = None
    for is_backward in (False, True):
        try:
            for found in _attempts(log, noise, is_backward=is_backward):
                best = found if best is None else min(best, found, key=_missed_share)
                if _missed_share(best) == 0.0:
                    return best
        except InputError:
            if best is None:
                raise
    assert best is not None
    return best


def _attempts(
    log: RangeLog, noise: OdometryNoise | None, *, is_backward: bool
) -> Iterator[tuple[RangeLog, RangeSolution]]:
    """Estimates with systematic errors in the filter by their priors, by short tracks, and as estimated before.

    On short tracks no landmark is recognized again, so that wrong associations cannot distort the errors.
    """
    subjects = _filtered(log, noise, None, is_backward=is_backward)
    found = [_settled(log, noise, subjects)]
    yield found[0]
    for is_local in (True, False):
        start = min(found, key=_missed_share)[1]
        if is_local:
            start = solve_range_log(_with(log, _tracks(log, subjects)), noise)
        found.append(_settled(log, noise, _filtered(log, noise, start, is_backward=is_backward)))
        yield found[-1]


def visits(part: RangeLog, solution: RangeSolution) -> NDArray[np.int64]:
    """Numbers of visits on which each landmark is seen, and on which it is missed, (2, L).

    A visit is a run of instants at which a landmark is well within the bearings and ranges of the log's sightings.
    """
    state, (node, landmark) = solution.minimum.estimate.state, solution.problem.measurements.observed.T
    predicted, _ = _residuals(state, np.arange(len(state.poses)), np.zeros((len(state.poses), 2)))
    low, high = np.quantile(part.measured, (_RIM, 1.0 - _RIM), axis=0)
    in_view = ((predicted > low) & (predicted < high)).all(axis=2).T
    in_view = np.pad(in_view, ((0, 0), (1, 1)))  # a visit ends where the log does
    seen = np.zeros_like(in_view)
    seen[landmark, node + 1] = True
    begin, end = np.flatnonzero(np.diff(in_view.ravel(), prepend=False)).reshape(-1, 2).T
    before = np.append(0, np.cumsum(seen))
    of, is_long, is_seen = begin // in_view.shape[1], end - begin >= _VISIT, before[end] > before[begin]
    return np.array([np.bincount(of[is_long & each], minlength=len(seen)) for each in (is_seen, ~is_seen)])


def contradicted(part: RangeLog, solution: RangeSolution) -> NDArray[np.int64]:
    """Landmarks that are missed on at least two visits more than they are seen on: duplicates, or poses are wrong.

    One visit more is no evidence, as landmarks that stand side by side hide each other.
    """
    seen, missed = visits(part, solution)
    return solution.problem.measurements.landmarks[missed > seen + 1]


def _missed_share(found: tuple[RangeLog, RangeSolution]) -> float:
    """Share of the visits on which the landmark is missed."""
    seen, missed = visits(*found).sum(axis=1)
    return float(missed / max(seen + missed, 1))


def _settled(
    log: RangeLog, noise: OdometryNoise | None, subjects: NDArray[np.int64], rounds: int = _ROUNDS
) -> tuple[RangeLog, RangeSolution]:
    """The log and its solution after all sightings are associated with the batch estimate, again and again."""
    part = _with(log, subjects)
    solution = solve_range_log(part, noise, np.unique(log.seen_s))
    after = _reassociated(log, part, solution)
    if rounds == 1 or np.array_equal(after, subjects):
        return part, solution
    return _settled(log, noise, after, rounds - 1)


def _tracks(log: RangeLog, subjects: NDArray[np.int64]) -> NDArray[np.int64]:
    """Landmarks (N,), each another one after it was out of sight, so that none is recognized again; 0 stays."""
    order = np.lexsort((log.seen_s, subjects))
    is_new = (np.diff(subjects[order]) != 0) | (np.diff(log.seen_s[order]) > _TRACKED_S)
    return np.where(subjects > 0, np.cumsum(np.append(1, is_new))[np.argsort(order)], 0)


def _with(log: RangeLog, subjects: NDArray[np.int64]) -> RangeLog:
    """The log with these landmarks (N,), without sightings of 0 and of landmarks that are seen too seldom."""
    _, number, counts = np.unique(subjects, return_inverse=True, return_counts=True)
    kept = (subjects > 0) & (counts[number] >= _FEWEST)
    if len(set(subjects[kept].tolist())) < 2:
        raise InputError(
            f"{log.name}: without barcodes fewer than two landmarks are recognized again; give a longer log, "
            "or leave out --ignore-barcodes"
        )
    return log.seen(kept, subjects)


class _Filter:
    """Pose, systematic errors and landmarks, x (n,) with covariance P."""

    def __init__(self, own: NDArray[np.float64], sigma: NDArray[np.float64]) -> None:
        """Begin with these systematic errors (11,) and their standard deviations."""
        self.x, self.P = np.append(np.zeros(3), own), np.diag(np.append(np.zeros(3), sigma) ** 2)

    def predict(self, motion: Matrix, slope: Matrix, covariance: Matrix) -> None:
        """Move by a motion (3,) whose derivative by the wheels' errors is slope (3, 5)."""
        moved = motion + slope @ self.x[3 : 3 + WHEELS]
        c, s = np.cos(self.x[2]), np.sin(self.x[2])
        G, F = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]), np.eye(len(self.x))
        F[:2, 2] = -s * moved[0] - c * moved[1], c * moved[0] - s * moved[1]
        F[:3, 3 : 3 + WHEELS] = G @ slope
        self.x[:3] = chain(self.x[:3], moved[None])[1]
        self.P = F @ self.P @ F.T
        self.P[:3, :3] += G @ covariance @ G.T

    def add(self, measured: NDArray[np.float64], R: Matrix) -> None:
        """Add the landmark of a sighting, whose bearing and range determine it."""
        angle = self.x[2] + measured[0]
        self.x = np.append(self.x, self.x[:2] + measured[1] * np.array([np.cos(angle), np.sin(angle)]))
        rest, own = np.split(self.innovations(measured[None])[1][0, -1], [len(self.x) - 2], axis=1)
        inverse = np.linalg.inv(own)
        cross = -inverse @ rest @ self.P
        corner = inverse @ (rest @ self.P @ rest.T + R) @ inverse.T
        self.P = np.block([[self.P, cross.T], [cross, corner]])

    def innovations(self, measured: Matrix) -> tuple[Matrix, Matrix]:
        """Residuals r (N, L, 2), predicted from measured, and Jacobians H (N, L, 2, n), of every landmark."""
        state = Values(self.x[None, :3], self.x[_FIRST:].reshape(-1, 2), self.x[3:_FIRST])
        r, J = _residuals(state, np.zeros(len(measured), np.int64), measured)
        H = np.zeros((*r.shape, len(self.x)))
        H[..., :3], H[..., 3 + WHEELS : _FIRST] = J[..., :3], J[..., 5:]
        for k, first in enumerate(range(_FIRST, len(self.x), 2)):
            H[:, k, :, first : first + 2] = J[:, k, :, 3:5]
        return r, H

    def update(self, r: NDArray[np.float64], H: Matrix, R: Matrix) -> None:
        """Correct by residuals r (2 m,) of covariance R, predicted from measured."""
        gain = np.linalg.solve(H @ self.P @ H.T + R, H @ self.P).T
        self.x = self.x - gain @ r
        self.P -= gain @ H @ self.P
        self.P = 0.5 * (self.P + self.P.T)


def _residuals(state: Values, nodes: NDArray[np.int64], measured: Matrix) -> tuple[Matrix, Matrix]:
    """Residuals (N, L, 2), predicted from measured, of all landmarks at nodes (N,); Jacobians (N, L, 2, 11)."""
    shape = len(nodes), len(state.landmarks)
    observed = np.stack([np.repeat(nodes, shape[1]), np.tile(np.arange(shape[1]), shape[0])], axis=1)
    r, J = np.empty((len(observed), 2)), np.empty((len(observed), 2, 11))
    factors.bearing_range(
        state.poses, state.landmarks, observed, np.repeat(measured, shape[1], axis=0),
        np.tile(np.eye(2), (len(observed), 1, 1)), state.calibration,
        np.tile(np.arange(WHEELS, len(OWN)), (len(observed), 1)), r, J,
    )  # fmt: skip
    return r.reshape(*shape, 2), J.reshape(*shape, 2, 11)


def _filtered(
    log: RangeLog, noise: OdometryNoise | None, start: RangeSolution | None, *, is_backward: bool = False
) -> NDArray[np.int64]:
    """Landmark of every sighting by the filter, (N,); 0 where it is left open.

    start : solution with the systematic errors and the noise of the sensor to begin with; None for their priors
    is_backward : whether it runs from the end of the log to its beginning
    """
    own, sigma, sensor = np.zeros(len(OWN)), PRIOR_SIGMA, SENSOR
    if start is not None:
        own, sensor = start.minimum.estimate.state.calibration, np.minimum(start.variances[4:], SENSOR)
        sigma = np.minimum(_INFLATION * start.covariance.calibration, PRIOR_SIGMA)
    nodes_s, node = np.unique(log.seen_s, return_inverse=True)
    reckoning, now = reckon(log, nodes_s, own[:WHEELS]), _Filter(own, sigma)
    motion = reckoning.motion - reckoning.slope @ own[:WHEELS]  # without these errors, as linearized there
    slope, covariance = reckoning.slope, reckoning.covariance((noise or OdometryNoise()).densities)
    variances = _INFLATION * sensor @ units_of_noise(log.measured)
    subjects = np.zeros(len(node), np.int64)
    instants = np.split(np.arange(len(node)), np.flatnonzero(np.diff(node)) + 1)
    if is_backward:
        instants.reverse()
        motion, J = _inverse(motion[::-1])
        slope, covariance = J @ slope[::-1], J @ covariance[::-1] @ np.swapaxes(J, 1, 2)
    for k, seen in enumerate(instants):
        if k:
            now.predict(motion[k - 1], slope[k - 1], covariance[k - 1])
        r, H = now.innovations(log.measured[seen])
        R, known = variances[seen], r.shape[1]
        S = H @ now.P @ np.swapaxes(H, -1, -2) + R[:, None, :, None] * np.eye(2)
        alone = (r[..., None, :] @ np.linalg.solve(S, r[..., None]))[..., 0, 0]
        found = sorted(_hypotheses(now.P, r, H, R, alone), key=lambda each: (-np.count_nonzero(each[0]), each[1]))
        chosen = np.array(found[0][0])
        for other, chi2 in found[1:]:
            if np.count_nonzero(other) == np.count_nonzero(chosen) and chi2 - found[0][1] < _CLEAR:
                chosen = np.where(chosen == np.array(other), chosen, 0)
        pairs = np.flatnonzero(chosen), chosen[chosen > 0] - 1
        if len(pairs[0]):
            now.update(r[pairs].ravel(), H[pairs].reshape(2 * len(pairs[0]), -1), np.diag(R[pairs[0]].ravel()))
        subjects[seen] = chosen
        free = np.setdiff1d(np.arange(known), chosen - 1)
        for i in np.flatnonzero((chosen == 0) & (alone[:, free] > _NEW).all(axis=1)):
            now.add(log.measured[seen[i]], np.diag(R[i]))
            subjects[seen[i]] = (len(now.x) - _FIRST) // 2
    return subjects


def _inverse(motion: Matrix) -> tuple[Matrix, Matrix]:
    """Inverse motions (M, 3), and their Jacobians (M, 3, 3)."""
    x, y, angle = motion.T
    c, s = np.cos(angle), np.sin(angle)
    inverse, zero = np.stack([-c * x - s * y, s * x - c * y, -angle], axis=1), np.zeros_like(x)
    J = np.array([[-c, -s, inverse[:, 1]], [s, -c, -inverse[:, 0]], [zero, zero, zero - 1.0]])
    return inverse, np.ascontiguousarray(J.transpose(2, 0, 1))


def _chi2(P: Matrix, r: Matrix, H: Matrix, R: Matrix) -> float:
    """Joint χ² of residuals r (m, 2) with Jacobians H (m, 2, n) and variances R (m, 2)."""
    H, r = H.reshape(2 * len(H), -1), r.ravel()
    return float(r @ np.linalg.solve(H @ P @ H.T + np.diag(R.ravel()), r))


def _hypotheses(
    P: Matrix, r: Matrix, H: Matrix, R: Matrix, alone: Matrix, chosen: tuple[int, ...] = ()
) -> Iterator[tuple[tuple[int, ...], float]]:
    """Jointly compatible landmarks (from 1, 0 for none) of the sightings of an instant, with their χ².

    r, H, R : (m, L, 2), (m, L, 2, n), (m, 2); alone (m, L) χ² of each pairing alone
    """
    pairs = [i for i, each in enumerate(chosen) if each], [each - 1 for each in chosen if each]
    chi2 = _chi2(P, r[pairs], H[pairs], R[pairs[0]]) if pairs[0] else 0.0
    if chi2 > _GATES[min(len(pairs[0]), len(_GATES) - 1)]:
        return
    if len(chosen) == len(r):
        yield chosen, chi2
        return
    each = alone[len(chosen)]
    for landmark in np.argsort(each)[:_CANDIDATES].tolist():
        if each[landmark] < _GATES[1] and landmark + 1 not in chosen:
            yield from _hypotheses(P, r, H, R, alone, (*chosen, landmark + 1))
    yield from _hypotheses(P, r, H, R, alone, (*chosen, 0))


def _reassociated(log: RangeLog, part: RangeLog, solution: RangeSolution) -> NDArray[np.int64]:
    """Nearest landmark of every sighting, (N,), by χ²; sightings far from all are of new ones, by position.

    Their noise is that estimated, but no more than the typical one: wrong associations increase it.
    """
    state, names = solution.minimum.estimate.state, solution.problem.measurements.landmarks
    node = np.searchsorted(solution.nodes_s, log.seen_s)
    r, _ = _residuals(state, node, log.measured)
    variances = np.minimum(solution.variances[4:], SENSOR) @ units_of_noise(log.measured)
    chi2 = (r**2 / variances[:, None]).sum(axis=2)
    result, alone = _merged(part, solution)[chi2.argmin(axis=1)], np.flatnonzero(chi2.min(axis=1) > _NEW)
    bearing, m = log.measured[alone].T
    c = state.calibration[WHEELS:]
    pose, reach = state.poses[node[alone]], (m - c[2]) / (1.0 + c[0] - c[1] * (1.0 - np.cos(bearing)))
    angle = pose[:, 2] + bearing
    points = pose[:, :2] + reach[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=1)
    pairs = KDTree(points).query_pairs(_CLOSE_M, output_type="ndarray")
    _, group = connected_components(coo_array((np.ones(len(pairs)), pairs.T), (len(points), len(points))))
    result[alone] = names.max() + 1 + group
    return result


def _merged(part: RangeLog, solution: RangeSolution) -> NDArray[np.int64]:
    """Names of the landmarks (L,), the first's for two that may be the same and are never seen at one instant."""
    names, layout = solution.problem.measurements.landmarks, solution.problem.pattern.layout
    instants = np.split(part.subjects, np.flatnonzero(np.diff(part.seen_s)) + 1)
    together = {pair for each in instants for pair in permutations(each.tolist(), 2)}
    result, D = names.copy(), np.hstack([-np.eye(2), np.eye(2)])
    for i, j in combinations(range(len(names)), 2):
        C = solution.covariance.of(landmark_columns(layout, np.array([i, j])).reshape(1, 4))[0]
        off = np.diff(solution.minimum.estimate.state.landmarks[[i, j]], axis=0)[0]
        if (names[i], names[j]) not in together and off @ np.linalg.solve(D @ C @ D.T, off) < _GATES[1]:
            result[j] = min(result[i], result[j])
    return result
