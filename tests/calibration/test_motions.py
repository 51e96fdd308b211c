"""Gyro and wheels against the motions of scans: mounting, scales and delays, and what a motion does not show."""

from itertools import accumulate

import numpy as np
import pytest

from scanchain import lie
from scanchain.calibration.motions import Motions, fit_gyro, fit_wheels, fitted

TIMES_S = np.arange(0.0, 40.0, 0.02)
SCANS_S = np.arange(0.0, 40.0, 0.1)


def path(*, turns=True, dimension=2):
    """Poses of a base that drives at changing speed, in curves or straight ahead."""
    speed, rate = 1.0 + 0.5 * np.sin(0.8 * TIMES_S), 0.4 * np.sin(0.5 * TIMES_S) * turns
    yaw = np.cumsum(rate) * 0.02
    x, y = np.cumsum(speed * np.cos(yaw)) * 0.02, np.cumsum(speed * np.sin(yaw)) * 0.02
    poses = np.stack([lie.pose_2d(*each) for each in zip(x, y, yaw, strict=True)])
    return poses if dimension == 2 else lie.lift(poses)


def at(poses, times_s):
    return poses[np.rint(times_s / 0.02).astype(int)]


def motions_of(poses, T_base_lidar, rng, *, noise=(1e-3, 2e-4)):
    """Motions of a lidar on the base, with noise of its poses."""
    lidar = at(poses, SCANS_S) @ T_base_lidar
    k = lie.twist_size(T_base_lidar)
    lidar = lidar @ lie.exp(rng.normal(0.0, lie.by_component(k, *noise), (len(lidar), k)))
    return Motions(np.column_stack([SCANS_S[:-1], SCANS_S[1:]]), lie.between(lidar[:-1], lidar[1:]))


def by_wheels(poses, *, scale, turn):
    """What wheels of wrong scales report."""
    steps = lie.log(lie.between(poses[:-1], poses[1:])) * [scale, scale, turn]
    found = [np.eye(3)]
    for step in lie.exp(steps):
        found.append(found[-1] @ step)
    return np.array(found)


@pytest.mark.parametrize("dimension", [2, 3])
def test_wheels_are_found_late_and_of_wrong_scales_and_the_lidar_where_it_is(dimension):
    rng, T = np.random.default_rng(0), lie.pose_2d(0.4, -0.1, 0.2)
    T = T if dimension == 2 else lie.lift(T) @ lie.exp(np.array([0.0, 0.0, 0.0, 0.03, -0.02, 0.0]))
    motions = motions_of(path(dimension=dimension), T, rng)
    wheels = by_wheels(path(), scale=1.02, turn=0.97)
    stated = T @ lie.exp(np.array([0.1, 0.05, 0.02] if dimension == 2 else [0.1, 0.05, 0.0, 0.02, 0.02, 0.02]))
    found = fit_wheels(motions, TIMES_S + 0.2, wheels, stated)
    x, sigmas = found.fit
    assert np.abs((x[[5, 6, 8]] - [0.02, -0.03, 0.2]) / found.fit.sigmas[[5, 6, 8]]).max() < 3.0
    assert found.fit.sigmas[5] < 0.003 and found.fit.sigmas[6] < 0.003
    error = lie.log(lie.between(T, found.T_base_lidar))
    assert np.abs(error[:2]).max() < 0.03 and np.abs(error[dimension:]).max() < 0.005
    assert len(sigmas) == 9


def test_noise_of_the_wheels_is_not_taken_for_their_delay():
    def error(seed):
        rng = np.random.default_rng(seed)
        steps = lie.log(lie.between(*(path(turns=False)[k:][:1999] for k in (0, 1))))
        steps += rng.normal(0.0, [0.003, 0.0, 0.001], steps.shape)
        wheels = np.array(list(accumulate(lie.exp(steps), np.matmul, initial=np.eye(3))))
        motions = motions_of(path(turns=False), np.eye(3), rng)
        fit = fit_wheels(motions, TIMES_S, wheels, np.eye(3)).fit
        return fit.x[8] / fit.sigmas[8]

    assert np.sqrt(np.mean(np.square([error(seed) for seed in range(12)]))) < 1.3


def test_straight_ahead_neither_the_position_nor_the_scale_of_turns_is_observable():
    motions = motions_of(path(turns=False), np.eye(3), np.random.default_rng(1))
    sigmas = fit_wheels(motions, TIMES_S, path(turns=False), np.eye(3)).fit.sigmas
    assert sigmas[0] > 0.1 and sigmas[1] > 0.1 and sigmas[6] > 0.03
    assert sigmas[4] < 0.005 and sigmas[5] < 0.003


def test_without_a_stated_mounting_it_is_found_in_closed_form():
    T = lie.pose_2d(0.4, -0.1, 2.0)
    found = fit_wheels(motions_of(path(), T, np.random.default_rng(2)), TIMES_S, path(), None)
    assert np.abs(found.T_base_lidar - T).max() < 0.02


def rates_of(poses):
    return lie.log(lie.between(poses[:-1], poses[1:]))[:, 3:] / 0.02


@pytest.mark.parametrize("is_planar", [False, True])
def test_a_gyro_is_found_turned_biased_and_late_but_about_the_only_axis_its_rotation_is_open(is_planar):
    rng = np.random.default_rng(3)
    sway = np.stack([0.2 * np.sin(1.1 * TIMES_S), 0.15 * np.sin(1.7 * TIMES_S), 0.0 * TIMES_S], axis=1)
    turned = lie.exp(np.concatenate([np.zeros_like(sway), 0.0 * sway if is_planar else sway], axis=1))
    poses = path(dimension=3) @ turned
    R = lie.exp(np.array([0.0, 0.0, 0.0, 0.05, -0.04, 0.03]))[:3, :3]  # of the IMU in the lidar's frame
    bias = np.array([0.01, -0.02, 0.005])
    rates = (rates_of(poses) + bias) @ R + rng.normal(0.0, 0.002, (len(poses) - 1, 3))
    motions = motions_of(poses, np.eye(4), rng)
    found = fit_gyro(motions, TIMES_S[:-1] + 0.01 + 0.05, rates, np.eye(3), 0.03)
    true = np.concatenate([lie.log(np.block([[R, np.zeros((3, 1))], [np.zeros(3), 1.0]]))[3:], bias, [0.05]])
    assert np.abs((found.x - true) / found.sigmas)[[0, 1, 3, 4, 5, 6]].max() < 3.5
    assert found.sigmas[:2].max() < 0.003 and found.sigmas[6] < 0.004
    assert (found.sigmas[2] > 0.05) == is_planar


def test_few_motions_give_nothing():
    motions = motions_of(path(), np.eye(3), np.random.default_rng(4)).where(np.arange(399) < 20)
    assert fit_wheels(motions, TIMES_S, path(), np.eye(3)) is None
    assert fit_gyro(motions, TIMES_S, np.zeros((len(TIMES_S), 3)), np.eye(3), 0.0) is None


def test_outliers_hardly_change_a_fit_and_what_is_not_determined_keeps_its_prior():
    rng = np.random.default_rng(5)
    a = rng.normal(size=(400, 1))
    noise = rng.normal(0.0, 0.1, (400, 1))
    noise[:40] += 5.0
    fit = fitted(lambda x: a * (x[0] - 2.0) + noise, np.zeros(2), np.array([10.0, 0.5]))
    assert fit.x[0] == pytest.approx(2.0, abs=0.05) and fit.sigmas[0] < 0.05
    assert fit.x[1] == 0.0 and fit.sigmas[1] == pytest.approx(0.5)
