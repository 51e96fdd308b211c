import numpy as np
import pytest

from scanchain import lie
from scanchain.config import LocalMapConfig, MatchingConfig
from scanchain.kernels import matrices, scans, voxels
from scanchain.kernels.geometry import largest_magnitude, perturb
from scanchain.kernels.registration import icp, residuals
from scanchain.kernels.registration.association import associate, weigh
from scanchain.kernels.registration.residuals import normal_equations
from scanchain.kernels.voxels import Cell, insert
from scanchain.registration import VoxelMap
from scanchain.registration.plicp import settings_of
from tests.support import naive

SHAPES = {0.0: "point", 1.0: "line", 2.0: "plane"}
MOTION = {2: lie.exp(np.array([0.1, -0.2, 0.1])), 3: lie.exp(np.array([0.1, -0.2, 0.1, 0.02, 0.03, 0.1]))}


def some_points(dimension, n=400, seed=0):
    """A wall, a pole and clutter, so that every shape occurs."""
    rng = np.random.default_rng(seed)
    wall = np.column_stack([rng.uniform(-3, 3, n), 2.0 + 0.01 * rng.normal(size=n), rng.uniform(-1, 1, n)])
    pole = np.column_stack([0.3 + 0.01 * rng.normal(size=(n, 2)), rng.uniform(-1, 2, n)])
    clutter = rng.uniform(-3, 3, (n // 4, 3))
    return np.ascontiguousarray(np.concatenate([wall, pole, clutter])[:, :dimension])


def map_of(points, size=0.5, alone=8, noise=0.0):
    voxel_map = VoxelMap(points.shape[1], LocalMapConfig(voxel_size_m=size))
    insert(voxel_map.voxels, points, lie.identity(points.shape[1]), 1, float(alone), noise)
    return voxel_map


def keys_of(voxel_map):
    return [voxels.unpack(key) for key in voxel_map.voxels.keys[: len(voxel_map)]]


def adjacent(a, b):
    return max(abs(i - j) for i, j in zip(a, b, strict=True)) <= 1


def paired(voxel_map, correspondence):
    """Pairs as naive.py takes them."""
    d = voxel_map.dimension
    cells = voxel_map.voxels.cells
    return [
        (i, cells[j, :d], SHAPES[cells[j, Cell.SHAPE]], cells[j, Cell.DIRECTION : Cell.DIRECTION + d])
        for i, j in enumerate(correspondence)
        if j >= 0
    ]


@pytest.mark.parametrize("coordinates", [(0, 0, 0), (-1, 5, -1048576), (1048575, -7, 3)])
def test_a_voxel_key_unpacks_to_the_coordinates_it_was_made_of(coordinates):
    assert voxels.unpack(voxels.pack(*coordinates)) == coordinates


def test_every_key_is_found_where_it_was_put_even_in_a_crowded_table():
    rng = np.random.default_rng(1)
    wanted = np.unique(rng.integers(0, 2**40, 900))
    keys = np.full(1024, voxels.EMPTY)
    for key in wanted:
        keys[~voxels.find(keys, key)] = key
    assert all(keys[voxels.find(keys, key)] == key for key in wanted)
    assert voxels.find(keys, 2**41 + 1) < 0


@pytest.mark.parametrize("spread", [(1.0, 1.0, 1.0), (1.0, 1e-3, 1e-6), (5.0, 5.0, 1e-4), (1e-9, 2e-9, 3e-9)])
def test_closed_form_eigenvectors_equal_lapack(spread):
    rng = np.random.default_rng(2)
    for _ in range(50):
        Q = np.linalg.qr(rng.normal(size=(3, 3)))[0]
        A = Q @ np.diag(np.array(spread) * rng.uniform(0.5, 1.0, 3)) @ Q.T
        entries = A[0, 0], A[0, 1], A[0, 2], A[1, 1], A[1, 2], A[2, 2]
        values = np.array(matrices.eigenvalues_3d(*entries))
        expected, vectors = np.linalg.eigh(A)
        np.testing.assert_allclose(values, expected, atol=1e-7 * expected[-1])
        v = np.array(matrices.eigenvector_3d(*entries, values[0]))
        gap = (expected[1] - expected[0]) / expected[-1]
        assert abs(v @ vectors[:, 0]) > 1.0 - 1e-6 / gap**2


@pytest.mark.parametrize("alone", [1, 8, 10**6])
def test_voxels_keep_the_mean_and_shape_of_their_points(dimension, alone):
    points = some_points(dimension)
    voxel_map = map_of(points, alone=alone)
    groups = naive.group(points, 0.5)
    cells = voxel_map.voxels.cells
    assert sorted(keys_of(voxel_map)) == sorted(groups)
    seen = set()
    for voxel, key in enumerate(keys_of(voxel_map)):
        around = [members for other, members in groups.items() if other != key and adjacent(other, key)]
        kind, direction = naive.shape(naive.members_of(groups[key], around, alone, 0.5))
        np.testing.assert_allclose(cells[voxel, :dimension], groups[key].mean(0), atol=1e-12)
        assert SHAPES[cells[voxel, Cell.SHAPE]] == kind
        seen.add(kind)
        if direction is not None:
            assert abs(cells[voxel, Cell.DIRECTION : Cell.DIRECTION + dimension] @ direction) > 1.0 - 1e-9
    assert "plane" in seen


@pytest.mark.parametrize("alone", [8, 10**6])
def test_shapes_of_noisy_points_are_cleared_of_the_noise_and_means_lie_on_the_surface_about_them(dimension, alone):
    noise = 0.15**2
    points = some_points(dimension)
    points += 0.15 * np.random.default_rng(1).normal(size=points.shape)
    voxel_map = map_of(points, alone=alone, noise=noise)
    groups, seen, off_m = naive.group(points, 0.5), set(), []
    for voxel, key in enumerate(keys_of(voxel_map)):
        around = [members for other, members in groups.items() if other != key and adjacent(other, key)]
        members = naive.members_of(groups[key], around, alone, 0.5, noise)
        kind, direction = naive.shape(members, noise)
        cell, mean = voxel_map.voxels.cells[voxel], groups[key].mean(0)
        if kind == "plane" and members is not groups[key]:
            mean = naive.mean_of(groups[key], members, direction, 0.5, noise)
            off_m.append((abs(mean[1] - 2.0), abs(groups[key].mean(0)[1] - 2.0)))
        assert SHAPES[cell[Cell.SHAPE]] == kind
        np.testing.assert_allclose(cell[:dimension], mean, atol=1e-9)
        seen.add(kind)
    assert {"plane", "point"} <= seen
    of_plane, of_points = np.mean([pair for pair in off_m if pair[1] < 0.5], axis=0)
    assert of_plane < 0.7 * of_points


def test_a_voxel_map_far_from_its_origin_loses_no_precision():
    points = some_points(3)
    offset = np.array([200_000.0, -150_000.0, 300.0])
    here, there = map_of(points), map_of(points + offset)
    order = [keys_of(there).index(tuple(np.add(key, offset / 0.5).astype(int))) for key in keys_of(here)]
    np.testing.assert_allclose(there.points()[order] - offset, here.points(), atol=1e-9)


@pytest.mark.parametrize("reach", [1, 2])
def test_association_finds_the_nearest_mean(dimension, reach):
    points = some_points(dimension)
    voxel_map = map_of(points)
    means = dict(zip(keys_of(voxel_map), voxel_map.points(), strict=True))
    T = MOTION[dimension]
    correspondence = np.empty(len(points), np.int32)
    found = associate(voxel_map.voxels, points, T, reach, 0.6, correspondence)
    keys = keys_of(voxel_map)
    expected = [naive.nearest_mean(p, means, 0.5, reach, 0.6) for p in lie.transform(T, points)]
    assert [keys[j] if j >= 0 else None for j in correspondence] == expected
    assert found == sum(key is not None for key in expected)


@pytest.mark.parametrize("alone", [8, 10**6])
def test_the_weight_is_the_sensors_variance_over_the_residuals(dimension, alone):
    points = some_points(dimension)
    voxel_map = map_of(points, alone=alone)
    groups = naive.group(points, 0.5)
    T = MOTION[dimension]
    correspondence, weight = weighed(voxel_map, points, T, 0.6)
    keys, moved = keys_of(voxel_map), lie.transform(T, points)
    assert np.array_equal(weight == 0.0, correspondence < 0)
    for i, mean, kind, direction in paired(voxel_map, correspondence):
        key = keys[correspondence[i]]
        near = [members for other, members in groups.items() if other != key and adjacent(other, key)]
        members = naive.members_of(groups[key], near, alone, 0.5)
        expected = naive.weight_of(moved[i], T, mean, kind, direction, members, 0.5, 0.02**2)
        assert weight[i] == pytest.approx(expected, rel=1e-6)


def weight_of(points, passes=1):
    """Median weight of points in a map of themselves, inserted so many times, seen from the origin."""
    voxel_map = VoxelMap(3, LocalMapConfig(voxel_size_m=1.0))
    for _ in range(passes):
        voxel_map.insert(points, np.eye(4))
    correspondence, weight = weighed(voxel_map, points, np.eye(4), 1.0)
    return float(np.median(weight[correspondence >= 0]))


def weighed(voxel_map, points, T, max_distance_m):
    """Correspondences and weights of points at T, for ranges good to 2 cm."""
    correspondence, weight = np.empty(len(points), np.int32), np.empty(len(points))
    associate(voxel_map.voxels, points, T, 1, max_distance_m, correspondence)
    weigh(voxel_map.voxels, points, T, correspondence, 0.02**2, weight)
    return correspondence, weight


def test_points_on_lines_have_no_negative_weight():
    """The variances across a line are rounded to either side of zero, as all those of points at one place."""
    rng = np.random.default_rng(0)
    count, size = 400, 6
    begin, direction = rng.uniform(-60.0, 60.0, (count, 3)), rng.normal(size=(count, 3))
    along = rng.uniform(0.0, 0.3, (count, size)) * (rng.uniform(size=(count, 1)) > 0.1)
    direction[: count // 2, :2] = 0.0  # upright ones
    points = np.ascontiguousarray((begin[:, None] + along[..., None] * direction[:, None]).reshape(-1, 3))
    voxel_map = map_of(points, size=1.0, alone=5)
    cells = voxel_map.voxels.cells[: len(voxel_map)]
    assert (cells[:, Cell.THICKNESS] >= 0.0).all() and (cells[:, Cell.SHAPE] == 2.0).any()
    correspondence, weight = weighed(voxel_map, points, np.eye(4), 1.0)
    assert (correspondence >= 0).all() and ((weight >= 0.0) & (weight <= 1.0)).all()


def ring_on(surface_m):
    """Where one ring strikes a surface that is surface_m(azimuth) away, good to 2 cm along the ray."""
    rng = np.random.default_rng(0)
    azimuth = rng.uniform(-0.3, 0.3, 4000)
    cone = np.column_stack([np.cos(azimuth), np.sin(azimuth), np.full(4000, np.tan(0.1))])
    ranges = surface_m(azimuth) + 0.02 * rng.normal(size=4000)
    return cone / np.linalg.norm(cone, axis=1)[:, None] * ranges[:, None]


@pytest.mark.parametrize("passes", [1, 10])
def test_a_ring_seen_over_and_over_is_no_surface(passes):
    """Neither the arc on a smooth wall nor the sheet that a ragged hedge makes of it."""
    arc = ring_on(lambda azimuth: 15.0 / np.cos(azimuth))
    hedge = ring_on(lambda azimuth: 15.0 + np.sin(40.0 * azimuth))
    assert max(weight_of(arc, passes), weight_of(hedge, passes)) < 0.05


def associated(voxel_map, points, T):
    """The problem of points at T, every correspondence with the weight one; twists about zero."""
    k = lie.twist_size(T)
    settings = settings_of(MatchingConfig(), voxel_map, wide=False)
    problem = icp.problem_of(voxel_map.voxels, points, T, np.zeros((k, k)), settings)
    associate(voxel_map.voxels, points, T, 1, 1.0, problem.correspondence)
    problem.weight.fill(1.0)
    return problem._replace(origin=np.zeros(3))


def test_pairs_of_the_closed_form_are_points_and_the_closest_ones_on_planes_and_lines(dimension):
    points, T, scale_m = some_points(dimension), lie.exp(np.linspace(0.05, -0.08, 3 if dimension == 2 else 6)), 0.2
    voxel_map = map_of(points)
    problem = associated(voxel_map, points, T)
    source, closest, weight = np.empty_like(points), np.empty_like(points), np.empty(len(points))
    count = icp.closest_pairs(problem, T, scale_m, source, closest, weight)
    pairs, moved = paired(voxel_map, problem.correspondence), lie.transform(T, points)
    assert {kind for _, _, kind, _ in pairs} >= ({"plane", "point"} if dimension == 2 else set(SHAPES.values()))
    assert count == len(pairs)
    for k, (i, mean, kind, direction) in enumerate(pairs):
        r, a = naive.residual(moved[i], mean, kind, direction, 1.0), problem.weight[i]
        if kind == "plane":
            r = r * direction
        np.testing.assert_allclose(source[k], moved[i], atol=1e-12)
        np.testing.assert_allclose(closest[k], moved[i] - r, atol=1e-12)
        assert weight[k] == pytest.approx(a * (scale_m**2 / (scale_m**2 + a * r @ r)) ** 2, rel=1e-9)


def test_normal_equations_are_the_gradient_and_hessian_of_the_cost(dimension):
    points = some_points(dimension)
    voxel_map = map_of(points)
    k = 3 if dimension == 2 else 6
    T = lie.exp(np.linspace(0.05, -0.08, k))
    origin = np.array([0.7, -0.4, 0.3]) * ([1, 1, 0] if dimension == 2 else 1)
    scale, weight = 0.2, np.random.default_rng(3).uniform(0.1, 1.0, len(points))
    problem = associated(voxel_map, points, T)._replace(origin=origin, weight=weight)
    pairs = paired(voxel_map, problem.correspondence)
    assert {kind for _, _, kind, _ in pairs} >= ({"plane", "point"} if dimension == 2 else set(SHAPES.values()))
    H, b = np.empty((k, k)), np.empty(k)
    total, _, _ = normal_equations(problem, T, scale, 0.0, H, b)
    assert total == pytest.approx(naive.cost(points, pairs, T, scale, weight), rel=1e-12)
    np.testing.assert_allclose(
        H, naive.gauss_newton_hessian(points, pairs, T, origin[:dimension], scale, weight), rtol=1e-6, atol=1e-5
    )
    moved = np.empty_like(T)
    for axis in range(k):
        ends = []
        for sign in (1e-6, -1e-6):
            perturb(sign * np.eye(k)[axis], T.copy(), origin, moved)
            ends.append(naive.cost(points, pairs, moved, scale, weight))
        assert b[axis] == pytest.approx((ends[0] - ends[1]) / 2e-6, rel=1e-5, abs=1e-6)


def test_second_order_hessian_is_the_curvature_of_the_squared_residuals(dimension):
    points = some_points(dimension)
    voxel_map = map_of(points)
    k = 3 if dimension == 2 else 6
    T = lie.exp(np.linspace(0.05, -0.08, k))
    problem, origin = associated(voxel_map, points, T), np.zeros(3)
    H, b = np.empty((k, k)), np.empty(k)
    normal_equations(problem, T, residuals.WITHOUT_KERNEL_M, 1.0, H, b)  # the cost is plain least squares
    h, moved, gradients = 1e-5, np.empty_like(T), []
    for axis in range(k):
        ends = []
        for sign in (h, -h):
            perturb(sign * np.eye(k)[axis], T.copy(), origin, moved)
            normal_equations(problem, moved, residuals.WITHOUT_KERNEL_M, 0.0, np.empty((k, k)), b)
            ends.append(b.copy())
        gradients.append((ends[0] - ends[1]) / (2 * h))
    numeric = np.array(gradients)
    np.testing.assert_allclose(H, 0.5 * (numeric + numeric.T), rtol=1e-4, atol=1e-3 * np.abs(H).max())


@pytest.mark.parametrize(
    "twist", [[0.1, -0.2, 1e-12], [0.5, 0.1, 3.1], [1, 2, 3, 1e-7, 0, 0], [1, 2, 3, 0.5, -2, 2]]
)
def test_perturbation_is_the_exponential_about_the_origin(twist):
    twist = np.array(twist, float)
    T = lie.exp(twist[::-1].copy())
    origin = np.array([3.0, -1.0, 0.0 if len(twist) == 3 else 2.0])
    shift = lie.identity(T.shape[0] - 1)
    shift[:-1, -1] = origin[: T.shape[0] - 1]
    out, before = np.empty_like(T), T.copy()
    perturb(twist, T, origin, out)
    np.testing.assert_allclose(out, shift @ lie.exp(twist) @ lie.inverse(shift) @ T, atol=1e-12)
    np.testing.assert_allclose(T, before, atol=1e-15)


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_damped_solve_equals_numpy_and_says_so_where_the_system_is_singular(damping):
    rng = np.random.default_rng(5)
    B, b = rng.normal(size=(8, 6)), rng.normal(size=6)
    H, x = B.T @ B, np.empty(6)
    assert icp.step(icp.Optimizer.LEVENBERG_MARQUARDT, H, b, damping, np.empty((6, 6)), x)
    np.testing.assert_allclose(x, -np.linalg.solve(H + damping * np.diag(np.diag(H)), b), rtol=1e-9)
    singular, room, x = np.diag([1.0, 0.0, 1.0]), np.empty((3, 3)), np.empty(3)
    assert not icp.step(icp.Optimizer.LEVENBERG_MARQUARDT, singular, np.ones(3), 0.5, room, x)


@pytest.mark.parametrize(
    "optimizer", [icp.Optimizer.NEWTON, icp.Optimizer.GAUSS_NEWTON, icp.Optimizer.GRADIENT_DESCENT]
)
def test_a_step_decreases_a_quadratic_as_much_as_predicted(optimizer):
    rng = np.random.default_rng(6)
    B, b = rng.normal(size=(8, 6)), rng.normal(size=6)
    H, x = B.T @ B, np.empty(6)
    assert icp.step(optimizer, H, b, 0.0, np.empty((6, 6)), x)
    decrease = -(b @ x + 0.5 * x @ H @ x)
    assert decrease > 0.0
    assert icp.predicted_decrease(H, b, x) == pytest.approx(decrease)
    assert b @ x < 0.0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_downsampling_keeps_the_first_point_of_each_voxel_in_range(dimension, dtype):
    points = some_points(dimension).astype(dtype)
    chosen = np.empty(len(points), np.int32)
    count = scans.first_per_voxel(points, 0.4, 0.5, 3.0, np.arange(2048), chosen)
    assert chosen[:count].tolist() == naive.first_per_voxel(points.astype(float), 0.4, 0.5, 3.0)
    exact = chosen[:count].copy()
    table = np.empty(1 << int(count).bit_length(), np.int64)
    assert scans.first_per_voxel(points, 0.4, 0.5, 3.0, table, exact) == count
    assert scans.first_per_voxel(points, 0.4, 0.5, 3.0, table, exact[1:].copy()) == -1


@pytest.mark.parametrize(
    ("twist", "deskew"),
    [
        ([1.0, 0.2, 0.3], scans.deskew_in_plane),
        ([1.0, 0.2, 0.1, 0.02, -0.05, 0.3], scans.deskew_in_space),
        ([1.0, 0.2, 0.1, 0.0, 0.0, 0.0], scans.deskew_in_space),
        ([1.0, 0.2, 0.1, 0.6, -0.5, 0.6], scans.deskew_in_space),
        ([1.0, 0.2, 0.1, 4.0, -5.0, 3.0], scans.deskew_in_space),
    ],
)
def test_deskewing_moves_each_point_along_the_motion(twist, deskew):
    points = some_points(2 if len(twist) == 3 else 3)
    shares = np.linspace(-0.5, 1.0, len(points))
    expected = naive.deskew(points, shares, np.array(twist))
    deskew(points, shares, np.array(twist))
    np.testing.assert_allclose(points, expected, atol=1e-12)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
@pytest.mark.parametrize("shape", [(0, 3), (3, 3), (1700, 2), (1500,)])
def test_the_largest_magnitude_is_that_of_all_entries_and_infinite_where_one_is_not_finite(shape, dtype):
    array = np.random.default_rng(2).normal(size=shape).astype(dtype)
    assert largest_magnitude(array) == np.abs(array).max(initial=0.0)
    for place in {0, array.size // 2, array.size - 1} if array.size else ():
        for bad in (np.nan, np.inf, -np.inf):
            spoiled = array.copy()
            spoiled.flat[place] = bad
            assert largest_magnitude(spoiled) == np.inf
