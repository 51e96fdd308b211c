"""Data association without barcodes: a Kalman filter with joint compatibility, then the batch estimate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
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
from scanchain.landmarks.problem import landmark_columns
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
_ROUNDS = 7  # largest number of batch estimates
_FIRST = 3 + len(OWN)  # unknowns of the filter before those of the landmarks


def associated(log: RangeLog, noise: OdometryNoise | None) -> tuple[RangeLog, RangeSolution]:
    """The log with landmarks as data association numbers them, without sightings of none, and its solution.

    The filter decides on the sightings of an instant jointly (Neira & Tardós 2001): as many compatible ones as
    possible, then the least χ²; those on which the second-best hypothesis is almost as good are left open. Every
    sighting is then associated again with landmarks of the batch estimate, or with a new one, and landmarks that
    are the same are merged, until nothing changes or a few times. Raises InputError if no landmark is seen again.
    """
    nodes_s, subjects = np.unique(log.seen_s), _filtered(log, noise or OdometryNoise())
    part = _with(log, subjects)
    solution = solve_range_log(part, noise, nodes_s)
    for _ in range(_ROUNDS):
        before, subjects = subjects, _reassociated(log, part, solution)
        if np.array_equal(before, subjects):
            break
        part = _with(log, subjects)
        solution = solve_range_log(part, noise, nodes_s)
    return part, solution


def _with(log: RangeLog, subjects: NDArray[np.int64]) -> RangeLog:
    """The log with these landmarks (N,), without sightings of 0 and of landmarks that are seen too seldom."""
    _, number, counts = np.unique(subjects, return_inverse=True, return_counts=True)
    kept = (subjects > 0) & (counts[number] >= _FEWEST)
    if len(set(subjects[kept].tolist())) < 2:
        raise InputError(
            f"{log.name}: without barcodes fewer than two landmarks are recognized again; give a longer log, "
            "or leave out --ignore-barcodes"
        )
    return replace(log, seen_s=log.seen_s[kept], subjects=subjects[kept], measured=log.measured[kept])


class _Filter:
    """Pose, systematic errors and landmarks, x (n,) with covariance P."""

    def __init__(self) -> None:
        self.x, self.P = np.zeros(_FIRST), np.zeros((_FIRST, _FIRST))
        self.P[range(3, _FIRST), range(3, _FIRST)] = PRIOR_SIGMA**2

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
        n = len(self.x) - 2
        _, H = self.innovations(measured[None], np.array([(n - _FIRST) // 2]))
        inverse, rest = np.linalg.inv(H[0][:, n:]), H[0][:, :n]
        cross = -inverse @ rest @ self.P
        own = inverse @ (rest @ self.P @ rest.T + R) @ inverse.T
        self.P = np.block([[self.P, cross.T], [cross, own]])

    def innovations(self, measured: Matrix, landmarks: NDArray[np.int64]) -> tuple[Matrix, Matrix]:
        """Residuals r (N, 2), predicted from measured, and Jacobians H (N, 2, n), of these landmarks (N,)."""
        count, points = len(landmarks), self.x[_FIRST:].reshape(-1, 2)
        r, J, H = np.empty((count, 2)), np.empty((count, 2, 11)), np.zeros((count, 2, len(self.x)))
        sensing = np.tile(np.arange(WHEELS, len(OWN)), (count, 1))
        factors.bearing_range(
            self.x[None, :3], points, np.stack([np.zeros_like(landmarks), landmarks], axis=1), measured,
            np.tile(np.eye(2), (count, 1, 1)), self.x[3:_FIRST], sensing, r, J,
        )  # fmt: skip
        at = _FIRST + 2 * landmarks[:, None] + np.arange(2)
        H[:, :, :3], H[:, :, 3 + WHEELS : _FIRST] = J[..., :3], J[..., 5:]
        np.put_along_axis(H, at[:, None].repeat(2, axis=1), J[..., 3:5], axis=2)
        return r, H

    def update(self, r: NDArray[np.float64], H: Matrix, R: Matrix) -> None:
        """Correct by residuals r (2 m,) of covariance R, predicted from measured."""
        gain = np.linalg.solve(H @ self.P @ H.T + R, H @ self.P).T
        self.x = self.x - gain @ r
        self.P -= gain @ H @ self.P
        self.P = 0.5 * (self.P + self.P.T)


def _filtered(log: RangeLog, noise: OdometryNoise) -> NDArray[np.int64]:
    """Landmark of every sighting by the filter, (N,); 0 where it is left open."""
    nodes_s, node = np.unique(log.seen_s, return_inverse=True)
    reckoning, now = reckon(log, nodes_s, np.zeros(WHEELS)), _Filter()
    covariance, variances = (
        reckoning.covariance(noise.densities),
        _INFLATION * SENSOR @ units_of_noise(log.measured),
    )
    subjects = np.zeros(len(node), np.int64)
    for k, seen in enumerate(np.split(np.arange(len(node)), np.flatnonzero(np.diff(node)) + 1)):
        if k:
            now.predict(reckoning.motion[k - 1], reckoning.slope[k - 1], covariance[k - 1])
        known = (len(now.x) - _FIRST) // 2
        r, H = now.innovations(log.measured[np.repeat(seen, known)], np.tile(np.arange(known), len(seen)))
        r, H, R = r.reshape(len(seen), known, 2), H.reshape(len(seen), known, 2, len(now.x)), variances[seen]
        pairs = np.ndindex(len(seen), known)
        alone = np.reshape(
            [_chi2(now.P, r[i, j][None], H[i, j][None], R[[i]]) for i, j in pairs], (len(seen), known)
        )
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
    count, known = len(log.seen_s), len(names)
    r, J = np.empty((count * known, 2)), np.empty((count * known, 2, 11))
    observed = np.stack([np.repeat(node, known), np.tile(np.arange(known), count)], axis=1)
    factors.bearing_range(
        state.poses, state.landmarks, observed, np.repeat(log.measured, known, axis=0),
        np.tile(np.eye(2), (len(observed), 1, 1)), state.calibration,
        np.tile(np.arange(WHEELS, len(OWN)), (len(observed), 1)), r, J,
    )  # fmt: skip
    variances = np.minimum(solution.variances[4:], SENSOR) @ units_of_noise(log.measured)
    chi2 = (r.reshape(count, known, 2) ** 2 / variances[:, None]).sum(axis=2)
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
