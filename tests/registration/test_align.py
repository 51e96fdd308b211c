"""Two clouds in one call: any unit, any origin; clouds that do not fit are not said to."""

import re
from itertools import islice

import numpy as np
import pytest

import scanchain
from scanchain import lie
from scanchain.errors import InputError, below
from scanchain.logs import open_log
from scanchain.logs.formats.clouds import read_cloud_file
from scanchain.odometry import Odometry
from scanchain.registration.align import _in_units_of
from tests.support.scenes import configured, kitti_scans, shared_data

CSAIL, KITTI = "2d/mit_csail.mcap", "3d/kitti_0005_first60.mcap"
FIRST = {CSAIL: 92, KITTI: 0}
TURN = {2: np.array([4.0, -7.0, 2.0]), 3: np.array([4.0, -7.0, 1.0, 0.5, -0.3, 2.0])}


def real_pair(name, apart):
    """Two real scans, and the motion between them by odometry."""
    log = open_log(shared_data(name))
    odometry = Odometry(configured(log.dimension), np.eye(log.dimension + 1))
    tracked = [odometry.process(scan) for scan in islice(log.scans(), FIRST[name] + apart + 1)]
    target, source = tracked[FIRST[name]].scan.points, tracked[-1].scan.points
    motion = lie.between(tracked[FIRST[name]].T_odom_lidar, tracked[-1].T_odom_lidar)
    return target.astype(float), source.astype(float), motion


@pytest.mark.parametrize(("name", "apart"), [(KITTI, 3), (CSAIL, 5)])
def test_real_scans_about_a_meter_apart_are_aligned_without_a_guess(name, apart):
    target, source, motion = real_pair(name, apart)
    match = scanchain.align(target, source)
    assert np.linalg.norm(motion[:-1, -1]) > 0.8
    assert np.linalg.norm(match.T_target_source[:-1, -1] - motion[:-1, -1]) < 0.05
    assert match.converged


@pytest.mark.parametrize("name", [KITTI, CSAIL])
@pytest.mark.parametrize("matcher", ["plicp", "svd"])
def test_the_unit_of_the_clouds_is_free(name, matcher):
    target, source, _ = real_pair(name, 2)
    d = target.shape[1]
    one = scanchain.align(target, source, matcher=matcher)
    for unit in (0.01, 100.0):
        scaled = scanchain.align(unit * target, unit * source, matcher=matcher)
        np.testing.assert_allclose(scaled.T_target_source[:d, :d], one.T_target_source[:d, :d], atol=1e-6)
        np.testing.assert_allclose(
            scaled.T_target_source[:d, d], unit * one.T_target_source[:d, d], atol=1e-6 * unit
        )
        units = np.where(np.arange(len(one.information)) < d, unit, 1.0)
        np.testing.assert_allclose(
            scaled.information * np.outer(units, units), one.information, rtol=1e-4, atol=1e-3
        )
        assert scaled.residual_m == pytest.approx(unit * one.residual_m, rel=1e-4)
        assert scaled.converged == one.converged


@pytest.mark.parametrize("name", [KITTI, CSAIL])
def test_frames_change_the_pose_as_they_must_and_the_information_by_the_sources_own_alone(name):
    """A frame A of the target: A T, the same information. A frame B of the source: T B⁻¹, Ad(B)⁻ᵀ Ω Ad(B)⁻¹."""
    target, source, _ = real_pair(name, 2)
    A = lie.exp(TURN[target.shape[1]])
    A[:-1, -1] += 1e5
    B = lie.exp(0.1 * TURN[target.shape[1]])
    one = scanchain.align(target, source)
    T = one.T_target_source
    moved = scanchain.align(lie.transform(A, target), source, A @ T)
    np.testing.assert_allclose(moved.T_target_source, A @ T, atol=5e-3)
    np.testing.assert_allclose(moved.information, one.information, rtol=0.3, atol=0.02 * one.information.max())
    moved = scanchain.align(target, lie.transform(B, source), T @ lie.inverse(B))
    back = lie.inverse(B)
    wanted = lie.adjoint(back).T @ one.information @ lie.adjoint(back)
    np.testing.assert_allclose(moved.T_target_source, T @ back, atol=0.03)
    np.testing.assert_allclose(moved.information, wanted, rtol=0.5, atol=0.05 * wanted.max())


@pytest.mark.parametrize("name", [CSAIL, "2d/intel.mcap"])
def test_scans_turned_about_the_lidar_by_fifty_degrees_and_shifted_are_found(name):
    scans = islice(open_log(shared_data(name)).scans(), 20, 320, 30)
    for k, points in enumerate(scan.points.astype(float) for scan in scans):
        shift_m = 0.4 * np.median(np.linalg.norm(points - points.mean(axis=0), axis=1)) * (k % 2)
        T = lie.pose_2d(shift_m * np.cos(k), shift_m * np.sin(k), np.radians(50.0) * (-1) ** k)
        match = scanchain.align(points, lie.transform(lie.inverse(T), points))
        np.testing.assert_allclose(match.T_target_source, T, atol=0.02)


def test_another_place_and_too_far_a_motion_do_not_converge():
    sweeps = [scan.points for scan in kitti_scans(7)]
    elsewhere = real_pair(KITTI, 1)[0]
    for target, source in ((sweeps[0], elsewhere), (sweeps[0], sweeps[6])):
        match = scanchain.align(target, source)
        assert not match.converged
        assert "matching." not in match.reason and "units of" not in match.reason


def corridor(ends, spacing=2.0):
    """Points of a corridor with niches at even steps, between two end walls or open, seen from x = 0."""
    x = np.arange(-8.0, 8.0, 0.05)
    niche = np.abs((x / spacing) % 1.0 - 0.5) < 0.2
    depth = np.arange(1.2, 1.6, 0.05)
    walls = []
    for side in (-1.0, 1.0):
        walls.append(np.stack([x, side * (1.2 + 0.4 * niche)], axis=1))
        for at in x[np.diff(niche, prepend=0) != 0]:
            walls.append(np.stack([np.full(len(depth), at), side * depth], axis=1))
    across = np.arange(-1.2, 1.2, 0.05)
    walls += [np.stack([np.full(len(across), end), across], axis=1) for end in ends]
    return np.concatenate(walls)


def test_a_pose_with_an_equal_elsewhere_is_ambiguous():
    niches, ended = corridor(()), corridor((-8.0, 8.0))
    away = lie.pose_2d(0.3, 0.1, 0.05)
    repeated = scanchain.align(niches, lie.transform(lie.inverse(away), niches[np.abs(niches[:, 0]) < 5.0]))
    single = scanchain.align(ended, lie.transform(lie.inverse(away), ended))
    assert single.converged and np.allclose(single.T_target_source, away, atol=0.02)
    assert not repeated.converged
    assert re.match(r"ambiguous: a pose (2|1\.9\d) away, turned by 0.00 rad, fits", repeated.reason)


def test_a_reason_is_in_the_unit_of_the_clouds_and_never_reads_like_its_limit():
    reason = (
        "residuals are far above matching.kernel_scale_m (0.2); lower local_map.voxel_size_m (1), spread over 3 m"
    )
    told = "residuals are far above the kernel scale of 0.4; lower voxel_size_m (2), spread over 6"
    assert _in_units_of(reason, 2.0) == told
    assert (below(0.5999), below(0.12)) == ("0.59", "0.12")


def slab(rng, count, size, noise):
    """Points on the faces of a box about the origin."""
    a = np.array(size)
    face = rng.choice(3, count, p=np.prod(a) / a / (np.prod(a) / a).sum())
    points = (rng.random((count, 3)) - 0.5) * a
    points[np.arange(count), face] = rng.choice([-0.5, 0.5], count) * a[face]
    return points + rng.normal(scale=noise, size=points.shape)


@pytest.mark.parametrize(("unit", "count"), [(1.0, 5000), (1000.0, 20_000), (1.0, 60_000)])
@pytest.mark.parametrize("degrees", [5.0, 10.0])
@pytest.mark.parametrize("size", [(1.2, 0.2, 0.05), (0.9, 0.3, 0.04)])
def test_a_thin_body_that_was_turned_is_turned_back(unit, count, degrees, size):
    """Its yaw is seen by narrow sides alone: no more than voxels of the first size can tell from noise."""
    rng = np.random.default_rng(count)
    target, source = (slab(rng, count, size, 0.02 * size[2]) for _ in range(2))
    truth = lie.exp(np.append(np.zeros(5), np.radians(degrees)))
    match = scanchain.align(unit * target, unit * lie.transform(lie.inverse(truth), source))
    apart_m, apart_rad = lie.apart(match.T_target_source, truth)
    assert np.degrees(apart_rad) < 0.6
    if match.converged:
        assert apart_m < 0.02 * unit


def test_what_no_surface_determines_is_left_at_the_guess_and_said():
    """Planes without an end in common, shifted along themselves by the guess."""
    rng = np.random.default_rng(1)
    target = np.column_stack([rng.uniform(-8, 8, (40_000, 2)), rng.normal(scale=0.005, size=40_000)])
    source = target[np.abs(target[:, :2]).max(axis=1) < 4.0] + rng.normal(scale=0.005, size=3)
    guess = lie.exp(np.array([0.4, -0.3, 0.02, 0.0, 0.0, 0.1]))
    match = scanchain.align(target, source, guess)
    assert not match.converged and "undetermined" in match.reason
    np.testing.assert_allclose(match.T_target_source[:2, 3], guess[:2, 3], atol=0.05)
    assert lie.apart(match.T_target_source, guess)[1] < 0.02


def small_gicp_pair():
    """The clouds that small_gicp's own tests register, and the true pose."""
    folder = shared_data("3d/small_gicp_pair")
    rows = [read_cloud_file(folder / f"{name}.ply") for name in ("target", "source")]
    clouds = [np.column_stack([each[axis] for axis in "xyz"]).astype(float) for each in rows]
    return *clouds, np.loadtxt(folder / "T_target_source.txt")


@pytest.mark.parametrize("unit", [1.0, 100.0])
@pytest.mark.parametrize("turned_deg", [0.0, 5.0, 10.0])
def test_the_pair_of_small_gicp_converges_at_the_true_pose(unit, turned_deg):
    target, source, truth = small_gicp_pair()
    guess = np.eye(4) if not turned_deg else truth @ lie.exp(np.append(np.zeros(5), np.radians(turned_deg)))
    guess, truth = guess.copy(), truth.copy()
    guess[:3, 3], truth[:3, 3] = unit * guess[:3, 3], unit * truth[:3, 3]
    match = scanchain.align(unit * target, unit * source, guess)
    apart_m, apart_rad = lie.apart(match.T_target_source, truth)
    assert match.converged
    assert apart_m < 0.04 * unit and np.degrees(apart_rad) < 0.4


@pytest.mark.parametrize("turned_deg", [30.0, 60.0, 90.0, 135.0, 180.0])
def test_from_a_guess_far_off_align_is_right_or_says_that_it_is_not(turned_deg):
    target, source, truth = small_gicp_pair()
    for axis in range(3):
        twist = np.zeros(6)
        twist[axis], twist[3 + axis] = 1.5, np.radians(turned_deg)
        match = scanchain.align(target, source, truth @ lie.exp(twist))
        apart_m, apart_rad = lie.apart(match.T_target_source, truth)
        assert not match.converged or (apart_m < 0.05 and np.degrees(apart_rad) < 0.5)


CLOUD = np.random.default_rng(0).normal(size=(500, 3))


def test_a_few_points_without_a_shape_are_no_match():
    for points in (CLOUD[:1], CLOUD[:3], CLOUD[:20], CLOUD[:, :2][:10]):
        try:
            assert not scanchain.align(points, points + 0.01).converged
        except InputError as error:
            assert "lie on one point" in str(error)
