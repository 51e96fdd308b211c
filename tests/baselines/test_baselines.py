"""Baselines: each tracks a real drive; what they lack is said, what would crash them is kept from them."""

import sys
from typing import NamedTuple

import numpy as np
import pytest

from scanchain import lie
from scanchain.baselines import BASELINES, AtStamp, finite
from scanchain.data import Inertial, Trajectory
from scanchain.errors import MissingExtraError
from scanchain.evaluation import absolute_error, pair
from scanchain.simulation import plan
from scanchain.simulation.imu import IMUS
from scanchain.simulation.motion import Motion
from scanchain.simulation.sensors import take_sweep
from scanchain.trajectory import read_tum
from tests.support.scenes import kitti_scans, shared_data

PACKAGES = {name: entry.package.replace("-", "_") for name, entry in BASELINES.items()}
FAST = [name for name in PACKAGES if name != "genz-icp-indoor"]  # which does not keep up with a car
WITHOUT_IMU = [name for name in FAST if not BASELINES[name].wants_imu]
NO_TIMES = np.empty(0, np.float32)
SWEEP_S = 0.1


class Distorted(NamedTuple):
    """A sweep taken on the move: points, their seconds after its start, its start, and the motion."""

    points: np.ndarray
    times_s: np.ndarray
    start_s: float
    motion: Motion


@pytest.fixture(scope="module")
def distorted():
    """Nearly three seconds through the simulated town at 8 m/s, round a corner."""
    drive = plan("town", seed=1, sensor="vlp-16", duration_s=9.0)
    rng = np.random.default_rng(0)
    sweeps = []
    for index in range(42, 70):
        sweep = take_sweep(drive.solids, drive.motion, drive.sensor, index, SWEEP_S * index, rng)
        times_s = sweep.times_s().astype(np.float32)
        sweeps.append(Distorted(sweep.points(), times_s, SWEEP_S * index, drive.motion))
    return sweeps


@pytest.fixture(scope="module")
def drive():
    """Eight sweeps of a real drive."""
    return kitti_scans(8)


def create(name):
    try:
        return BASELINES[name].make(BASELINES[name].settings)
    except MissingExtraError as error:
        pytest.skip(str(error))


def ate_m(name, sweeps, stamp_share, with_times=True):
    """Against the truth at the stamps, which lie at this share of each sweep."""
    baseline = create(name)
    stamps_s = np.array([sweep.start_s + stamp_share * SWEEP_S for sweep in sweeps])
    poses, imu = [], IMUS["ideal"]
    for sweep, stamp_s in zip(sweeps, stamps_s, strict=True):
        if BASELINES[name].wants_imu:
            instants_s = np.linspace(sweep.start_s, sweep.start_s + SWEEP_S, 20, endpoint=False)
            samples = imu.measure(sweep.motion, instants_s, np.random.default_rng(0))
            T_lidar_imu = lie.between(*(of(np.zeros(1))[0] for of in (sweep.motion.lidar, sweep.motion.base)))
            T_lidar_imu = T_lidar_imu @ imu.T_base_imu
            baseline.add_inertial(Inertial(np.rint(1e9 * instants_s).astype(np.int64), *samples, T_lidar_imu))
        times_s = sweep.times_s - np.float32(stamp_share * SWEEP_S) if with_times else NO_TIMES
        poses.append(baseline.track(sweep.points, times_s, round(stamp_s * 1e9)))
    truth = sweeps[0].motion.lidar(stamps_s)
    stamps_ns = np.rint(stamps_s * 1e9).astype(np.int64)
    pairs = pair(Trajectory(stamps_ns, np.array(poses)), Trajectory(stamps_ns, truth))
    return absolute_error(pairs).translation_m.rmse


# Point-to-point from scan to scan clings to the rings, which move with the car, and starts slowly.
@pytest.mark.parametrize("name", WITHOUT_IMU)
def test_a_baseline_tracks_a_real_drive(name, drive):
    limit_m = 0.4 if name == "open3d-p2p" else 0.1
    baseline = create(name)
    poses = np.array([baseline.track(scan.points, NO_TIMES, scan.stamp_ns) for scan in drive])
    truth = read_tum(shared_data("3d/kitti_0001_first54.tum")).poses[:8]
    motion, true_motion = (lie.between(each[:-1], each[1:]) for each in (poses, truth))
    error = lie.between(true_motion, motion)
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-6)
    assert np.linalg.norm(true_motion[:, :3, 3], axis=1).min() > 1.0
    assert np.median(np.linalg.norm(error[:, :3, 3], axis=1)) < limit_m
    assert np.median(lie.rotation_angle(error)) < 0.01


@pytest.mark.parametrize("name", PACKAGES)
def test_a_missing_package_is_named_with_its_extra(name, monkeypatch):
    for module in [m for m in sys.modules if m.split(".")[0] == PACKAGES[name]]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, PACKAGES[name], None)
    extra = "slam" if name == "kiss-slam" else "baselines"
    with pytest.raises(MissingExtraError, match=rf"pip install 'scanchain\[{extra}\]'"):
        BASELINES[name].make(BASELINES[name].settings)


def test_invalid_points_go_together_with_their_times():
    points = np.array([[1, 2, 3], [np.nan, 2, 3], [4, np.inf, 3], [7, 8, 9], [1, 1, 1]], np.float32)
    kept, times = finite(points, np.array([0.0, 0.1, 0.2, 0.3, np.nan], np.float32))
    assert kept.tolist() == [[1, 2, 3], [7, 8, 9]]
    np.testing.assert_allclose(times, [0.0, 0.3], atol=1e-6)
    assert kept.dtype == np.float64
    ones = np.ones((3, 3), np.float32)
    for some, times in ((ones, np.full(3, 0.5, np.float32)), (ones, NO_TIMES), (ones[:0], NO_TIMES)):
        kept, none = finite(some, times)  # times that are all equal count as none
        assert kept.shape == some.shape and not len(none)


def test_poses_of_a_steady_motion_are_moved_to_the_stamp_exactly_across_gaps_too():
    velocity = np.array([8.0, 0.3, 0.0, 0.01, -0.02, 0.4])
    stamps_s = np.array([0.0, 0.1, 1.2, 1.3, 1.4])  # a hole of one second
    held_s = np.array([0.05, 0.05, 0.1, 0.1, 0.02])
    at_stamp = AtStamp()
    for stamp_s, late_s in zip(stamps_s, held_s, strict=True):
        theirs = lie.exp((stamp_s + late_s - held_s[0]) * velocity)
        moved = at_stamp.move(theirs, round(stamp_s * 1e9), late_s)
        np.testing.assert_allclose(moved, lie.exp(stamp_s * velocity), atol=1e-9)


@pytest.mark.parametrize("name", FAST)
def test_a_pose_holds_at_the_stamp_wherever_it_lies_in_the_sweep(name, distorted):
    """Half a sweep off is 0.4 m along the road, which the bend turns into an error of the path's shape."""
    errors_m = [ate_m(name, distorted, stamp_share) for stamp_share in (0.0, 1.0)]
    assert np.ptp(errors_m) < (0.03 if name == "rko-lio" else 0.02), errors_m  # whose ATE here is 0.1 m


@pytest.mark.parametrize("name", ["kiss-icp", "genz-icp", "genz-icp-kitti"])
def test_a_deskewing_baseline_is_better_with_times_than_without(name, distorted):
    """Without times its pose counts as that of the middle of the sweep, the best that can be said of it."""
    with_times_m = ate_m(name, distorted, 0.5)
    assert with_times_m < 0.06
    assert with_times_m < 0.5 * ate_m(name, distorted, 0.5, with_times=False)
