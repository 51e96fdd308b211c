"""A robot made up with errors of its own and noise, and what the estimate makes of its log."""

import numpy as np
import pytest

from scanchain.landmarks.estimate import chain
from scanchain.landmarks.files import RangeLog
from scanchain.landmarks.ranges import OWN, OdometryNoise, SightingPairs, reckon, solve_range_log

OF_ITS_OWN = np.array([0.0, -0.05, 0.04, -0.03, 0.2])  # of its wheels
NOISE = OdometryNoise(0.02, 0.01, 0.03, 0.05)
SIGMAS = np.array([0.02, 0.05])


def made_up_log(seed, duration_s=600.0, alike=0.0):
    """A drive among 12 landmarks, seen within 5 m ahead; its true poses at the observations, its landmarks.

    alike : correlation of the errors of a landmark's successive sightings
    """
    rng = np.random.default_rng(seed)
    times = np.arange(0.0, duration_s, 0.5)
    turning = np.repeat(rng.choice([0.0, 0.3, -0.3, 0.1], len(times) // 8 + 1), 8)[: len(times)]
    velocities = np.stack([np.full(len(times), 0.1), turning], axis=1)
    nodes = np.sort(rng.uniform(2.0, duration_s - 1.0, int(2.0 * duration_s)))

    def logged(*seen):
        return RangeLog(
            "made up", 1, times, velocities, *seen, 0, 0, 0, np.zeros(0), np.zeros((0, 3)), np.zeros(0, int),
            np.zeros((0, 2)),
        )  # fmt: skip

    reckoning = reckon(logged(nodes, np.zeros(0, int), np.zeros((0, 2))), nodes, OF_ITS_OWN)
    roots = np.linalg.cholesky(reckoning.covariance(NOISE.densities))
    moves = reckoning.motion + (roots @ rng.normal(size=(*reckoning.motion.shape, 1)))[..., 0]
    poses = chain(np.zeros(3), moves)
    low, high = poses[:, :2].min(axis=0) - 1.0, poses[:, :2].max(axis=0) + 1.0
    landmarks = rng.uniform(low, high, (12, 2))
    seen, rows, noise = [], [], {}
    for k, (x, y, heading) in enumerate(poses):
        away = landmarks - [x, y]
        bearing = (np.arctan2(away[:, 1], away[:, 0]) - heading + np.pi) % (2.0 * np.pi) - np.pi
        for j in np.flatnonzero((np.hypot(*away.T) < 5.0) & (np.abs(bearing) < 1.0)).tolist():
            fresh = rng.normal(size=2)
            noise[j] = alike * noise[j] + np.sqrt(1.0 - alike**2) * fresh if j in noise else fresh
            seen.append((k, j + 6))
            rows.append(np.array([bearing[j], np.hypot(*away[j])]) + SIGMAS * noise[j])
    which, subjects = np.array(seen).T
    log = logged(nodes[which], subjects, np.array(rows))
    return log, poses[np.unique(which)], landmarks, poses[which[0]]


def from_first(first, points):
    """Points of the world as the first pose sees them."""
    c, s = np.cos(first[2]), np.sin(first[2])
    return (points - first[:2]) @ np.array([[c, -s], [s, c]])


def squared_distances(solution, landmarks, first):
    """Of every landmark from the true one, in units of its covariance, divided by its dimension."""
    off = solution.minimum.estimate.state.landmarks - from_first(
        first, landmarks[solution.problem.measurements.landmarks - 6]
    )
    return np.einsum("li,lij,lj->l", off, np.linalg.inv(solution.covariance.landmarks), off) / 2.0


def test_the_robots_own_errors_the_noise_and_its_effect_are_found():
    consistency, own = [], []
    for seed in range(4):
        log, poses, landmarks, first = made_up_log(seed)
        solution = solve_range_log(log, None)
        consistency.append(squared_distances(solution, landmarks, first).mean())
        own.append(solution.minimum.estimate.state.calibration)
        bearing_rad, range_m, range_share = solution.sigmas[1][0]
        assert bearing_rad == pytest.approx(SIGMAS[0] * 0.85, rel=0.25)  # Student's scale: smaller
        spread_m = np.hypot(range_m, 3.0 * range_share)  # at 3 m
        assert spread_m == pytest.approx(SIGMAS[1] * 0.85, rel=0.25)
        noise = solution.consistency
        assert solution.minimum.converged and 0.7 < noise.motion / noise.motion_freedom < 1.3
        found = from_first(first, poses[:, :2])
        assert np.sqrt(np.mean((solution.minimum.estimate.state.poses[:, :2] - found) ** 2)) < 0.15
    off = np.abs(np.mean(own, axis=0)[:5] - OF_ITS_OWN)
    assert np.all(off < [0.05, 0.05, 0.05, 0.02, 0.06]), dict(zip(OWN, off, strict=False))
    assert 0.3 < np.mean(consistency) < 2.0


def test_sightings_that_err_alike_count_as_fewer_and_leave_the_covariance_honest():
    log, _, landmarks, first = made_up_log(7, alike=0.95)
    solution = solve_range_log(log, None)
    assert solution.loss.share.sum() < 0.5 * len(log.seen_s)
    assert squared_distances(solution, landmarks, first).mean() < 4.0


def test_a_share_is_one_over_the_sum_of_a_sightings_correlations():
    seen_s, landmarks = np.array([0.0, 0.4, 0.7, 30.0, 0.1]), np.array([0, 0, 0, 0, 1])
    likeness = SightingPairs(seen_s, landmarks)
    correlation = np.array([0.5, 0.25, 0.0, 0.0, 0.0, 0.0])  # up to 0.5 s, up to 1 s, beyond
    assert np.allclose(likeness.share(correlation), [1 / 1.75, 1 / 2.0, 1 / 1.75, 1.0, 1.0])


def test_slopes_of_the_motion_equal_central_differences():
    log = made_up_log(1, duration_s=60.0)[0]
    nodes_s = np.unique(log.seen_s)
    slope = reckon(log, nodes_s, np.zeros(5)).slope
    for column, step in enumerate((1e-4, 1e-4, 1e-4, 1e-4, 0.05)):
        away = np.zeros(5)
        away[column] = step
        ahead, behind = (reckon(log, nodes_s, sign * away).motion for sign in (1.0, -1.0))
        expected = (ahead - behind) / (2.0 * step)
        assert np.median(np.abs(slope[..., column] - expected)) < 1e-3
