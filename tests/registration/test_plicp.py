import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.data import Prior
from scanchain.kernels.registration import icp
from scanchain.kernels.registration.match import Result
from scanchain.registration import VoxelMap, create_matcher
from scanchain.registration.plicp import OPTIMIZERS, match_of, settings_of
from tests.support.matching import dented_corridor, off, scan_at, set_up, truth


def test_all_four_optimizers_reach_one_minimum_near_the_truth_by_second_order_in_half_the_steps(dimension):
    T, found = truth(dimension), {}
    for optimizer in OPTIMIZERS:
        matcher, target = set_up(dimension, optimizer=optimizer, max_iterations=20_000)
        found[optimizer] = matcher.align(scan_at(T), target, lie.identity(dimension))
    expected, slow = found["levenberg-marquardt"], found.pop("gradient-descent")
    assert expected.converged and off(expected.T_target_source, T) < 3e-3
    for match in found.values():
        assert off(match.T_target_source, expected.T_target_source) < 1e-3 and match.iterations < 40
    # correspondences and their weights stay after PATIENCE associations, when gradient descent is on its way still
    assert off(slow.T_target_source, expected.T_target_source) < 5e-3
    assert slow.iterations >= 2 * expected.iterations


def test_a_smooth_floor_between_rough_walls_holds_height_and_tilt_as_its_own_residuals_say():
    rng = np.random.default_rng(4)

    def room(count):
        points = rng.uniform([-8, -8, 0], [8, 8, 6], (count, 3))
        side = rng.integers(0, 3, count)
        rows = np.arange(count)
        points[rows, side] = np.where(side == 2, 0.0, np.sign(points[rows, side]) * 8.0)
        points[rows, side] += rng.normal(size=count) * np.where(side == 2, 0.003, 0.06)
        return points - np.array([0.0, 0.0, 2.0])

    target = VoxelMap(3, LocalMapConfig(voxel_size_m=1.0))
    target.insert(room(60_000), lie.identity(3))
    matcher = create_matcher(MatchingConfig())
    matches = [matcher.align(room(2_000), target, lie.identity(3)) for _ in range(40)]
    errors = np.array([lie.log(match.T_target_source) for match in matches])
    covariances = np.array([np.linalg.inv(match.information) for match in matches])
    variances = np.diagonal(covariances, axis1=1, axis2=2).mean(axis=0)
    squares = ((errors - errors.mean(axis=0)) ** 2).mean(axis=0) / variances
    assert ((squares > 0.2) & (squares < 3.0)).all(), squares


@pytest.mark.parametrize("is_measured", [True, False])
def test_along_a_bare_corridor_of_the_plane_a_measured_motion_holds_and_any_is_degenerate(is_measured):
    target = VoxelMap(2, LocalMapConfig(voxel_size_m=0.2))
    for seed in range(6):
        target.insert(dented_corridor(0, seed), lie.identity(2))
    expected = lie.pose_2d(0.05, 0.0, 0.0)
    prior = Prior(expected, np.diag([0.01, 0.01, 0.005]) ** 2, np.array([0.5, 0.5, 0.2]), is_measured=is_measured)
    config = MatchingConfig(max_distance_m=0.5, kernel_scale_m=0.1, min_information=0.0)
    match = create_matcher(config).align(dented_corridor(0, seed=99), target, expected, prior)
    assert match.observability < 1.0 and not match.converged
    assert abs(match.degeneracy_direction[0]) > np.cos(np.radians(5.0))
    sigma_m = np.sqrt(np.linalg.inv(match.information + 1e-6 * np.eye(3))[0, 0])
    if is_measured:  # stays where the wheels have it, and does not claim to have measured it
        assert match.T_target_source[0, 2] == pytest.approx(0.05, abs=0.005) and sigma_m > 0.01


def result(**changes):
    """A result without fault for 1000 points, but for these changes."""
    sound = Result(
        T=np.eye(3), information=np.eye(3), direction=np.eye(3)[0], eigenvalue=0.5, signal=9.0, fit=0.9,
        range_m=9.0, residual_m=0.1, cost=1.0, pairs=990, on_surfaces=900, iterations=4,
        ending=icp.Ending.CONVERGED,
        variance_factor=1.0, systematic=np.zeros((3, 3)),
    )  # fmt: skip
    return sound._replace(**changes)


FAULTS = [
    ({"T": np.full((3, 3), np.nan)}, "the pose is not finite"),
    ({"ending": icp.Ending.NO_CORRESPONDENCES}, "no point has a correspondence in the map"),
    ({"pairs": 290}, "290 of 1000 points have a correspondence, below the share matching.min_inlier_share (0.3)"),
    ({"signal": 1.5}, "motion along [1.00 0.00 0.00] is undetermined: observability 5.0e-01 < 1"),
    ({"eigenvalue": 1e-7}, "is undetermined: observability 1.0e-01 < 1"),
    ({"ending": icp.Ending.OUT_OF_ITERATIONS}, "out of iterations (matching.max_iterations)"),
    ({"fit": 0.59}, "the correspondences contradict the pose: fit 0.59 < 0.6"),
    ({"residual_m": 0.21}, "residual 0.21 m > matching.kernel_scale_m (0.2)"),
    ({"pairs": 740}, "740 of 1000 points have a correspondence, fewer than 75 %"),
    ({"on_surfaces": 29}, "29 correspondences with a surface, fewer than 10 for each of 3 degrees of freedom"),
    ({"range_m": 1.5}, "the points spread over 1.5 m, less than 4 voxels"),
]


@pytest.mark.parametrize("place", range(len(FAULTS)))
def test_every_fault_of_a_result_is_named_the_worst_first(place):
    target = VoxelMap(2, LocalMapConfig(voxel_size_m=0.4))
    target.insert(dented_corridor(400), lie.identity(2))
    changes, words = FAULTS[place]
    match = match_of(result(**changes), 1000, target, MatchingConfig())
    assert not match.converged and words in match.reason
    with_all_after = {name: value for later, _ in FAULTS[:place:-1] for name, value in later.items()}
    worst = match_of(result(**(with_all_after | changes)), 1000, target, MatchingConfig())
    assert worst.cause == match.cause
    sound = match_of(result(), 1000, target, MatchingConfig())
    assert (sound.converged, sound.reason, sound.observability) == (True, "converged", 3.0)


@pytest.mark.parametrize("wide", [False, True])
def test_residual_scales_grow_with_noisy_ranges_and_distances_with_the_voxels(wide):
    config, voxels = MatchingConfig(), LocalMapConfig(voxel_size_m=0.5)
    quiet, fine, noisy = (
        settings_of(config, VoxelMap(2, voxels, *of), wide=wide) for of in ((), (0.5,), (1.0, 0.1))
    )
    assert (quiet.max_distance_m, fine.max_distance_m) == ((3.0, 1.5) if wide else (2.0, 1.0))
    assert quiet.last_distance_m == 2.0 and quiet.first_scale_m == (2.0 if wide else 0.2)
    assert (quiet.scale_m, quiet.variance) == (fine.scale_m, fine.variance) == (0.2, pytest.approx(0.03**2))
    assert (noisy.scale_m, noisy.variance) == (pytest.approx(0.4), pytest.approx(0.1**2))
