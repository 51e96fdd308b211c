"""Offsets of a lidar and poses of others by one adjustment of planes: recovered, with σ; the equations."""

import math

import numpy as np
import pytest

from scanchain import lie
from scanchain.calibration.planes import Others, Window, _equations, _in_planes, adjust
from scanchain.logs.messages.lidar import with_offsets
from tests.support import naive

POSES = np.stack([lie.exp(np.array([1.2 * k, 0.1 * k, 0.0, 0.0, 0.01 * k, 0.03 * k])) for k in range(8)])
T_OTHER = lie.exp(np.array([0.3, -0.1, 0.2, 0.1, -0.05, 0.3]))
NONE = np.empty((0, 4, 4))


def seen(T, rng, points=900):
    """Points on rolling ground and between four walls, with 1 cm of noise, as seen from T."""
    x, y = np.array([4.0, 0.0])[:, None] + rng.uniform(-16.0, 16.0, (2, points))
    ground = np.stack([x, y, 0.3 * np.sin(0.2 * x) + 0.2 * np.cos(0.15 * y) - 1.7])
    wall = np.stack([x, np.sign(y) * 9.0, rng.uniform(-1.7, 3.0, points)])
    across = np.stack([np.sign(x - 4.0) * 13.0 + 4.0, y, rng.uniform(-1.7, 3.0, points)])
    world = np.concatenate([ground, wall, across], axis=1).T + rng.normal(0.0, 0.01, (3 * points, 3))
    return lie.transform(lie.inverse(T), world)


def window(rng, *, elevation_rad=0.0, range_m=0.0, others=0, delay_s=0.0):
    """Eight scans with slightly wrong poses, and those of other lidars, later by a part of the motion."""
    own = [with_offsets(seen(T, rng), -elevation_rad, -range_m) for T in POSES]
    twist = lie.log(lie.between(POSES[0], POSES[1])) / 0.1
    late = [T @ lie.exp(delay_s * twist) @ T_OTHER for T in POSES]
    seen_by_others = [[Others(points, np.full(len(points), delay_s)) for points in (seen(T, rng) for T in late)]]
    poses = POSES @ lie.exp(rng.normal(0.0, [0.02] * 3 + [0.002] * 3, (8, 6)))
    return Window(own, poses, np.tile(twist, (8, 2, 1)), seen_by_others[:others], 1.0)


def test_elevation_and_range_are_found_together_within_their_deviations():
    found = adjust([window(np.random.default_rng(0), elevation_rad=math.radians(0.3), range_m=-0.03)], NONE)
    errors = (found.offsets - [math.radians(0.3), -0.03]) / found.sigmas
    assert np.abs(errors).max() < 3.0 and found.sigmas[0] < math.radians(0.05) and found.sigmas[1] < 0.01
    assert abs(found.contradiction) < 3.0


def test_a_range_that_is_held_adds_its_uncertainty_to_the_elevation():
    free, held = (
        adjust([window(np.random.default_rng(1))], NONE, holds=(False, is_held)) for is_held in (False, True)
    )
    assert abs(held.offsets[1]) < 1e-6 and held.sigmas[1] == pytest.approx(0.02, rel=0.01)
    assert abs(free.offsets[1]) > 1e-6 and free.sigmas[1] < 0.01
    sure = adjust([window(np.random.default_rng(1))], NONE, holds=(False, True), sigmas=np.array([0.02, 1e-4]))
    assert sure.sigmas[0] < held.sigmas[0]


def test_the_pose_of_another_lidar_is_found_though_it_measures_later_as_the_vehicle_drives():
    made = window(np.random.default_rng(2), others=1, delay_s=0.05)
    found = adjust([made], (lie.exp(np.array([0.03, -0.02, 0.02, 0.004, 0.003, -0.004])) @ T_OTHER)[None])
    error = lie.log(found.T_first_others[0] @ lie.inverse(T_OTHER))
    assert np.abs(error / found.sigmas[2:]).max() < 3.0
    assert np.abs(error[:3]).max() < 0.02 and np.degrees(np.abs(error[3:]).max()) < 0.1


def test_without_planes_there_is_no_result():
    few = Window([np.eye(3)] * 5, POSES[:5], np.zeros((5, 2, 6)), [], 1.0)
    assert adjust([few], NONE) is None


def test_the_information_of_the_elevation_is_that_of_the_slow_equations():
    rng = np.random.default_rng(3)
    few = Window([seen(T, rng, 150) for T in POSES[:3]], POSES[:3], np.zeros((3, 2, 6)), [], 2.0)
    found, of = _equations(few, np.zeros(2), NONE), _in_planes(few, np.zeros(2), NONE)
    scale_m = 1.5 * math.sqrt(found.variance)
    H, b = naive.plane_equations(
        of.points, of.number, of.plane, of.offset, of.residual, of.normals, few.poses, scale_m
    )
    by_poses = np.linalg.solve(H[6:18, 6:18], np.column_stack([H[6:18, 18], b[6:18]]))  # the first pose is held
    M, gradient = H[18, 18] - H[18, 6:18] @ by_poses[:, 0], b[18] - H[18, 6:18] @ by_poses[:, 1]
    assert found.M[0, 0] == pytest.approx(M, rel=1e-3)
    assert found.scores.sum(axis=0)[0] == pytest.approx(gradient, rel=1e-3)
