"""Noise of ranges, measured on single scans."""

import numpy as np
import pytest

from scanchain.range_noise import RangeNoise
from tests.support.scenes import shared_data


def room(dimension, noise_m, seed=0):
    """A scan of a room of 8 by 6 m from within; noise_m : of the ranges (N,)."""
    rng = np.random.default_rng(seed)
    if dimension == 2:
        azimuth = np.deg2rad(np.arange(0.0, 360.0, 0.5))
        directions = np.stack([np.cos(azimuth), np.sin(azimuth)], axis=1)
    else:
        azimuth, elevation = np.meshgrid(
            np.deg2rad(np.arange(0.0, 360.0, 1.0)), np.deg2rad(np.arange(-30, 31, 2.0))
        )
        azimuth, elevation = azimuth.ravel(), elevation.ravel()
        level = np.cos(elevation)
        directions = np.stack([level * np.cos(azimuth), level * np.sin(azimuth), np.sin(elevation)], axis=1)
    with np.errstate(divide="ignore"):
        ahead = np.array([5.0, 4.0, 1.5][:dimension]) / np.maximum(directions, 0.0)
        behind = np.array([3.0, 2.0, 1.5][:dimension]) / np.maximum(-directions, 0.0)
    ranges_m = np.minimum(ahead, behind).min(axis=1)
    return ((ranges_m + noise_m(ranges_m) * rng.normal(size=len(ranges_m)))[:, None] * directions).astype(
        np.float32
    )


@pytest.mark.parametrize("noise_m", [0.005, 0.03, 0.08])
def test_the_noise_of_ranges_is_measured_on_the_first_scans_whatever_the_incidence(dimension, noise_m):
    noise = RangeNoise()
    for seed in range(10):
        noise = noise.measured(room(dimension, lambda _: noise_m, seed))
        assert noise.sigma_m == pytest.approx(noise_m, rel=0.3)
    assert noise.sigma_m == pytest.approx(noise_m, rel=0.06)
    assert noise.text == f"{100.0 * noise.sigma_m:.2g} cm of a range"


def test_lost_returns_do_not_change_it(dimension):
    noise, rng = RangeNoise(), np.random.default_rng(0)
    for seed in range(10):
        points = room(dimension, lambda _: 0.04, seed)
        noise = noise.measured(points[rng.random(len(points)) < 0.5])
    assert noise.sigma_m == pytest.approx(0.04, rel=0.1)


def test_noise_that_grows_with_the_range_is_told_by_range():
    noise = RangeNoise()
    for seed in range(30):
        noise = noise.measured(room(2, lambda ranges_m: 0.004 * ranges_m**2, seed))
    known = {round(range_m, 1): sigma_m for range_m, sigma_m, _ in noise.by_range}
    assert known[2.4] == pytest.approx(0.004 * 2.4**2, rel=0.2)
    assert known[4.8] == pytest.approx(0.004 * 4.8**2, rel=0.2)
    assert " at 2.4 m, " in noise.text and " at 4.8 m" in noise.text


def test_of_scans_of_clutter_alone_it_is_unknown(dimension):
    points = np.random.default_rng(0).uniform(-5.0, 5.0, (2000, dimension)).astype(np.float32)
    noise = RangeNoise().measured(points).measured(points)
    assert noise.sigma_m == 0.0 and noise.text.startswith("unknown")


@pytest.mark.parametrize(
    ("name", "most_m"),
    [("2d/mocap_room_1.bag", 0.01), ("2d/aces.mcap", 0.03), ("3d/kitti_0001_first54.mcap", 0.015)],
)
def test_lidars_as_made_for_industry_and_cars_have_less_than_is_assumed(name, most_m):
    from scanchain.logs import open_log

    noise = RangeNoise()
    for scan, _ in zip(open_log(shared_data(name)).scans(), range(30), strict=False):
        noise = noise.measured(scan.points)
        assert noise.sigma_m < most_m
