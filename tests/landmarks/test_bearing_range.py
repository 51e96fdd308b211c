from itertools import product

import numpy as np
import pytest

from scanchain.graph.losses import RobustLoss
from scanchain.kernels.landmarks import factors
from scanchain.landmarks import estimate as guesses
from scanchain.landmarks.estimate import QUADRATIC, minimize
from scanchain.landmarks.files import read_landmark_data
from scanchain.landmarks.problem import BearingRangeProblem, Measurements, Values, no_calibration
from scanchain.landmarks.solvers import METHODS, create_solver
from tests.support import naive_landmarks
from tests.support.naive_landmarks import numeric_jacobian
from tests.support.scenes import shared_data


def observed(pose, landmark, bearing, reach, own=()):
    """Residual and Jacobian of one bearing and range, with systematic errors of the sensor."""
    residuals, jacobians = np.empty((1, 2)), np.empty((1, 2, len(pose) + 2 + len(own)))
    pair, measured = np.zeros((1, 2), np.int64), np.array([[bearing, reach]])
    factors.bearing_range(
        pose[None], landmark[None], pair, measured, np.eye(2)[None], np.array(own, float),
        np.arange(len(own))[None], residuals, jacobians,
    )  # fmt: skip
    return residuals[0], jacobians[0]


@pytest.mark.parametrize("size", [2, 3])
@pytest.mark.parametrize("bearing", [0.3, np.pi - 1e-9, -np.pi + 1e-9, -3.0])
def test_bearing_and_range_equal_the_naive_ones_and_finite_differences(size, bearing):
    rng = np.random.default_rng(1)
    pose, landmark = np.array([1.0, -2.0, 2.8])[:size], rng.normal(size=2) * 3.0
    r, J = observed(pose, landmark, bearing, 2.0)
    assert np.allclose(r, naive_landmarks.bearing_range(pose, landmark, bearing, 2.0), atol=1e-12)

    def residual(x):
        return naive_landmarks.bearing_range(x[:size], x[size:], r[0] + bearing, 2.0)  # far from the wrap

    assert np.allclose(J, numeric_jacobian(residual, np.concatenate([pose, landmark])), atol=1e-8)


@pytest.mark.parametrize("bearing", [0.3, -0.5, np.pi - 1e-9])
def test_the_sensors_systematic_errors_equal_the_naive_ones_and_finite_differences(bearing):
    rng = np.random.default_rng(2)
    own = 0.1 * rng.normal(size=6) + np.array([0.0, 1.0, 0.0, 0.0, 0.0, 0.0])
    pose, landmark = (
        np.array([1.0, -2.0, 2.8]),
        np.array([1.0, -2.0]) + 3.0 * np.array([np.cos(2.8 + 0.2), np.sin(2.8 + 0.2)]),
    )
    r, J = observed(pose, landmark, bearing, 2.0, own)
    assert np.allclose(r, naive_landmarks.bearing_range(pose, landmark, bearing, 2.0, own), atol=1e-12)

    def residual(x):
        return naive_landmarks.bearing_range(x[:3], x[3:5], bearing, 2.0, x[5:])

    assert np.allclose(J, numeric_jacobian(residual, np.concatenate([pose, landmark, own])), atol=1e-7)


def test_a_landmark_on_top_of_its_pose_is_pulled_by_the_range_alone():
    r, J = observed(np.array([1.0, 2.0, 0.5]), np.array([1.0, 2.0]), 0.2, 3.0)
    assert np.array_equal(r, [0.0, -3.0]) and not J[0].any()
    assert np.allclose(J[1], [-np.cos(0.7), -np.sin(0.7), 0.0, np.cos(0.7), np.sin(0.7)])


@pytest.mark.parametrize("turn", [0.4, 3.1, -3.1])
def test_odometry_equals_the_naive_one_and_finite_differences(turn):
    first, second, moved = np.array([1.0, 2.0, 3.0]), np.array([2.5, 1.0, 3.0 + turn]), np.array([0.4, 0.1, turn])
    residuals, jacobians = np.empty((1, 3)), np.empty((1, 3, 6))
    factors.odometry(
        np.stack([first, second]), np.zeros(1, int), moved[None], np.eye(3)[None], residuals, jacobians
    )
    r, J = residuals[0], jacobians[0]
    assert np.allclose(r, naive_landmarks.odometry(first, second, moved), atol=1e-12)
    numeric = numeric_jacobian(
        lambda x: naive_landmarks.odometry(x[:3], x[3:], moved), np.concatenate([first, second])
    )
    assert np.allclose(J, numeric, atol=1e-8)


def test_dead_reckoning_equals_many_short_steps_and_stands_still_before_the_first_velocity():
    times = np.array([1.0, 1.7, 2.2, 4.0])
    velocities = np.array([[0.5, 0.3], [0.2, -1.0], [0.0, 0.8], [1.0, 0.0]])
    nodes = np.array([0.2, 1.5, 2.1, 4.5])
    motion, spread = np.empty((3, 3)), np.empty((3, 4, 3, 3))
    factors.integrate(times, velocities, nodes, motion, spread)
    for k in range(3):
        expected = naive_landmarks.dead_reckoned(times, velocities, nodes[k], nodes[k + 1])
        assert np.allclose(motion[k], expected, atol=1e-4)
    alone = np.empty((3, 3))
    factors.integrate(times, velocities, nodes, alone, np.empty((3, 0, 3, 3)))  # without sources of noise
    assert np.array_equal(alone, motion)


def test_the_spread_of_dead_reckoning_is_what_noisy_velocities_do():
    """Noise of density q a meter, at v held for τ, is a velocity error of variance q v / τ; turning likewise."""
    rng = np.random.default_rng(0)
    times, nodes = np.arange(0.0, 2.0, 0.1), np.array([0.0, 2.0])
    clean = np.tile([0.8, 0.5], (len(times), 1))
    motion, spread = np.empty((1, 3)), np.empty((1, 4, 3, 3))
    factors.integrate(times, clean, nodes, motion, spread)
    densities = np.array([4e-4, 0.0, 5e-4, 8e-4])
    variances = np.array([0.8 * densities[0], 0.8 * densities[2] + 0.5 * densities[3]]) / 0.1
    sampled = np.empty((4000, 3))
    for k in range(len(sampled)):
        noisy = clean + rng.normal(size=clean.shape) * np.sqrt(variances)
        factors.integrate(times, noisy, nodes, motion, np.empty((1, 0, 3, 3)))
        sampled[k] = motion[0]
    expected = np.einsum("c,cab->ab", densities, spread[0])
    assert np.allclose(np.cov(sampled.T), expected, atol=0.1 * np.abs(expected).max())


@pytest.fixture(scope="module")
def nonlinear():
    data = read_landmark_data(shared_data("landmarks/2d_nonlinear.npz"))
    problem = BearingRangeProblem(data.measurements)
    guess = guesses.from_odometry(problem.measurements)
    return data, problem, guess, minimize(problem, guess, create_solver("cholesky"))


@pytest.mark.parametrize(
    ("guess", "method", "optimizer"),
    [
        *(("odometry", method, "levenberg-marquardt") for method in METHODS),
        *product(("disturbed", "origin"), ("schur",), ("levenberg-marquardt", "gauss-newton")),
    ],
)
def test_2d_nonlinear_ends_in_the_same_minimum_from_poor_guesses(nonlinear, guess, method, optimizer):
    data, problem, good, best = nonlinear
    assert best.converged and best.estimate.cost == pytest.approx(1555.1896456, abs=1e-5)
    assert np.abs(best.estimate.state.poses - data.true_poses).max() < 0.05
    start = {
        "odometry": good,
        "disturbed": guesses.disturbed(good, 1.0, 0.5),
        "origin": Values(good.poses, np.zeros_like(good.landmarks)),
    }[guess]
    minimum = minimize(problem, start, create_solver(method), optimizer=optimizer)
    assert minimum.converged
    assert np.abs(minimum.estimate.state.unknowns - best.estimate.state.unknowns).max() < (
        1e-8 if guess == "odometry" else 1e-5
    )


def measurements(seed=0, unit=1.0, outliers=0):
    """A made-up drive of 40 poses past 6 landmarks, lengths in meters over ``unit``: truth and measurements."""
    rng, sigma, scale = (
        np.random.default_rng(seed),
        np.array([0.01, 0.005, 0.01]),
        np.array([1.0, 1.0, unit]) / unit,
    )
    step = np.array([0.3, 0.0, 0.16])
    motion = step + rng.normal(size=(39, 3)) * sigma
    poses = guesses.chain(np.zeros(3), np.tile(step, (39, 1)))
    landmarks = rng.uniform(-3.0, 3.0, (6, 2)) + np.array([0.0, 2.0])
    observed = np.stack(np.meshgrid(np.arange(40), np.arange(6), indexing="ij"), -1).reshape(-1, 2)
    away = landmarks[observed[:, 1]] - poses[observed[:, 0], :2]
    bearing = np.arctan2(away[:, 1], away[:, 0]) - poses[observed[:, 0], 2] + rng.normal(size=len(away)) * 0.02
    reach = np.linalg.norm(away, axis=1) + rng.normal(size=len(away)) * 0.05
    reach[:outliers] += 3.0
    given = Measurements(
        first_pose=np.zeros(3),
        first_covariance=1e-6 * np.diag(scale**2),
        motion=motion * scale,
        motion_covariance=np.tile(np.diag((sigma * scale) ** 2), (39, 1, 1)),
        calibration=no_calibration(motion, reach[:, None].repeat(2, axis=1)),
        observed=observed,
        measured=np.stack([naive_landmarks.wrapped(bearing), reach / unit], axis=1),
        measured_covariance=np.tile(np.diag([0.02**2, (0.05 / unit) ** 2]), (len(reach), 1, 1)),
        landmarks=np.arange(6),
    )
    return poses, landmarks, given


def solve(given, loss):
    return minimize(BearingRangeProblem(given), guesses.from_odometry(given), create_solver("schur"), loss=loss)


@pytest.mark.parametrize("kernel", ["none", "huber", "cauchy", "geman-mcclure"])
def test_meters_or_centimeters_same_weights_and_same_drive(kernel):
    loss = RobustLoss(kernel, 2.0, 1.0)
    in_m, in_cm = (solve(measurements(unit=unit, outliers=8)[2], loss) for unit in (1.0, 0.01))
    assert np.allclose(in_m.estimate.weights, in_cm.estimate.weights, atol=1e-5)
    assert np.allclose(in_m.estimate.state.poses[:, :2], 0.01 * in_cm.estimate.state.poses[:, :2], atol=1e-5)


def test_outliers_lose_their_weight_and_the_drive_stays_right():
    poses, _, given = measurements(outliers=8)
    robust, quadratic = solve(given, RobustLoss("cauchy", 2.0, 1.0)), solve(given, QUADRATIC)
    weights = robust.estimate.weights
    assert weights[:8].max() < 0.01 < 0.5 < np.median(weights[8:])
    off = [np.abs(minimum.estimate.state.poses[:, :2] - poses[:, :2]).max() for minimum in (robust, quadratic)]
    assert off[0] < 0.1 < off[1]


def test_the_growing_guess_follows_a_drive_whose_dead_reckoning_is_lost():
    poses, landmarks, given = measurements(seed=3)
    given.motion[:, 2] += 0.1  # the gyro is off by 6 degrees a step
    guess = guesses.growing(given, create_solver("schur"))
    reckoned = guesses.from_odometry(given)
    off, off_reckoned = (np.abs(state.poses[:, :2] - poses[:, :2]).max() for state in (guess, reckoned))
    assert off < 0.5 and off < 0.2 * off_reckoned
    assert np.abs(guess.landmarks - landmarks).max() < 0.5
