import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanchain.errors import InputError
from scanchain.landmarks.problem import Layout, LinearSystem, Pattern
from scanchain.landmarks.solvers import METHODS, UndeterminedError, create_solver, methods_for, parse_methods
from scanchain.landmarks.solvers.elimination import Covariance
from tests.support import naive_landmarks

OWN = ("qr", "qr_colamd", "cholesky", "schur")


def system_of(A, b, layout):
    row, column = np.nonzero(A)
    start = np.concatenate([[0], np.cumsum(np.count_nonzero(A, axis=1))])
    return LinearSystem(Pattern(start, column, layout), A[row, column], b)


def problem(poses, landmarks, seed, seen=0.5, size=2):
    """A chain of poses of ``size`` unknowns that see some of the landmarks, with random numbers in its rows."""
    rng = np.random.default_rng(seed)
    layout = Layout(poses, size, np.arange(landmarks))
    split = layout.split
    rows = [np.eye(layout.columns)[k] for k in range(size)]

    def join(first, second):
        row = np.zeros(layout.columns)
        row[first], row[second] = rng.normal(size=len(first)), rng.normal(size=len(second))
        rows.append(row)

    for k in range(poses - 1):
        for _ in range(size):
            join(np.arange(k * size, (k + 1) * size), np.arange((k + 1) * size, (k + 2) * size))
    for j in range(landmarks):
        watching = np.flatnonzero(rng.random(poses) < seen)
        for k in {0, *watching.tolist()}:
            for _ in range(2):
                join(np.arange(k * size, (k + 1) * size), np.arange(split + 2 * j, split + 2 * j + 2))
    A = np.array(rows)
    return A, system_of(A, rng.normal(size=len(A)), layout)


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25, deadline=None)
@given(poses=st.integers(1, 12), landmarks=st.integers(1, 8), size=st.integers(2, 3), seed=st.integers(0, 1000))
def test_every_method_gives_the_dense_least_squares_solution(method, poses, landmarks, size, seed):
    A, system = problem(poses, landmarks, seed, size=size)
    condition = np.linalg.cond(A)
    expected = np.linalg.lstsq(A, system.b, rcond=None)[0]
    solution = create_solver(method).solve(system)
    tolerance = 1e-14 * (condition if method.startswith("qr") else condition**2) * 100.0
    assert np.abs(solution.x - expected).max() <= max(tolerance, 1e-11) * max(np.abs(expected).max(), 1.0)


@pytest.mark.parametrize("method", [name for name in METHODS if name != "pinv"])
def test_the_factor_is_triangular_and_reproduces_the_normal_equations(method):
    A, system = problem(20, 10, 3)
    factor = create_solver(method).solve(system).factor()
    U = factor.matrix.toarray()
    assert np.array_equal(np.sort(factor.order), np.arange(A.shape[1]))
    assert not np.tril(U, -1).any()
    if method in OWN:
        H = (A.T @ A)[np.ix_(factor.order, factor.order)]
        assert np.allclose(U.T @ U, H, rtol=1e-10, atol=1e-10)


def test_the_factor_of_pinv_is_the_inverse():
    A, system = problem(6, 4, 5)
    factor = create_solver("pinv").solve(system).factor()
    assert np.allclose(factor.matrix.toarray(), np.linalg.inv(A.T @ A))


def test_qr_is_orthogonal_factorization_and_keeps_the_digits_that_the_normal_equations_lose():
    """A Läuchli matrix: AᵀA is singular in floating point, A is not."""
    e = 1e-8 / 3.0
    A = np.array([[1.0, 1.0, 0.0, 0.0], [e, 0.0, 0.0, 0.0], [0.0, e, 0.0, 0.0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    x = np.array([1.0, 2.0, 3.0, 4.0])
    system = system_of(A, A @ x, Layout(1, 2, np.zeros(1, np.int64)))
    for method in ("cholesky", "schur", "lu", "default", "pinv"):
        with pytest.raises(UndeterminedError):
            create_solver(method).solve(system)
    for method in ("qr", "qr_colamd"):
        assert np.allclose(create_solver(method).solve(system).x, x, rtol=1e-6)


@pytest.mark.parametrize("method", METHODS)
def test_a_landmark_that_nobody_saw_is_named(method):
    A, system = problem(8, 5, 1)
    layout = Layout(8, 2, np.array([7, 9, 12, 13, 14]))
    A[:, layout.split + 4] = 0.0
    with pytest.raises(UndeterminedError, match=r"leave landmark 12 x open") as raised:
        create_solver(method).solve(system_of(A, system.b, layout))
    assert raised.value.columns.tolist() == [layout.split + 4]


@pytest.mark.parametrize("method", METHODS)
def test_without_a_prior_every_position_floats_and_the_error_says_so(method):
    steps = np.zeros((18, 20))
    for k in range(9):
        for c in range(2):
            steps[2 * k + c, 2 * k + c], steps[2 * k + c, 2 * k + 2 + c] = -1.0, 1.0
    layout = Layout(9, 2, np.zeros(1, np.int64))  # the last of ten points counts as a landmark
    with pytest.raises(UndeterminedError, match=r"pose 0 x, pose 0 y, .* and 14 more open") as raised:
        create_solver(method).solve(system_of(steps, np.ones(18), layout))
    assert len(raised.value.columns) == 20


def test_a_solver_that_keeps_its_analysis_forgets_the_numbers_of_the_last_system():
    A, system = problem(15, 9, 2)
    for method in METHODS:
        solver = create_solver(method)
        solver.solve(LinearSystem(system.pattern, 3.0 * system.values, system.b))
        assert np.allclose(solver.solve(system).x, np.linalg.lstsq(A, system.b, rcond=None)[0])
        B, other = problem(7, 3, 4)
        assert np.allclose(solver.solve(other).x, np.linalg.lstsq(B, other.b, rcond=None)[0])


def test_schur_eliminates_the_poses_where_they_are_more_and_is_cholesky_elsewhere():
    for poses, landmarks, is_arrow in ((30, 10, True), (10, 30, False)):
        A, system = problem(poses, landmarks, 6)
        solution = create_solver("schur").solve(system)
        assert np.allclose(solution.x, np.linalg.lstsq(A, system.b, rcond=None)[0])
        factor, order = solution.factor().matrix.toarray(), solution.factor().order
        assert np.allclose(factor.T @ factor, (A.T @ A)[np.ix_(order, order)])
        assert np.array_equal(order, np.arange(A.shape[1])) == is_arrow  # poses first, then landmarks


def test_the_order_of_qr_colamd_saves_fill_in():
    A, system = problem(60, 12, 8, seen=0.2)
    order = create_solver("qr_colamd").solve(system).factor().order
    backward = np.arange(A.shape[1])[::-1]
    assert naive_landmarks.fill_in(A, order) < 0.5 * naive_landmarks.fill_in(A, backward)
    assert naive_landmarks.fill_in(A, order) < naive_landmarks.fill_in(A, np.arange(A.shape[1]))


def test_covariances_equal_those_of_the_dense_inverse():
    A, system = problem(12, 5, 9, size=3)
    dense = np.linalg.inv(A.T @ A)
    split = system.pattern.layout.split
    covariance = Covariance(system)
    for wanted in ([3, 4, 5, 6, 7, 8], [0, 1, 2, split, split + 1], [split, split + 1, split + 8, split + 9]):
        assert np.allclose(covariance.of(np.array([wanted]))[0], dense[np.ix_(wanted, wanted)], rtol=1e-9)
    assert np.isnan(covariance.of(np.array([[0, 30]]))[0, 0, 1])


def test_the_same_solution_twice_is_equal_to_the_bit():
    _, system = problem(30, 12, 10)
    for method in OWN:
        first, second = (create_solver(method).solve(system).x for _ in range(2))
        assert np.array_equal(first, second)


def test_methods_are_parsed_and_unknown_ones_refused():
    assert parse_methods("lu, qr") == ("lu", "qr")
    with pytest.raises(InputError, match="names one twice: lu, qr, lu"):
        parse_methods("lu, qr,lu")
    assert methods_for(parse_methods("qr,all"), 100) == (("qr", *(name for name in METHODS if name != "qr")), "")
    for text in ("lu,chol", ""):
        with pytest.raises(InputError, match="choose from all, default, pinv"):
            parse_methods(text)


def test_suitesparse_qr_agrees_where_it_is_installed_and_names_its_extra_where_not():
    A, system = problem(20, 10, 11)
    try:
        import sparseqr  # noqa: F401
    except ImportError:
        with pytest.raises(InputError, match=r"scanchain\[suitesparse\]"):
            create_solver("spqr")
        return
    for method in ("spqr", "spqr_colamd"):
        assert np.allclose(create_solver(method).solve(system).x, np.linalg.lstsq(A, system.b, rcond=None)[0])
