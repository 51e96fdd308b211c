"""Poses and deskewing along measured rates agree with constant twists, and with small steps."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.kernels import scans as kernels
from scanchain.preprocess import ScanMotion, Turning


@pytest.mark.parametrize("d", [2, 3])
def test_at_constant_rates_it_is_the_motion_of_a_constant_twist(d):
    twist = np.array([5.0, 1.0, 2.0] if d == 2 else [5.0, 1.0, 0.3, 0.4, -0.3, 2.0])
    knots_s = np.array([-0.12, -0.051, 0.01, 0.06])
    turning = Turning(knots_s, np.tile(twist[d:], (3, 1)))
    motion, usual = ScanMotion(twist, turning), ScanMotion(twist)
    for seconds in (-0.11, -0.03, 0.0, 0.02, 0.055):
        assert np.allclose(motion.over(seconds), usual.over(seconds), atol=2e-5)
    random = np.random.default_rng(0)
    points, times_s = 20.0 * random.normal(size=(500, d)), random.uniform(-0.05, 0.05, 500)
    expected = points.copy()
    usual.deskew(expected, times_s)
    motion.deskew(points, times_s)
    assert np.abs(points - expected).max() < 5e-4


@pytest.mark.parametrize("d", [2, 3])
def test_poses_are_the_product_of_the_steps_and_the_identity_in_the_middle(d):
    random = np.random.default_rng(1)
    rates = random.normal(size=(8, 1 if d == 2 else 3))
    knots_s, velocity = np.linspace(-0.11, 0.05, 9), random.normal(size=d)
    times_s, poses = kernels.poses_along(knots_s, rates, velocity, 0.005)
    assert times_s[0] == knots_s[0]
    assert times_s[-1] == knots_s[-1]
    middles = np.clip(np.searchsorted(knots_s, 0.5 * (times_s[1:] + times_s[:-1])) - 1, 0, 7)
    for k, piece in enumerate(middles):
        twist = np.concatenate([velocity, rates[piece]]) * (times_s[k + 1] - times_s[k])
        assert np.linalg.norm(twist[d:]) < 0.00501
        assert np.allclose(lie.between(poses[k], poses[k + 1]), lie.exp(twist), atol=1e-12)
    before = np.searchsorted(times_s, 0.0) - 1
    at_middle = poses[before] @ lie.exp(-times_s[before] * np.concatenate([velocity, rates[middles[before]]]))
    assert np.allclose(at_middle, np.eye(d + 1), atol=1e-12)
