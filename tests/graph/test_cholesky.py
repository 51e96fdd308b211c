import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanchain.graph.cholesky import BlockPattern, SingularMatrixError, SparseCholesky, analyze
from tests.support import naive_graph


def _matrix(sizes, pairs, seed):
    """A positive definite matrix of the given blocks: the pattern, its values, the dense matrix."""
    rng = np.random.default_rng(seed)
    pattern = BlockPattern(np.array(sizes, np.int64), np.array(pairs, np.int64).reshape(-1, 2))
    values = rng.normal(size=pattern.value_count)
    at = 0
    for size in sizes:
        block = values[at : at + size**2].reshape(size, size)
        block[:] = block + block.T
        at += size**2
    values[pattern.diagonal] += 4.0 * np.abs(naive_graph.dense(pattern, values)).sum(axis=1)
    return pattern, values, naive_graph.dense(pattern, values)


@st.composite
def _graphs(draw):
    sizes = draw(st.lists(st.integers(1, 6), min_size=1, max_size=25))
    n = len(sizes)
    possible = [(a, b) for a in range(n) for b in range(n) if a != b]
    chosen = draw(st.lists(st.sampled_from(possible), max_size=3 * n)) if possible else []
    unique = {frozenset(pair): pair for pair in chosen}
    return sizes, list(unique.values()), draw(st.integers(0, 1000))


@settings(max_examples=150, deadline=None)
@given(_graphs())
def test_solutions_and_the_selected_inverse_equal_the_dense_ones_for_any_pattern_and_block_sizes(graph):
    pattern, values, A = _matrix(*graph)
    cholesky = SparseCholesky(pattern, analyze(pattern))
    for scale in (5.0, 1.0):  # of the first factorization nothing is left
        cholesky.factorize(scale * values)
    b = np.random.default_rng(graph[2]).normal(size=(len(A), 2))
    assert np.allclose(cholesky.solve(b), np.linalg.solve(A, b), rtol=1e-9, atol=1e-12)
    assert np.allclose(cholesky.solve(b[:, 0]), np.linalg.solve(A, b[:, 0]), rtol=1e-9, atol=1e-12)
    chosen = np.flatnonzero(np.random.default_rng(graph[2]).random(len(pattern.sizes)) < 0.3)
    here = np.isin(np.repeat(np.arange(len(pattern.sizes)), pattern.sizes), chosen)
    B = np.where(here[:, None], b, 0.0)
    assert np.allclose(cholesky.covariance_of(b[here], chosen), B.T @ np.linalg.solve(A, B), rtol=1e-9, atol=1e-12)
    assert np.allclose(pattern.multiply(values, b[:, 0]), A @ b[:, 0], rtol=1e-12, atol=1e-9)
    inverse = naive_graph.dense(pattern, cholesky.inverse_blocks())
    there = naive_graph.dense(pattern, np.ones(pattern.value_count)) != 0.0
    assert np.allclose(inverse[there], np.linalg.inv(A)[there], rtol=1e-9, atol=1e-14)


@pytest.mark.parametrize("size", [1, 3, 6])
def test_wide_fronts_are_eliminated_in_panels_and_tiles(size):
    n = 420 // size
    rng = np.random.default_rng(0)
    pairs = [(i, j) for i in range(n) for j in range(i) if rng.random() < 0.5 or i - j == 1]
    pattern, values, A = _matrix([size] * n, pairs, 3)
    cholesky = SparseCholesky(pattern, analyze(pattern))
    cholesky.factorize(values)
    b = rng.normal(size=len(A))
    assert np.allclose(A @ cholesky.solve(b), b, atol=1e-10)


@pytest.mark.parametrize(
    ("sizes", "values", "words"),
    [([2, 2, 2], [1, 0, 0, 1, 2, 0, 0, 2, 1, 0, 0, 0, 0, 0, 0, 0], "variable 2"), ([1, 1], [1, 1, 2], "variable")],
)
def test_a_singular_or_indefinite_matrix_names_the_undetermined_variable(sizes, values, words):
    pattern = BlockPattern(np.array(sizes), np.array([[1, 0]]))
    with pytest.raises(SingularMatrixError, match=words):
        SparseCholesky(pattern, analyze(pattern)).factorize(np.array(values, float))
