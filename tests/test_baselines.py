"""Baselines: each tracks a real drive; what they lack is said, what would crash them is kept from them."""

import sys

import numpy as np
import pytest
from scenes import kitti_scans, shared_data

from pipeline import baselines, lie
from pipeline.baselines.baseline import finite
from pipeline.errors import InputError, MissingExtraError
from pipeline.trajectory import read_tum

PACKAGES = {
    "kiss-icp": "kiss_icp",
    "small-gicp": "small_gicp",
    "small-gicp-pairs": "small_gicp",
    "open3d-p2l": "open3d",
    "open3d-p2p": "open3d",
}
NO_TIMES = np.empty(0, np.float32)


@pytest.fixture(scope="module")
def drive():
    """Eight sweeps of a real drive."""
    return kitti_scans(8)


def create(name):
    try:
        return baselines.create(name)
    except MissingExtraError as error:
        pytest.skip(str(error))


def track(name, drive, times=NO_TIMES):
    baseline = create(name)
    return np.array([baseline.track(scan.points, times, scan.stamp_ns) for scan in drive])


def test_the_names_are_those_known_here():
    assert set(baselines.names()) == set(PACKAGES)


# Point-to-point from scan to scan clings to the rings, which move with the car, and starts slowly.
@pytest.mark.parametrize("name", PACKAGES)
def test_a_baseline_tracks_a_real_drive(name, drive):
    limit_m = 0.4 if name == "open3d-p2p" else 0.1
    poses = track(name, drive)
    truth = read_tum(shared_data("3d/kitti_0001_first54.tum")).poses[:8]
    motion = lie.inverse(poses[:-1]) @ poses[1:]
    true_motion = lie.inverse(truth[:-1]) @ truth[1:]
    error = lie.inverse(true_motion) @ motion
    np.testing.assert_allclose(poses[0], np.eye(4), atol=1e-6)
    assert np.linalg.norm(true_motion[:, :3, 3], axis=1).min() > 1.0
    assert np.median(np.linalg.norm(error[:, :3, 3], axis=1)) < limit_m
    assert np.median(lie.rotation_angle(error)) < 0.01


@pytest.mark.parametrize("name", PACKAGES)
def test_a_missing_package_is_named_with_its_extra(name, monkeypatch):
    for module in [m for m in sys.modules if m.split(".")[0] == PACKAGES[name]]:
        monkeypatch.delitem(sys.modules, module)
    monkeypatch.setitem(sys.modules, PACKAGES[name], None)
    with pytest.raises(MissingExtraError, match=r"pip install 'scanchain\[baselines\]'"):
        baselines.create(name)


def test_an_unknown_baseline_is_refused_with_the_names_there_are():
    with pytest.raises(InputError, match="kiss-icp, small-gicp"):
        baselines.create("kissicp")


def test_invalid_points_go_together_with_their_times():
    points = np.array([[1, 2, 3], [np.nan, 2, 3], [4, np.inf, 3], [7, 8, 9], [1, 1, 1]], np.float32)
    kept, times = finite(points, np.array([0.0, 0.1, 0.2, 0.3, np.nan], np.float32))
    assert kept.tolist() == [[1, 2, 3], [7, 8, 9]]
    np.testing.assert_allclose(times, [0.0, 0.3], atol=1e-6)
    assert kept.dtype == np.float64


def test_times_that_are_all_equal_count_as_none():
    points = np.ones((3, 3), np.float32)
    assert len(finite(points, np.full(3, 0.5, np.float32))[1]) == 0
    assert len(finite(points, NO_TIMES)[1]) == 0
    assert finite(points[:0], NO_TIMES)[0].shape == (0, 3)


def test_kiss_icp_answers_at_the_stamp_wherever_it_lies_in_the_sweep(drive):
    """Stamped at the end of a sweep the pose is KISS-ICP's own; at its start it is the end of the one before."""
    pytest.importorskip("kiss_icp")
    at_end, at_start = create("kiss-icp"), create("kiss-icp")
    previous = np.eye(4)
    for scan in drive[:5]:
        cloud = scan.points
        azimuth = np.arctan2(cloud[:, 1], cloud[:, 0]).astype(np.float32)
        share = (np.float32(np.pi) - azimuth) / np.float32(2 * np.pi)
        share = (share - share.min()) / np.ptp(share)
        end = at_end.track(cloud, np.float32(0.1) * (share - 1), scan.stamp_ns)
        start = at_start.track(cloud, np.float32(0.1) * share, scan.stamp_ns)
        np.testing.assert_allclose(start, previous, atol=2e-3)
        previous = end
    assert np.linalg.norm(previous[:3, 3]) > 3.0
