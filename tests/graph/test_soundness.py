"""Which information matrices a graph takes: finite, symmetric and positive semidefinite ones."""

import numpy as np
import pytest

from scanchain.graph.edge_checks import positive_semidefinite, ranks


def some_matrices(k, seed=0):
    """Definite, of rank one, indefinite, lopsided, not finite and zero, by turns; (600, k, k)."""
    rng = np.random.default_rng(seed)
    A = rng.normal(size=(600, k, k))
    matrices = A @ np.swapaxes(A, 1, 2)
    v = rng.normal(size=(600, k, 1))
    matrices[1::6] = (v @ np.swapaxes(v, 1, 2))[1::6]
    matrices[2::6, 0, 0] *= -1.0
    matrices[3::6] = A[3::6]
    matrices[4::12, 1, 1], matrices[10::12, 0, 1] = np.nan, np.inf
    matrices[5::6] = 0.0
    return matrices


@pytest.mark.parametrize("k", [2, 3, 6])
def test_a_matrix_is_sound_that_is_finite_symmetric_and_has_no_negative_eigenvalue(k):
    matrices = some_matrices(k)
    finite = np.isfinite(matrices).all(axis=(1, 2))
    known = np.where(finite[:, None, None], matrices, 0.0)
    symmetric = np.isclose(known, np.swapaxes(known, 1, 2)).all(axis=(1, 2))
    definite = np.linalg.eigvalsh(known)[:, 0] >= -1e-6 * np.abs(known).max(axis=(1, 2))
    wanted = finite & symmetric & definite
    assert 100 < wanted.sum() < 500
    np.testing.assert_array_equal(positive_semidefinite(matrices), wanted)


@pytest.mark.parametrize(("negative", "is_sound"), [(1e-7, True), (1e-5, False)])
def test_printed_digits_may_make_an_eigenvalue_a_little_negative(negative, is_sound):
    assert positive_semidefinite(np.diag([1.0, 1.0, -negative])[None])[0] == is_sound


def test_no_matrices_are_no_trouble():
    assert len(positive_semidefinite(np.empty((0, 3, 3)))) == 0


@pytest.mark.parametrize("k", [2, 3, 6])
def test_the_rank_of_an_information_matrix_does_not_depend_on_its_units(k):
    rng = np.random.default_rng(0)
    for rank in range(k + 1):
        A = rng.normal(size=(20, rank, k))
        units = np.diag(10.0 ** rng.uniform(-6.0, 6.0, k))
        assert (ranks(units @ np.swapaxes(A, 1, 2) @ A @ units) == rank).all()
    assert ranks(np.diag([1e-12, *[1e9] * (k - 1)])[None]).tolist() == [k]
