"""Drift, slips and jumps of odometry applied to its edges."""

import numpy as np
import pytest

from scanchain import lie
from scanchain.graph.odometry_errors import Explanation, InflatedSegment, corrected, error_twists, odometry_of

SEGMENTS = (InflatedSegment(2, 4, False), InflatedSegment(7, 1, True))


def odometry(dimension, count=9):
    """Motions along a chain and their information, as edges to the next pose."""
    rng, k = np.random.default_rng(dimension), 3 * dimension - 3
    A = rng.normal(size=(count, k, k))
    ahead = np.eye(k)[0]
    edges = np.stack([np.arange(count), np.arange(count) + 1], axis=1)
    return (
        edges,
        lie.exp(ahead + 0.2 * rng.normal(size=(count, k))),
        100.0 * (A @ np.swapaxes(A, 1, 2) + np.eye(k)),
    )


def drift_of(dimension):
    return np.array([0.03, 0.01] if dimension == 2 else [0.03, 0.01, -0.02, 0.03])


def test_a_drift_lengthens_a_motion_and_turns_it_by_its_length(dimension):
    _, Z, _ = odometry(dimension)
    drift, before = drift_of(dimension), lie.log(Z)
    after = lie.log(corrected(Z, drift))
    length_m = np.linalg.norm(before[:, :dimension], axis=1)
    np.testing.assert_allclose(after[:, :dimension], 1.03 * before[:, :dimension], atol=1e-12)
    np.testing.assert_allclose(
        after[:, dimension:] - before[:, dimension:], length_m[:, None] * drift[1:], atol=1e-12
    )
    backward = corrected(lie.inverse(Z), drift, -1.0)
    np.testing.assert_allclose(backward, lie.inverse(corrected(Z, drift)), atol=1e-12)


def test_edges_in_any_order_are_corrected_alike_and_those_of_no_odometry_left_as_they_are(dimension):
    edges, Z, information = odometry(dimension)
    explanation = Explanation(drift_of(dimension), SEGMENTS)
    every = np.ones(len(edges), bool)
    moved, weaker = explanation.applied(edges, Z, information, every)
    order = np.random.default_rng(0).permutation(len(edges) + 1)
    is_odometry = order < len(edges)
    loop = np.array([[0, 9]]), lie.exp(np.ones((1, information.shape[1]))), information[:1]
    mixed = [np.concatenate([own, other])[order] for own, other in zip((edges, Z, information), loop, strict=True)]
    found = explanation.applied(*mixed, is_odometry)
    for array, own, other in zip(found, (moved, weaker), loop[1:], strict=True):
        np.testing.assert_allclose(array, np.concatenate([own, other])[order], rtol=1e-12)
    assert odometry_of(mixed[0], is_odometry).tolist() == np.argsort(order)[: len(edges)].tolist()


def test_the_covariance_of_a_segment_grows_by_that_of_its_error_spread_over_its_edges(dimension):
    edges, Z, information = odometry(dimension)
    explanation = Explanation(np.zeros(2 if dimension == 2 else 4), SEGMENTS)
    moved, weaker = explanation.applied(edges, Z, information, np.ones(len(edges), bool))
    assert np.array_equal(moved, Z)
    grown = np.linalg.inv(weaker) - np.linalg.inv(information)
    inside = np.zeros(len(edges), bool)
    for segment in SEGMENTS:
        inside[segment.edges] = True
        twists = segment.error_twists(Z, information)
        expected = segment.count * twists @ np.swapaxes(twists, 1, 2)
        np.testing.assert_allclose(grown[segment.edges], expected, atol=1e-9)
        sizes = np.linalg.norm(twists, axis=1)  # of one standard deviation, all of the segment: 1 m, and 0.2 rad
        limits = [*dimension * [1.0], *(len(weaker[0]) - dimension) * [0.2]] if segment.is_jump else [1.0]
        np.testing.assert_allclose(sizes.sum(axis=0), limits)
    assert np.array_equal(weaker[~inside], information[~inside])


def test_the_noise_of_odometry_is_lengthened_with_it(dimension):
    edges, Z, information = odometry(dimension)
    drift = drift_of(dimension)
    _, found = Explanation(drift).applied(edges, Z, information, np.ones(len(edges), bool))
    scale = lie.by_component(information.shape[1], 1.03, 1.0)
    np.testing.assert_allclose(
        np.linalg.inv(found), np.linalg.inv(information) * np.outer(scale, scale), rtol=1e-9
    )


def test_an_explanation_costs_more_the_larger_the_drift_the_more_segments_and_the_surer_the_edges(dimension):
    _, Z, information = odometry(dimension)
    none = Explanation.none(information.shape[1])
    assert none.cost(Z, information, 16.0, 16.0) == 0.0
    cheap, dear = (
        Explanation(share * drift_of(dimension)).cost(Z, information, 16.0, 16.0) for share in (0.1, 1.0)
    )
    assert 3 * 16.0 < cheap < dear
    assert dear - 48.0 == pytest.approx(100.0 * (cheap - 48.0))
    slip, jump = (Explanation(none.drift, (segment,)).cost(Z, information, 16.0, 16.0) for segment in SEGMENTS)
    assert 2.0 * np.log(1e3) < slip < Explanation(none.drift, SEGMENTS[:1]).cost(Z, 9.0 * information, 16.0, 16.0)
    assert jump > slip + 48.0
    later = Explanation(none.drift, SEGMENTS[:1]).with_later(Explanation(none.drift, SEGMENTS[1:]), 100)
    assert later.inflated == (SEGMENTS[0], InflatedSegment(107, 1, True))


@pytest.mark.parametrize(("across", "axis"), [(1.0, 0), (1.0 / 3.0, 1), (3.0, 0)])
def test_a_slip_is_along_the_motion_unless_another_direction_is_much_less_certain(dimension, across, axis):
    k = 3 * dimension - 3
    information = np.diag(lie.by_component(k, 1e4, 1e4))
    information[1, 1] *= across
    (twist,) = error_twists(lie.exp(np.eye(k)[:1]), information[None], is_jump=False)
    np.testing.assert_allclose(np.abs(twist[:, 0]), np.eye(k)[axis], atol=1e-9)


def test_what_a_jump_costs_is_scaled_with_the_price_of_a_loop_edge(dimension):
    _, Z, information = odometry(dimension)
    jump = Explanation(np.zeros(2 if dimension == 2 else 4), SEGMENTS[1:])
    whole, half = (jump.cost(Z, information, price, 16.0) for price in (16.0, 8.0))
    assert half == pytest.approx(0.5 * whole)
