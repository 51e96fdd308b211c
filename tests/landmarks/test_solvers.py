import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanchain.errors import InputError
from scanchain.landmarks import solvers
from scanchain.landmarks.problem import Layout, LinearSystem, Pattern
from scanchain.landmarks.solvers import METHODS, UndeterminedError, create_solver
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


def factored(method, system):
    """Solution and factor."""
    solver = create_solver(method)
    return solver.solve(system), solver.factor()


@pytest.mark.parametrize("method", METHODS)
@settings(max_examples=25, deadline=None)
@given(poses=st.integers(1, 12), landmarks=st.integers(1, 8), size=st.integers(2, 3), seed=st.integers(0, 1000))
def test_every_method_gives_the_dense_least_squares_solution(method, poses, landmarks, size, seed):
    A, system = problem(poses, landmarks, seed, size=size)
    condition = np.linalg.cond(A)
    expected = np.linalg.lstsq(A, system.b, rcond=None)[0]
    x, factor = factored(method, system)
    tolerance = 1e-14 * (condition if method.startswith("qr") else condition**2) * 100.0
    assert np.abs(x - expected).max() <= max(tolerance, 1e-11) * max(np.abs(expected).max(), 1.0)
    assert np.array_equal(factored(method, system)[0], x)
    assert np.array_equal(np.sort(factor.order), np.arange(A.shape[1]))
    U, H = factor.matrix.toarray(), A.T @ A
    if method == "pinv":
        assert np.allclose(U, np.linalg.inv(H), rtol=max(tolerance, 1e-6), atol=tolerance * np.abs(U).max())
    else:
        assert not np.tril(U, -1).any()
    if method in OWN:
        H = H[np.ix_(factor.order, factor.order)]
        assert np.allclose(U.T @ U, H, rtol=1e-10, atol=1e-10 * np.abs(H).max())


def test_qr_keeps_the_digits_that_the_normal_equations_lose():
    """A Läuchli matrix: AᵀA is singular in floating point, A is not."""
    e = 1e-8 / 3.0
    A = np.array([[1.0, 1.0, 0.0, 0.0], [e, 0.0, 0.0, 0.0], [0.0, e, 0.0, 0.0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]])
    x = np.array([1.0, 2.0, 3.0, 4.0])
    system = system_of(A, A @ x, Layout(1, 2, np.zeros(1, np.int64)))
    for method in METHODS:
        if method.startswith("qr"):
            assert np.allclose(create_solver(method).solve(system), x, rtol=1e-6)
        else:
            with pytest.raises(UndeterminedError):
                create_solver(method).solve(system)


@pytest.mark.parametrize("method", METHODS)
def test_what_the_equations_leave_open_is_named(method):
    """A landmark that nobody saw; every position, where there is no prior."""
    A, system = problem(8, 5, 1)
    layout = Layout(8, 2, np.array([7, 9, 12, 13, 14]))
    A[:, layout.split + 4] = 0.0
    with pytest.raises(UndeterminedError, match=r"leave landmark 12 x open") as raised:
        create_solver(method).solve(system_of(A, system.b, layout))
    assert raised.value.columns.tolist() == [layout.split + 4]
    steps = np.diff(np.eye(20).reshape(10, 2, 20), axis=0).reshape(18, 20)
    layout = Layout(9, 2, np.zeros(1, np.int64))  # the last of ten points counts as a landmark
    with pytest.raises(UndeterminedError, match=r"pose 0 x, pose 0 y, .* and 14 more open") as raised:
        create_solver(method).solve(system_of(steps, np.ones(18), layout))
    assert len(raised.value.columns) == 20


@pytest.mark.parametrize("method", METHODS)
def test_a_solver_that_keeps_its_analysis_forgets_the_numbers_of_the_last_system(method):
    (A, system), (B, other) = problem(15, 9, 2), problem(7, 3, 4)
    solver = create_solver(method)
    solver.solve(LinearSystem(system.pattern, 3.0 * system.values, system.b))
    assert np.allclose(solver.solve(system), np.linalg.lstsq(A, system.b, rcond=None)[0])
    assert np.allclose(solver.solve(other), np.linalg.lstsq(B, other.b, rcond=None)[0])
    assert solver.solutions == 3 and np.all(solver.spent_s > 0.0)


def test_schur_eliminates_the_poses_where_they_are_more_and_is_cholesky_elsewhere():
    for poses, landmarks, is_arrow in ((30, 10, True), (10, 30, False)):
        A, system = problem(poses, landmarks, 6)
        order = factored("schur", system)[1].order
        assert np.array_equal(order, np.arange(A.shape[1])) == is_arrow  # poses first, then landmarks


def test_the_order_of_qr_colamd_saves_fill_in():
    A, system = problem(60, 12, 8, seen=0.2)
    order = factored("qr_colamd", system)[1].order
    backward = np.arange(A.shape[1])[::-1]
    assert naive_landmarks.fill_in(A, order) < 0.5 * naive_landmarks.fill_in(A, backward)
    assert naive_landmarks.fill_in(A, order) < naive_landmarks.fill_in(A, np.arange(A.shape[1]))


def test_covariances_equal_those_of_the_dense_inverse():
    A, system = problem(12, 5, 9, size=3)
    dense = np.linalg.inv(A.T @ A)
    split = system.pattern.layout.split
    covariance = solvers.Covariance(system)
    for wanted in ([3, 4, 5, 6, 7, 8], [0, 1, 2, split, split + 1], [split, split + 1, split + 8, split + 9]):
        assert np.allclose(covariance.of(np.array([wanted]))[0], dense[np.ix_(wanted, wanted)], rtol=1e-9)
    assert np.isnan(covariance.of(np.array([[0, 30]]))[0, 0, 1])


def test_methods_are_parsed_and_unknown_ones_refused():
    others = tuple(name for name in METHODS if name != "pinv")
    assert solvers.methods_for(solvers.parse_methods("pinv, all"), 100) == (("pinv", *others), {})
    with pytest.raises(InputError, match="no method"):
        solvers.parse_methods("")
