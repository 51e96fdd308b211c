"""Noise of edges in the text files of TORO, GTSAM and iSAM, against numbers by hand."""

import numpy as np
import pytest

from scanchain.graph.edge_noise import BY_ROWS, TORO, is_invertible, order_of, positions, squared, symmetric


def test_upper_triangles_by_rows_become_symmetric_matrices():
    assert symmetric(np.array([[1.0, 2, 3, 4, 5, 6]])).tolist() == [[[1, 2, 3], [2, 4, 5], [3, 5, 6]]]
    assert symmetric(np.arange(21.0)[None])[0, 5].tolist() == [5, 10, 14, 17, 19, 20]


@pytest.mark.parametrize("preferred", [BY_ROWS, TORO])
def test_a_diagonal_matrix_fits_only_the_order_it_was_written_in(preferred):
    by_rows, toro = [3.16228, 0, 0, 3.16228, 0, 5], [3.16228, 0, 3.16228, 5, 0, 0]
    assert order_of(np.array([by_rows, by_rows]), preferred) == BY_ROWS
    assert order_of(np.array([toro, toro]), preferred) == TORO


@pytest.mark.parametrize("preferred", [BY_ROWS, TORO])
def test_where_both_orders_fit_or_none_does_it_is_the_preferred_one(preferred):
    of_both = np.array([[9.0, 0.1, 5.0, 9.0, 0.1, 4.0], [9.0, 0.2, 4.0, 9.0, 0.2, 5.0]])
    of_none = np.array([[-1.0, 0, 0, 1, 0, 1]])
    assert order_of(of_both, preferred) == order_of(of_none, preferred) == preferred


def test_one_line_that_fits_only_one_order_decides_for_all():
    entries = np.array([[9.0, 0.1, 5.0, 9.0, 0.1, 4.0], [1.0, 0, 0, 1, 0, 1]])
    assert order_of(entries[:1], TORO) == TORO and order_of(entries, TORO) == BY_ROWS


def test_the_information_is_the_square_of_its_root_where_that_is_not_symmetric_too():
    # R = [[1, 2, 3], [0, 4, 5], [0, 0, 6]], RᵀR by hand
    assert squared(symmetric(np.array([[1.0, 2, 3, 4, 5, 6]]))).tolist() == [[[1, 2, 3], [2, 20, 26], [3, 26, 70]]]


def test_bearing_and_range_ahead_and_to_the_left_have_their_deviations_along_and_across():
    ahead, left = positions(np.array([[0.0, 10.0, 0.02, 0.5], [np.pi / 2, 10.0, 0.02, 0.5]]))
    assert np.allclose(ahead, [10, 0, 0.25, 0, 0.04]) and np.allclose(left, [0, 10, 0.04, 0, 0.25])


def test_covariance_of_a_position_is_that_of_many_drawn_bearings_and_ranges():
    given, rng = np.array([0.7, 12.0, 0.01, 0.2]), np.random.default_rng(1)
    bearing, distance = given[:2, None] + given[2:, None] * rng.normal(size=(2, 200_000))
    drawn = np.cov(distance * np.cos(bearing), distance * np.sin(bearing))
    assert np.allclose(positions(given[None])[0, 2:], drawn[np.triu_indices(2)], rtol=0, atol=5e-4)


@pytest.mark.parametrize(
    ("entries", "expected"),
    [((4, 0, 4), True), ((4e-12, 0, 4), True), ((4, 4, 4), False), ((0, 0, 4), False), ((-4, 0, 4), False)],
)
def test_a_covariance_is_invertible_where_it_is_positive_definite_whatever_its_units(entries, expected):
    assert is_invertible(symmetric(np.array([entries], float))).tolist() == [expected]
