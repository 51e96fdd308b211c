"""Public functions end in a right answer, or in an InputError that names the argument and what is wanted."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import scanchain as sc
from scanchain import Config, InputError, Odometry, PoseGraph, Slam, Trajectory, VoxelMap, lie, load_settings
from scanchain.config import GraphConfig, LocalMapConfig, MapsConfig, MatchingConfig
from scanchain.evaluation import absolute_error, pair
from scanchain.maps import OccupancyGrid, PointMap

CALLS = 200


def place(dimension, count, rng, unit=1.0):
    """Points on the walls, boxes and floor of an L-shaped room: no motion maps it onto itself."""
    corners = np.array([(-6, -4), (5, -4), (5, 2), (1, 2), (1, 6), (-6, 6), (-6, -4)], float)
    boxes = np.array(
        [((-3, 0), (-1.5, 1)), ((3, -2), (3.6, -2)), ((3, -2), (3, -1.4)), ((-4, 3), (-3.4, 3.6))], float
    )
    walls = np.concatenate([np.stack([corners[:-1], corners[1:]], axis=1), boxes])
    lengths = np.linalg.norm(walls[:, 1] - walls[:, 0], axis=1)
    chosen = rng.choice(len(walls), count, p=lengths / lengths.sum())
    xy = walls[chosen, 0] + rng.uniform(size=(count, 1)) * (walls[chosen, 1] - walls[chosen, 0])
    if dimension == 2:
        return unit * xy
    points = np.column_stack([xy, rng.uniform(-1.0, 2.0, count)])
    floor = rng.uniform(size=count) < 0.25
    points[floor] = np.column_stack([rng.uniform((-6, -4), (5, 2), (floor.sum(), 2)), np.full(floor.sum(), -1.0)])
    return unit * points


def mapped(points, matcher="plicp"):
    """A matcher, and the points in a voxel map at the origin."""
    dimension = points.shape[1]
    config = load_settings(dimension).config
    target = VoxelMap(dimension, config.local_map)
    target.insert(points, lie.identity(dimension))
    return sc.create_matcher(msgspec.structs.replace(config.matching, matcher=matcher)), target


def scan(points, **changes):
    given = {"times_s": np.empty(0, np.float32), "T_odom_base": None, **changes}
    return sc.Scan(index=0, stamp_ns=0, log_time_ns=0, dropped=0, points=points, **given)


def finished():
    """A chain that gave its result."""
    slam = Slam(Config(), I4)
    slam.process(scan(ROOM))
    slam.finish()
    return slam


ROOM = place(3, 4000, np.random.default_rng(0))
FLAT = place(2, 2000, np.random.default_rng(0))
I3, I4 = np.eye(3), np.eye(4)
RECORDS = np.zeros(10, [("x", np.float32), ("y", np.float32), ("z", np.float32), ("intensity", np.float32)])


class Open3DCloud:
    """A cloud as Open3D has it."""

    points = np.ones((10, 3))


@pytest.mark.parametrize(
    ("call", "words"),
    [
        (lambda: VoxelMap(4, LocalMapConfig()), "dimension is 4; it must be 2"),
        (lambda: VoxelMap(3, Config()), "config is .*; wanted a LocalMapConfig"),
        (lambda: LocalMapConfig(voxel_size_m=-1.0), "voxel_size_m is -1.0; it must be a number > 0, in m"),
        (lambda: MatchingConfig(matcher="gicp"), "matching.matcher is 'gicp'; it must be one of plicp, svd"),
        (lambda: MatchingConfig(max_iterations=2.5), "matching.max_iterations is 2.5; it must be a whole number"),
        (lambda: Odometry(MatchingConfig(), I4), "config is .*; wanted a Config"),
        (lambda: Odometry(Config(), 2.0 * I4), r"T_base_lidar is not a rigid transformation \(off by 3\)"),
        (lambda: sc.create_matcher(Config()), "config is .*; wanted a MatchingConfig"),
        (lambda: scan(np.zeros((9, 4))), r"points has the shape \(9, 4\); wanted \(N, 3\).*points\[:, :3\]"),
        (lambda: scan(np.zeros((9, 3)), times_s=np.arange(8.0)), r"times_s has the shape \(8,\); wanted \(9,\)"),
        (lambda: scan(np.zeros((2, 3)), times_s=[0, 10**8]), "times_s: a point lies 1e.08 s from the stamp"),
        (lambda: Slam(Config(), I4).finish(), "no scan was processed"),
        (lambda: finished().finish(), "Slam.finish was called: .*; begin another Slam"),
        (lambda: sc.open_log(3), "a log is 3; wanted a path"),
        (lambda: sc.open_log([]), "no log was given; wanted a path"),
        (lambda: replace(scan(I3), stamp_ns=1.7e9), "stamp_ns is 1700000000.0; wanted nanoseconds as int"),
        (lambda: Odometry(Config(), I4).process(I3), "scan is an array of the shape .*; wanted a Scan"),
        (lambda: Odometry(Config(), I4).process(scan(FLAT)), "scan 0 has 2D points; wanted"),
        (lambda: PoseGraph(2).add_pose(I4, 0), r"T_world has the shape \(4, 4\); wanted a \(3, 3\) pose"),
        (lambda: PoseGraph(2).add_edge(0, 1, I3, np.eye(6)), r"information has the shape \(6, 6\); wanted"),
        (lambda: PoseGraph(2).add_edges([[0.5, 1]], I3[None], I3[None], [False]), "edges holds float64; wanted"),
        (lambda: PoseGraph(2).add_edge(0, 1, I3, I3, is_loop="no"), "is_loop is 'no'; wanted True or False"),
        (lambda: PoseGraph(2).optimize(Config()), "config is .*; wanted a GraphConfig"),
        (lambda: PoseGraph(2).optimize(GraphConfig(), initialize="best"), "initialize is 'best'; it must be"),
        (lambda: sc.open_log("a.mcap", Config()), "config is .*; wanted a LogConfig"),
        (lambda: sc.rigid_transform(ROOM, ROOM[:-1], np.ones(len(ROOM))), "wanted pairs"),
        (lambda: sc.rigid_transform(ROOM, ROOM, -np.ones(len(ROOM))), "weight holds negative"),
        (lambda: sc.rigid_transform(1e200 * ROOM, ROOM), r"source holds .*e\+20\d, over 1e\+50; give meters"),
        (lambda: sc.write_tum("/nope/x", Trajectory([0], I4[None])), "/nope/x: cannot be written .*folder"),
        (lambda: sc.write_tum("a.tum", "abc"), "trajectory is 'abc'; wanted a Trajectory"),
        (lambda: Trajectory(np.arange(3), np.zeros((2, 4, 4))), r"poses has the shape \(2, 4, 4\)"),
        (lambda: Odometry(dimension=2, T_base_lidar=I4), r"dimension is 2, but T_base_lidar .* SE\(3\)"),
        (lambda: Odometry(dimension=2).process(sc.Scan.of(ROOM, 0.0)), "has 3D points"),
        (lambda: Odometry().process(sc.Scan.of(ROOM, 1_700_000_000_000_000_000)), "stamp_s is 17"),
        (lambda: Slam(Config(), dimension=2), r"made for 3D .* start from load_settings\(2\).config"),
        (lambda: sc.downsample(ROOM, 0.0), "voxel_size_m is 0"),
        (lambda: sc.downsample(RECORDS, 1.0), r"np\.stack\(\[points\[axis\] for axis in 'xyz'\], axis=1\)"),
        (lambda: sc.downsample(ROOM + 5.4e6, 0.002), r"points lie up to 5.4e\+06 m from the origin"),
        (lambda: sc.downsample(np.array([[0.0, 0.0], [2.0**21, 0.0]]), 1.0), r"2.1e\+06 m apart"),
        (lambda: sc.run("nowhere.mcap", "out"), "nowhere.mcap"),
        (lambda: sc.run("nowhere.mcap", 3), "out is 3; wanted a path"),
        (lambda: sc.optimize(PoseGraph(2), max_iter=3), r"did you mean graph__max_iterations\?"),
        (lambda: sc.optimize("graph.g2o"), r"graph is 'graph.g2o'; wanted a PoseGraph: read_g2o\(path\).graph"),
        (lambda: sc.align(Open3DCloud(), ROOM), r"target holds objects.*: np\.asarray\(target\.points\)"),
        (lambda: sc.align(ROOM.reshape(2, -1, 3), ROOM), r"organized\? pass target\.reshape\(-1, 3\)"),
        (lambda: sc.align(ROOM, FLAT), "source has the shape"),
        (lambda: sc.align(ROOM.T, ROOM), "target has the shape"),
        (lambda: sc.align(np.hstack([ROOM, ROOM]), ROOM), "target has the shape"),
        (lambda: sc.align(ROOM, ROOM[:0]), "source has no points"),
        (lambda: sc.align(np.zeros((50, 3)), ROOM), "target: its 50 points lie on one point"),
        (lambda: sc.align(ROOM, np.full((5, 3), np.nan)), "source has no points that are finite"),
        (lambda: sc.align(ROOM, ROOM, 2.0 * I4), "T_guess is not a rigid"),
        (lambda: sc.align(ROOM, ROOM, I3), "T_guess has the shape"),
        (lambda: sc.align(ROOM, ROOM + 1e6), r"T_guess puts the centroid of the source 1.73e\+06 m"),
        (lambda: sc.align(ROOM, ROOM, voxel_size_m=-1.0), "voxel_size_m is -1"),
        (lambda: sc.align(ROOM, ROOM, matcher="gicp"), "matcher"),
        (lambda: sc.align("clouds", ROOM), "target"),
        (lambda: OccupancyGrid(MapsConfig()).insert(np.nan * I3, np.ones((1, 2))), "not finite"),
        (lambda: PointMap(2, 0.1).insert(np.nan * I3, np.ones((1, 2))), "not finite"),
    ],
)  # fmt: skip
def test_a_wrong_argument_is_named_with_what_came_and_what_is_wanted(call, words):
    with pytest.raises(InputError, match=words) as error:
        call()
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("matcher", ["plicp", "svd"])
@pytest.mark.parametrize(
    ("points", "T_first", "words"),
    [
        (np.column_stack([ROOM, np.ones(len(ROOM))]), I4, r"wanted \(N, 3\).*points\[:, :3\]"),
        (ROOM[:, :2], I4, r"wanted \(N, 3\), one row per point; 2D points need a 2D map"),
        (ROOM.T, I4, "transposed"),
        ([["a", "b", "c"]], I4, "points holds text, not real numbers"),
        ([[1.0, 2.0, 3.0], [4.0]], I4, "no array"),
        (np.where(ROOM > 1.9, np.nan, ROOM), I4, "points: .* of 4,000 points are NaN or infinite"),
        (1e7 * ROOM, I4, "points reach .* m from the origin"),
        (ROOM, np.diag([1.0, 1.0, -1.0, 1.0]), "T_first is not a rigid transformation"),
        (ROOM, I3, r"T_first has the shape \(3, 3\); wanted a \(4, 4\) pose, because the points are 3D"),
        (ROOM, None, "T_first is None; wanted a"),
    ],
)
def test_what_cannot_be_aligned_or_inserted_is_refused(matcher, points, T_first, words):
    align, target = mapped(ROOM, matcher)
    with pytest.raises(InputError, match="wide is 'no'; wanted True or False"):
        align.align(ROOM, target, I4, wide="no")
    with pytest.raises(InputError, match=words):
        align.align(points, target, T_first)
    with pytest.raises(InputError, match=words.replace("T_first", "T_map_lidar")):
        target.insert(points, T_first)


@pytest.mark.parametrize("matcher", ["plicp", "svd"])
@pytest.mark.parametrize(
    "as_given",
    [
        lambda points: points.tolist(),
        lambda points: points.astype(np.float32),
        np.asfortranarray,
        lambda points: np.column_stack([points, points])[:, :3],
        lambda points: np.frombuffer(points.tobytes()).reshape(-1, 3),  # read-only
    ],
)
def test_what_converts_without_loss_is_aligned_like_a_contiguous_array_of_doubles(matcher, as_given):
    align, target = mapped(ROOM, matcher)
    points = (ROOM[::4] - [0.1, 0.05, 0.0]).astype(np.float32).astype(float)
    same, given = align.align(points, target, I4), align.align(as_given(points), target, I4.tolist())
    np.testing.assert_array_equal(given.T_target_source, same.T_target_source)
    assert given.converged


@pytest.mark.parametrize("matcher", ["plicp", "svd"])
def test_a_single_point_or_a_plane_is_not_called_converged(matcher):
    align, target = mapped(ROOM, matcher)
    for points in (ROOM[:1], ROOM[:5], ROOM[ROOM[:, 2] == -1.0]):
        match = align.align(points, target, I4, wide=True)
        assert not match.converged and match.reason != "converged"


def corridor(beams, noise_m, rng):
    """A laser scan between two walls without end, which looks the same everywhere."""
    angles = np.linspace(-np.pi, np.pi, beams, endpoint=False)
    ranges = 1.0 / np.maximum(np.abs(np.sin(angles)), 1e-6) + noise_m * rng.normal(size=beams)
    seen = ranges < 30.0
    return (ranges[:, None] * np.column_stack([np.cos(angles), np.sin(angles)]))[seen]


@pytest.mark.parametrize("matcher", ["plicp", "svd"])
@pytest.mark.parametrize(("noise_m", "beams"), [(0.005, 360), (0.01, 1080), (0.03, 360), (0.03, 1080)])
def test_scans_of_a_bare_corridor_are_not_called_converged_however_noisy(matcher, noise_m, beams):
    """Noise bends the walls' normals, which then seem to hold the scan along the corridor."""
    rng = np.random.default_rng(0)
    for _ in range(5):
        align, target = mapped(corridor(beams, noise_m, rng), matcher)
        match = align.align(corridor(beams, noise_m, rng), target, I3, wide=True)
        assert not match.converged and "undetermined" in match.reason


shapes = st.one_of(
    st.tuples(st.integers(0, 40), st.integers(0, 5)),
    st.tuples(st.integers(0, 5), st.integers(0, 40)),
    st.lists(st.integers(0, 4), max_size=4).map(tuple),
)
dtypes = st.sampled_from(
    ["f2", "f4", "f8", "g", "i1", "i2", "i8", "u1", "u8", "?", "c16", "O", "U3", "S3", "M8[s]", "V4"]
)


@st.composite
def arrays(draw):
    """Anything a caller may mistake for points, poses, times or matrices."""
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    values = np.asarray(rng.normal(size=draw(shapes)) * 10.0 ** draw(st.integers(-6, 12)))
    if values.size and draw(st.booleans()):
        values.flat[rng.integers(values.size)] = draw(st.sampled_from([np.nan, np.inf, -np.inf]))
    dtype = draw(dtypes)
    with np.errstate(all="ignore"):
        array = np.zeros(values.shape, dtype) if dtype in ("M8[s]", "V4") else values.astype(dtype)
    form = draw(st.sampled_from(["as it is", "list", "read-only", "fortran", "masked", "strided"]))
    if form == "list":
        rows = array.tolist()
        return [*rows, [1.0]] if isinstance(rows, list) and draw(st.booleans()) else rows
    if form == "masked":
        return np.ma.masked_invalid(array) if array.dtype.kind == "f" else array
    if form == "fortran":
        array = np.asfortranarray(array)
    if form == "strided" and array.ndim:
        array = np.repeat(array, 2, axis=0)[::2]
    if form == "read-only":
        array.flags.writeable = False
    return array


@st.composite
def poses(draw):
    """Rigid transformations of both dimensions and all sizes, and what only looks like one."""
    k = draw(st.sampled_from([3, 6]))
    rng = np.random.default_rng(draw(st.integers(0, 2**32)))
    T = lie.exp(rng.normal(size=k) * 10.0 ** draw(st.integers(-6, 8)))
    return draw(st.sampled_from([T, T, T, T.astype(np.float32), 2.0 * T, -T, T[:-1], T.T, T.tolist(), None, "T"]))


numbers = st.one_of(st.integers(), st.floats(), st.none(), st.text(max_size=2), st.booleans(), arrays())
anything = st.one_of(arrays(), poses(), numbers)
good_points = st.sampled_from([ROOM[::40], ROOM[::7] * 3.0, FLAT[::30], FLAT[::9] + 1e-3])


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("fuzz")


def fuzzed(*strategies):
    """So many calls, the same each time; what is drawn twice is right as often as it is not."""
    return lambda test: settings(max_examples=CALLS, derandomize=True)(given(*strategies)(test))


def tried(call):
    """The answer, or None where it was refused with one line that names something."""
    try:
        return call()
    except sc.ScanchainError as error:
        assert isinstance(error, InputError) or "pairs" in str(error)
        assert "\n" not in str(error) and len(str(error)) > 20
        return None


@fuzzed(st.sampled_from([2, 3]), st.one_of(arrays(), good_points), st.one_of(poses(), st.sampled_from([I3, I4])))
def test_inserting_anything_into_a_map_leaves_finite_voxels_or_an_input_error(dimension, points, T):
    target = VoxelMap(dimension, Config().local_map)
    tried(lambda: target.insert(points, T))
    assert np.isfinite(target.points()).all()


SURFACES = {(d, m): mapped(p, m) for d, p in ((2, FLAT), (3, ROOM)) for m in ("plicp", "svd")}


@fuzzed(
    st.sampled_from([2, 3]), st.sampled_from(["plicp", "svd"]), st.one_of(arrays(), good_points),
    st.one_of(poses(), st.sampled_from([I3, I4])), st.booleans(),
)  # fmt: skip
def test_aligning_anything_ends_in_a_finite_pose_or_an_input_error(dimension, matcher, points, T, wide):
    align, target = SURFACES[dimension, matcher]
    match = tried(lambda: align.align(points, target, T, wide=wide))
    assert match is None or np.isfinite(match.T_target_source).all() or not match.converged


@fuzzed(
    st.sampled_from([2, 3]), st.sampled_from(["plicp", "svd"]), st.booleans(), st.integers(0, 2**32),
    st.floats(-2.0, 2.0), st.floats(0.5, 3.5), st.floats(1.0, 3.5), st.floats(-2.0, 1.0),
)  # fmt: skip
def test_a_pose_called_converged_is_right_whatever_the_scale_density_and_motion(
    dimension, matcher, wide, seed, scale, points, surfaces, motion
):
    """Scale of the place, points of source and target and size of the motion as powers of ten."""
    rng, unit = np.random.default_rng(seed), 10.0**scale
    align, target = mapped(place(dimension, int(10**surfaces), rng, unit), matcher)
    k = 3 if dimension == 2 else 6
    T = lie.exp(10.0**motion * rng.normal(size=k) * lie.by_component(k, 1.0, 0.3))
    source = lie.transform(lie.inverse(T), place(dimension, int(10**points), rng, unit))
    source += 0.01 * rng.uniform() * rng.normal(size=source.shape)
    match = align.align(source, target, lie.identity(dimension), wide=wide)
    distance_m, angle_rad = lie.apart(T, match.T_target_source)
    limit_m = 0.1 if dimension == 2 else 0.5  # a voxel in the plane, half a voxel in space
    assert not match.converged or (distance_m < limit_m and angle_rad < 0.15), match


@fuzzed(arrays(), arrays(), arrays())
def test_the_closed_form_takes_pairs_or_refuses_them(source, target, weight):
    T = tried(lambda: sc.rigid_transform(source, target, weight))
    assert T is None or np.isfinite(T).all()


times = st.one_of(anything, st.just(np.empty(0)))


@fuzzed(st.one_of(arrays(), good_points), times, st.one_of(anything, st.none()), st.integers(0, 10**10))
def test_odometry_and_slam_go_on_after_any_scan_that_they_take(points, times_s, T_odom_base, later_ns):
    for d, place_ in ((2, FLAT[::10]), (3, ROOM[::10])):
        slam = Slam(load_settings(d).config, lie.identity(d))
        slam.process(scan(place_))
        given = {"times_s": times_s, "T_odom_base": T_odom_base}
        tried(lambda: slam.process(replace(scan(points, **given), stamp_ns=later_ns)))  # noqa: B023
        assert np.isfinite(slam.process(replace(scan(place_), stamp_ns=2 * 10**8)).T_world_lidar).all()


@fuzzed(st.sampled_from([2, 3]), poses(), poses(), st.one_of(arrays(), st.just(I3), st.just(np.eye(6))), anything)
def test_a_graph_takes_poses_and_edges_or_refuses_them_and_stays_whole(dimension, T, T_ij, information, index):
    graph = PoseGraph(dimension)
    graph.add_pose(lie.identity(dimension), 0)
    tried(lambda: graph.add_pose(T, index))
    tried(lambda: graph.add_pose(lie.identity(dimension), 1))
    tried(lambda: graph.add_point(information, 0))
    tried(lambda: graph.add_edge(0, 1, T_ij, information))
    tried(lambda: graph.add_edges(information, T_ij, index, T))
    tried(lambda: graph.fix(index))
    assert np.isfinite(graph.poses).all() and np.isfinite(graph.information).all()
    assert len(graph.edges) == len(graph.measurements) == len(graph.information) == len(graph.is_loop)


@fuzzed(arrays(), st.one_of(arrays(), st.lists(poses(), max_size=4)), st.lists(st.integers(0, 10**10), max_size=4))
def test_a_trajectory_of_anything_is_written_and_read_and_judged_or_refused(folder, stamps_ns, poses, whole):
    for stamps in (stamps_ns, whole, np.arange(len(poses) if isinstance(poses, list) else 4)):
        made = tried(lambda: Trajectory(stamps, poses))  # noqa: B023
        if made is not None and len(made):
            sc.write_tum(folder / "a.tum", made, force=True)
            again = sc.read_tum(folder / "a.tum")
            assert np.abs(again.poses - lie.lift(made.poses)).max() <= 1e-3 * max(1.0, np.abs(made.poses).max())
            error = tried(lambda: absolute_error(pair(made, made)))  # noqa: B023
            is_one_to_one = len(set(made.stamps_ns.tolist())) == len(made)
            assert (
                error is None or not is_one_to_one or error.translation_m.rmse <= 1e-6 * np.abs(made.poses).max()
            )


@fuzzed(st.sampled_from([*msgspec.structs.fields(Config)]), st.data())
def test_any_value_of_any_key_makes_a_valid_configuration_or_is_refused(section, data):
    leaf = data.draw(st.sampled_from(msgspec.structs.fields(section.type)))
    value = data.draw(numbers)
    made = tried(lambda: section.type(**{leaf.name: value}))
    if made is not None:
        config = Config(**{section.name: made})
        assert msgspec.convert(msgspec.to_builtins(config), Config) == config
