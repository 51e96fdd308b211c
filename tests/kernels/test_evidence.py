"""Observability of a pose: every kernel equals its slow, clear twin."""

import math

import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.kernels.geometry import se
from scanchain.kernels.geometry.eigen import eigensystem
from scanchain.kernels.registration import observability
from scanchain.kernels.registration.icp import root_mean_square_range
from scanchain.registration import VoxelMap
from scanchain.registration.plicp import settings_of
from tests.support.naive_evidence import seen_from_source, spectrum, weak_prior


def definite(k, spread=1.0, seed=0):
    """A symmetric positive definite (k, k), its eigenvalues a factor 10^spread from each other."""
    rng = np.random.default_rng(seed)
    vectors = np.linalg.qr(rng.normal(size=(k, k)))[0]
    return (vectors * 10.0 ** (-spread * np.arange(k))) @ vectors.T


def some_pose(k, seed=0):
    return lie.exp(np.random.default_rng(seed).normal(size=k))


@pytest.mark.parametrize("k", [3, 6])
@pytest.mark.parametrize("spread", [0.0, 0.5, 2.0])
def test_the_eigensystem_of_a_small_matrix_equals_lapacks(k, spread):
    A = definite(k, spread)
    values, vectors = np.empty(k), np.empty((k, k))
    eigensystem(A.copy(), values, vectors)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), atol=1e-14)
    np.testing.assert_allclose((vectors * values) @ vectors.T, A, atol=1e-14)
    np.testing.assert_allclose(vectors.T @ vectors, np.eye(k), atol=1e-14)


@pytest.mark.parametrize("A", [np.zeros((3, 3)), np.diag([0.0, 2.0, 1.0]), np.ones((3, 3))])
def test_a_singular_matrix_has_an_eigensystem_too(A):
    values, vectors = np.empty(3), np.empty((3, 3))
    eigensystem(A.copy(), values, vectors)
    np.testing.assert_allclose(values, np.linalg.eigvalsh(A), atol=1e-15)
    np.testing.assert_allclose((vectors * values) @ vectors.T, A, atol=1e-15)


@pytest.mark.parametrize("k", [3, 6])
def test_the_spectrum_counts_turns_as_lengths(k):
    H = definite(k)
    found = observability.spectrum_of(H, 7.0, 12.0)
    scale, values, vectors = spectrum(H, 7.0, 12.0)
    np.testing.assert_allclose(found.scale, scale)
    np.testing.assert_allclose(found.values, values, atol=1e-15)
    np.testing.assert_allclose(np.abs((found.vectors * vectors).sum(axis=0)), 1.0)


@pytest.mark.parametrize("k", [3, 6])
@pytest.mark.parametrize("min_information", [1e-9, 1e-4, 1e-2, 1.0])
@pytest.mark.parametrize("signal", [0.5, 2.9, 3.1, 29.0, 31.0, np.inf])
@pytest.mark.parametrize("is_fused", [False, True])
def test_weak_directions_have_a_prior_and_no_others(k, min_information, signal, is_fused):
    H, expected = definite(k, 1.5), definite(k, 0.5, seed=1)
    settings = settings_of(
        MatchingConfig(min_information=min_information, min_signal=3.0), VoxelMap(3, LocalMapConfig()), wide=False
    )
    found = observability.spectrum_of(H, 2.0, 5.0)
    found.signals[1] = signal
    prior = observability.weak_prior(found, 2.0, expected, is_fused, settings)
    wanted = weak_prior(H, 2.0, 5.0, expected, found.signals, (min_information, 3.0), is_fused)
    np.testing.assert_allclose(prior, wanted, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("k", [3, 6])
def test_information_turns_into_the_frame_of_the_source(k):
    T, T_first, H = some_pose(k), some_pose(k, seed=1), definite(k)
    found = observability.spectrum_of(H, 1.0, 3.0)
    information, direction = observability.seen_from_source(T, T_first, H, found.vectors[:, 0], 0.04)
    wanted, worst = seen_from_source(T, T_first, H, found.vectors[:, 0], 0.04)
    np.testing.assert_allclose(information, wanted, atol=1e-12)
    np.testing.assert_allclose(direction, worst, atol=1e-12)


def test_what_is_not_definite_has_no_inverse():
    np.testing.assert_array_equal(observability.definite_inverse(np.diag([1.0, 0.0, 1.0])), np.zeros((3, 3)))


@pytest.mark.parametrize("d", [2, 3])
def test_the_range_of_a_scan_is_that_of_its_root_mean_square(d):
    points = np.random.default_rng(0).normal(size=(50, d))
    assert root_mean_square_range(points) == pytest.approx(math.sqrt((points**2).sum(axis=1).mean()))


@pytest.mark.parametrize("k", [3, 6])
def test_the_motion_between_two_poses_leads_from_one_to_the_other(k):
    a, b = some_pose(k), some_pose(k, seed=1)
    np.testing.assert_allclose(a @ lie.between(a, b), b, atol=1e-14)
    np.testing.assert_allclose(lie.between(a[None], b[None])[0], lie.between(a, b), atol=1e-14)


@pytest.mark.parametrize("k", [3, 6])
@pytest.mark.parametrize("angle_rad", [0.0, 1e-9, 0.3, 3.0, math.pi - 1e-6, math.pi])
def test_how_far_apart_two_poses_are(k, angle_rad):
    a = some_pose(k)
    turn = np.zeros(k)
    turn[-1] = angle_rad
    b = a @ lie.exp(turn)
    b[:-1, -1] += 0.5
    meters, radians = se.apart(a, b)
    assert meters == pytest.approx(0.5 * math.sqrt(len(a) - 1))
    assert radians == pytest.approx(angle_rad, abs=1e-7)
    assert math.isclose(radians, float(lie.rotation_angle(lie.between(a, b))), abs_tol=1e-7)
