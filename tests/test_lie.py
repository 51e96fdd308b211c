import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from scanchain import lie
from tests.support import naive_graph

_length = st.floats(-50.0, 50.0)
_angles = st.one_of(
    st.just(0.0),
    st.floats(-1e-7, 1e-7),
    st.floats(-1e-3, 1e-3),
    st.floats(-3.0, 3.0),
    st.floats(np.pi - 1e-4, np.pi - 1e-9).flatmap(lambda a: st.sampled_from([a, -a])),
)


@st.composite
def _twists(draw, dimension=None):
    d = dimension or draw(st.sampled_from([2, 3]))
    angle = draw(_angles)
    if d == 2:
        return np.array([draw(_length), draw(_length), angle])
    axis = np.array([draw(st.floats(-1.0, 1.0)) for _ in range(3)])
    norm = np.linalg.norm(axis)
    axis = axis / norm if norm > 1e-3 else np.array([0.0, 0.0, 1.0])
    return np.array([*(draw(_length) for _ in range(3)), *(angle * axis)])


@given(_twists())
def test_exp_equals_the_matrix_exponential(twist):
    assert np.allclose(lie.exp(twist), naive_graph.exponential(twist), atol=1e-10)


@given(_twists())
def test_log_and_exp_undo_each_other_from_zero_to_nearly_pi(twist):
    T = lie.exp(twist)
    assert np.allclose(lie.log(T), twist, rtol=1e-6, atol=1e-6)
    assert np.allclose(lie.exp(lie.log(T)), T, atol=1e-7)


@given(_twists())
def test_a_pose_times_its_inverse_is_the_identity(twist):
    T = lie.exp(twist)
    assert np.allclose(lie.inverse(T) @ T, np.eye(len(T)), atol=1e-12)
    assert np.allclose(T @ lie.inverse(T), np.eye(len(T)), atol=1e-12)


@pytest.mark.parametrize("d", [2, 3])
@given(st.data())
def test_the_adjoint_carries_a_twist_through_a_pose_and_that_of_a_product_is_the_product(d, data):
    a, b, twist = (data.draw(_twists(d)) for _ in range(3))
    A, B = lie.exp(a), lie.exp(b)
    left = A @ lie.exp(twist) @ lie.inverse(A)
    assert np.allclose(left, lie.exp(lie.adjoint(A) @ twist), atol=1e-7)
    assert np.allclose(lie.adjoint(A @ B), lie.adjoint(A) @ lie.adjoint(B), atol=1e-9)


@given(_twists())
def test_rotation_angle_is_the_length_of_the_rotation_vector(twist):
    angle = abs(twist[2]) if len(twist) == 3 else np.linalg.norm(twist[3:])
    assert lie.rotation_angle(lie.exp(twist)) == pytest.approx(angle, abs=1e-9)


@given(st.floats(-1e4, 1e4))
def test_wrap_keeps_the_direction_and_lands_in_one_turn(angle):
    wrapped = lie.wrap(np.float64(angle))
    assert -np.pi <= wrapped <= np.pi
    assert np.allclose([np.cos(wrapped), np.sin(wrapped)], [np.cos(angle), np.sin(angle)], atol=1e-9)


@settings(max_examples=20)
@given(st.lists(_twists(3), min_size=1, max_size=5))
def test_a_stack_gives_what_its_members_give(twists):
    stack = np.array(twists)
    poses = lie.exp(stack)
    for function in (lie.inverse, lie.log, lie.adjoint, lie.rotation_angle, lie.yaw, lie.flatten):
        single = np.array([function(T) for T in poses])
        assert np.allclose(function(poses), single, atol=1e-12), function.__name__


@given(_twists())
def test_interpolation_starts_and_ends_at_its_poses(twist):
    T_a, T_b = lie.exp(0.3 * twist), lie.exp(twist)
    assert np.allclose(lie.interpolate(T_a, T_b, 0.0), T_a, atol=1e-9)
    assert np.allclose(lie.interpolate(T_a, T_b, 1.0), T_b, atol=1e-6)


@given(_twists(2))
def test_lifting_and_flattening_return_the_pose_of_the_plane(twist):
    T = lie.exp(twist)
    assert np.allclose(lie.flatten(lie.lift(T)), T, atol=1e-12)
    assert np.allclose(lie.pose_2d(T[0, 2], T[1, 2], float(lie.yaw(T))), T, atol=1e-12)


@given(_twists(3))
def test_quaternions_return_the_rotation(twist):
    R = lie.exp(twist)[:3, :3]
    quat = lie.to_quaternion(R)
    assert quat[3] >= 0.0
    assert np.allclose(lie.from_quaternion(quat), R, atol=1e-12)


@given(_twists())
def test_normalize_restores_orthonormal_rotations(twist):
    T = lie.exp(twist)
    d = len(T) - 1
    spoilt = T.copy()
    spoilt[:d, :d] += 1e-6 * np.arange(d * d).reshape(d, d)
    R = lie.normalize(spoilt)[:d, :d]
    assert np.allclose(R.T @ R, np.eye(d), atol=1e-14)
    assert np.linalg.det(R) == pytest.approx(1.0)
    assert np.allclose(R, T[:d, :d], atol=1e-4)


@given(_twists(3), st.integers(1, 20))
def test_transform_moves_points_as_the_matrix_does(twist, count):
    T = lie.exp(twist)
    points = np.random.default_rng(count).normal(size=(count, 3))
    homogeneous = np.column_stack([points, np.ones(count)]) @ T.T
    assert np.allclose(lie.transform(T, points), homogeneous[:, :3], atol=1e-12)
