"""Scans made ready for matching: cropped, downsampled, deskewed."""

import math

import numpy as np
import pytest

from scanchain import preprocess
from scanchain.config import PreprocessConfig
from scanchain.data import Scan
from scanchain.preprocess import Resolution, ScanMotion, downsample, prepare_ahead, sweep_of
from tests.support import naive
from tests.support.scenes import configured

CONFIG = PreprocessConfig(min_range_m=1.0, max_range_m=50.0, map_voxel_m=0.5)


def scan_of(points, times_s=()):
    return Scan.of(points.astype(np.float32), 0.0, np.array(times_s, np.float32))


def some_scan(dimension=3, n=2000, with_times=True):
    rng = np.random.default_rng(0)
    return scan_of(rng.uniform(-60.0, 60.0, (n, dimension)), rng.uniform(0.02, 0.12, n) if with_times else ())


def test_a_sweep_is_the_first_point_of_every_voxel_in_range_and_seen_from_its_middle(dimension):
    scan = some_scan(dimension)
    sweep = sweep_of(scan, CONFIG)
    chosen = naive.first_per_voxel(scan.points, 0.5, 1.0, 50.0)
    assert sweep.middle_s == pytest.approx(0.07, abs=1e-3)
    np.testing.assert_allclose(sweep.times_s, scan.times_s[chosen] - sweep.middle_s, atol=1e-7)
    velocity = np.array([8.0, 0.5, 0.3] if dimension == 2 else [8.0, 0.5, -0.2, 0.1, -0.2, 0.6])
    wanted = naive.deskew(sweep.points, sweep.times_s, velocity)
    np.testing.assert_allclose(sweep.from_middle(ScanMotion(velocity)), wanted, atol=1e-9)
    assert np.array_equal(sweep.points, scan.points[chosen].astype(float))


def test_a_thinned_sweep_keeps_the_times_of_its_points_however_many_voxels_there_is_room_for(monkeypatch):
    sweep = sweep_of(some_scan(), CONFIG)
    thin = sweep.downsampled(4.0)
    assert 10 < len(thin.points) < len(sweep.points)
    assert np.array_equal(thin.points, downsample(sweep.points, 4.0))
    place = {tuple(point): time for point, time in zip(sweep.points, sweep.times_s, strict=True)}
    assert [place[tuple(point)] for point in thin.points] == thin.times_s.tolist()
    for name, few in (("table", np.empty(4, np.int64)), ("chosen", np.empty(2, np.int32))):
        monkeypatch.setattr(preprocess._scratch, name, few)
    assert np.array_equal(thin.points, downsample(sweep.points, 4.0))


@pytest.mark.parametrize(("with_times", "deskew"), [(False, True), (True, False)])
def test_without_times_or_with_deskewing_off_points_stay_where_they_are(with_times, deskew):
    config = configured(3, {"preprocess.deskew": deskew}).preprocess
    sweep = sweep_of(some_scan(with_times=with_times), config)
    assert not sweep.is_distorted and sweep.middle_s == 0.0
    assert np.array_equal(sweep.from_middle(ScanMotion(np.ones(6))), sweep.points)
    assert not sweep.downsampled(4.0).is_distorted


def box_scan(half_m, n=30_000, seed=0):
    """A lidar in the middle of a box."""
    rng = np.random.default_rng(seed)
    points = rng.normal(size=(n, 3))
    return scan_of(half_m * points / np.abs(points).max(axis=1)[:, None])


@pytest.mark.parametrize(("half_m", "scale"), [(30.0, 1.0), (13.0, 1.0), (5.0, 0.5), (2.5, 0.25), (0.8, 0.125)])
def test_voxels_are_small_where_the_place_is_narrow_and_enough_points_are_matched(half_m, scale):
    resolution = Resolution(PreprocessConfig(match_points=2000), 1.0)
    for k in range(5):
        sweep, sparse = resolution.downsampled(box_scan(half_m, seed=k))
    assert resolution.scale == scale
    chosen = naive.first_per_voxel(box_scan(half_m, seed=4).points, 0.5 * scale, 0.5, 100.0)
    assert len(sweep.points) == len(chosen)
    most = resolution.match_voxel_m == 1.5 * scale
    least = resolution.match_voxel_m == 0.5 * scale
    assert most or least or 1500 < len(sparse.points) < 2600
    assert len(sparse.points) > 1500 or least


def test_voxels_change_when_the_place_does_and_not_for_a_glance():
    resolution = Resolution(PreprocessConfig(), 1.0)
    resolution.downsampled(box_scan(6.0))
    assert resolution.scale == 0.5
    for half_m in (4.5, 9.0, 6.0):
        resolution.downsampled(box_scan(half_m))
        assert resolution.scale == 0.5
    resolution.downsampled(box_scan(30.0))
    assert resolution.scale == 1.0


def test_a_dense_scan_gets_finer_voxels_and_as_many_points_to_match():
    scale, matched = {}, {}
    for n in (30_000, 120_000):
        resolution = Resolution(PreprocessConfig(), 1.0)
        for k in range(4):
            _, sparse = resolution.downsampled(box_scan(20.0, n, seed=k))
        scale[n], matched[n] = resolution.scale, len(sparse.points)
    assert scale == {30_000: 1.0, 120_000: math.sqrt(0.5)}
    assert matched[120_000] < 1.2 * matched[30_000]
    fixed = Resolution(PreprocessConfig(min_scale=1.0), 1.0)
    fixed.downsampled(box_scan(20.0, 120_000))
    assert fixed.scale == 1.0


def test_voxels_do_not_change_with_a_number_of_returns_that_varies():
    resolution = Resolution(PreprocessConfig(), 1.0)
    scales = []
    for n in (30_000, 55_000, 70_000, 45_000, 35_000, 55_000):
        resolution.downsampled(box_scan(20.0, n))
        scales.append(resolution.scale < 1.0)
    assert scales == [False, False, True, True, False, False]


def test_the_plane_keeps_the_voxels_of_its_preset():
    resolution = Resolution(configured(2).preprocess, 0.1)
    resolution.downsampled(scan_of(np.random.default_rng(0).uniform(-1.0, 1.0, (500, 2))))
    assert (resolution.scale, resolution.match_voxel_m) == (1.0, 0.01)


def test_a_scan_without_a_point_in_range_leaves_the_voxels_alone():
    resolution = Resolution(PreprocessConfig(), 1.0)
    sweep, sparse = resolution.downsampled(scan_of(np.zeros((10, 3))))
    assert len(sweep.points) == len(sparse.points) == 0
    resolution.downsampled(box_scan(2.5))
    assert resolution.scale == 0.25


def test_scans_prepared_ahead_are_those_prepared_one_by_one():
    scans = [box_scan(half_m, seed=k) for k, half_m in enumerate((6.0, 6.5, 12.0, 40.0, 3.0, 3.1))]
    resolution = Resolution(PreprocessConfig(match_points=500), 1.0)
    ahead = list(prepare_ahead(iter(scans), resolution))
    assert resolution.tries > 0  # as before: whoever processes the scans takes it from them
    for scan, prepared in zip(scans, ahead, strict=True):
        sweep, sparse = resolution.downsampled(scan)
        assert prepared.scan is scan
        assert (prepared.sweep.points == sweep.points).all()
        assert (prepared.sparse.points == sparse.points).all()
        assert vars(prepared.after) | {"noise": 0} == vars(resolution) | {"noise": 0}
