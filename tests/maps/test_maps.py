"""Maps: kernels equal their slow twins, files mean to others what the grid means to us."""

import math
from dataclasses import replace

import laspy
import numpy as np
import pytest

from scanchain import lie, maps, processes
from scanchain.baselines import Open3dPairs
from scanchain.checks import LARGEST
from scanchain.config import MapsConfig
from scanchain.errors import InputError
from scanchain.logs import open_log
from scanchain.logs.formats.clouds import read_pcd
from scanchain.maps.occupancy_grid import _LOG_ODDS, OCCUPIED_PROBABILITY
from scanchain.runs.results import results_of
from scanchain.slam import Slam
from tests.support import made
from tests.support import naive_maps as naive

RESOLUTION_M = 0.1
HIT, MISS, *_ = _LOG_ODDS
CONFIG = MapsConfig(grid_resolution_m=RESOLUTION_M)
ENDLESS = MapsConfig(grid_resolution_m=RESOLUTION_M, grid_max_range_m=LARGEST)


def random_scans(count=12, beams=80, seed=0):
    """Poses that wander over some meters, and scans of returns all around."""
    random = np.random.default_rng(seed)
    poses = np.array([lie.pose_2d(*random.normal(scale=[3, 2, 2])) for _ in range(count)])
    angles = random.uniform(-np.pi, np.pi, (count, beams))
    ranges = random.uniform(0.02, 9.0, (count, beams))
    return poses, np.stack([ranges * np.cos(angles), ranges * np.sin(angles)], axis=2)


def cell(grid, x, y):
    """Log-odds of the cell at a place in the world."""
    column, row = np.floor((np.array([x, y]) - grid.origin_m) / grid.resolution_m).astype(int)
    return grid.log_odds[row, column]


def hits(grid):
    """Number of cells in which beams end."""
    return int((grid.log_odds == np.float32(HIT)).sum())


@pytest.mark.parametrize("batch", [1, 5])
def test_drawn_beams_equal_naive(batch):
    poses, scans = random_scans()
    grid = maps.OccupancyGrid(CONFIG)
    for first in range(0, len(scans), batch):
        some = scans[first : first + batch]
        grid.insert_batch(poses[first : first + batch], some.reshape(-1, 2), 80 * np.arange(len(some) + 1))
    grid = grid.trimmed()
    beams = [
        [(T[:2, 2], lie.transform(T, point[None])[0]) for point in scan]
        for T, scan in zip(poses, scans, strict=True)
    ]
    expected = naive.draw(beams, RESOLUTION_M, *_LOG_ODDS)
    corner = np.round(grid.origin_m / RESOLUTION_M).astype(int)
    rows, columns = np.nonzero(grid.drawn)
    seen = {(int(c + corner[0]), int(r + corner[1])) for r, c in zip(rows, columns, strict=True)}
    assert seen == set(expected)
    for (column, row), value in expected.items():
        assert grid.log_odds[row - corner[1], column - corner[0]] == pytest.approx(value, abs=1e-5)


def test_returns_beyond_the_usable_range_do_not_carve():
    grid = maps.OccupancyGrid(MapsConfig(grid_resolution_m=RESOLUTION_M, grid_max_range_m=5.0))
    grid.insert(lie.identity(2), np.array([[0.0, 4.0], [9.0, 0.0], [np.nan, 1.0], [np.inf, 1.0]]))
    assert hits(grid) == 1
    assert grid.trimmed().log_odds.shape == (41, 1)


TURNED = lie.exp(np.array([1.0, 2.0, 10.0, 0, 0, 0])) @ lie.exp(np.array([0, 0, 0, 0, 0, np.pi / 2]))
TILTED, FAR = lie.exp(np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0])), np.array([4.05, 0.05, 0.0])


@pytest.mark.parametrize(
    ("T", "points", "hit"),
    [
        (TURNED, np.array([[3.0, 0.0, 0.2], [0.0, 3.0, 1.5], [0.0, -3.0, -1.7]]), (1.0, 5.05)),
        (TILTED, np.vstack([[4.0, 0, 0], lie.transform(lie.inverse(TILTED), FAR[None])]), FAR[:2]),
    ],
)  # fmt: skip
def test_a_3d_scan_is_drawn_by_its_slice_at_the_height_of_the_lidar_along_the_worlds_vertical(T, points, hit):
    grid = maps.draw_grid([(T, points)], CONFIG)
    assert hits(grid) == 1 and cell(grid, *hit) == np.float32(HIT)
    assert cell(grid, hit[0] - 1.5 * (T is TILTED), hit[1] - 1.5 * (T is TURNED)) == np.float32(MISS)


@pytest.mark.parametrize(("low", "high", "z"), [(0.5, 2.0, 1.0), (-2.0, -0.5, -1.0)])
def test_a_beam_is_drawn_only_where_it_runs_within_the_slice(low, high, z):
    config = MapsConfig(grid_resolution_m=RESOLUTION_M, slice_min_z_m=low, slice_max_z_m=high)
    grid = maps.draw_grid([(lie.identity(3), np.array([[4.05, 0.05, z]]))], config)
    assert cell(grid, 3.0, 0.05) == np.float32(MISS)
    assert grid.origin_m[0] == pytest.approx(2.0)


def test_nav2_reads_cell_0_0_at_the_origin_and_rows_upwards(tmp_path):
    grid = maps.OccupancyGrid(CONFIG)
    for _ in range(5):
        grid.insert(lie.pose_2d(-4.95, 2.05, 0.0), np.array([[3.0, 0.0], [0.0, 2.0]]))
    maps.write_map(tmp_path, grid.trimmed())
    cells, origin, _ = naive.served_map(tmp_path)
    np.testing.assert_allclose(origin, [-5.0, 2.0, 0.0], atol=1e-9)
    assert cells.shape == (21, 31) and set(np.unique(cells)) == {-1, 0, 100}
    assert (cells[0, 0], cells[0, 30], cells[20, 0], cells[20, 30]) == (0, 100, 100, -1)


def test_a_written_map_is_read_back_and_an_empty_one_is_an_unknown_pixel(tmp_path):
    poses, scans = random_scans()
    grid = maps.draw_grid(zip(poses, scans, strict=True), CONFIG)
    maps.write_map(tmp_path, grid)
    cells, resolution_m, origin_m = maps.read_map(tmp_path)
    probability = grid.probability()
    assert resolution_m == RESOLUTION_M and origin_m == pytest.approx(tuple(grid.origin_m))
    assert np.array_equal(cells == 100, probability > 0.65) and np.array_equal(cells == 0, probability < 0.35)
    maps.write_map(tmp_path, maps.OccupancyGrid(CONFIG).trimmed())
    assert naive.served_map(tmp_path)[0].tolist() == maps.read_map(tmp_path)[0].tolist() == [[-1]]


@pytest.mark.parametrize("name", ["map.pgm", "map.yaml", "map.ply"])
def test_a_map_that_is_missing_or_of_another_make_is_refused(tmp_path, name):
    maps.write_map(tmp_path, maps.OccupancyGrid(CONFIG))
    maps.write_ply(tmp_path / "map.ply", np.zeros((1, 3)))
    (tmp_path / name).write_bytes(b"P2 1 1 255 0")
    for message in ("run it again", name):
        with pytest.raises(InputError, match=message):
            maps.read_ply(tmp_path / name) if name == "map.ply" else maps.read_map(tmp_path)
        (tmp_path / name).unlink(missing_ok=True)


def test_a_grid_too_large_for_memory_is_refused_and_a_coarser_one_fits():
    poses = np.array([lie.pose_2d(0, 0, 0), lie.pose_2d(30_000, 20_000, 0)])
    grid = maps.OccupancyGrid(CONFIG)
    grid.insert(poses[0], np.array([[1.0, 0.0]]))
    with pytest.raises(InputError, match=r"raise maps\.grid_resolution_m"):
        grid.insert(poses[1], np.array([[1.0, 0.0]]))
    coarse = maps.fitting_resolution(poses, resolution_m=RESOLUTION_M, max_range_m=80.0)
    assert coarse == 32 * RESOLUTION_M
    grid = maps.OccupancyGrid(MapsConfig(grid_resolution_m=coarse))
    for T in poses:
        grid.insert(T, np.array([[10.0, 0.0]]))
    assert maps.fitting_resolution(poses[:1], resolution_m=RESOLUTION_M, max_range_m=80.0) == RESOLUTION_M


@pytest.mark.parametrize("far_m", [1e12, 1e30, 1e49])
def test_cells_beyond_what_64_bits_count_are_refused_and_not_drawn_elsewhere(far_m):
    for points in ([[1.0, 2.0], [far_m, 0.0]], [[far_m, 0.0], [far_m, 1.0]]):
        grid = maps.OccupancyGrid(ENDLESS)
        with pytest.raises(InputError, match=r"raise maps\.grid_resolution_m"):
            grid.insert(np.eye(3), np.array(points))


def test_voxels_whose_keys_would_repeat_are_doubled_and_a_map_far_from_the_origin_is_not():
    near, apart = np.array([[0.2, 0.0], [2.0**21, 0.0], [2.0**22, 0.0]]), maps.PointMap(2, 1.0)
    apart.insert(np.eye(3), near)
    assert sorted(apart.points().tolist()) == sorted(near.tolist()) and apart.voxel_size_m == 8.0
    utm = maps.PointMap(2, 0.05)
    utm.insert(lie.pose_2d(5e5, 5.4e6, 0.3), np.random.default_rng(0).uniform(-50.0, 50.0, (1000, 2)))
    assert utm.voxel_size_m == 0.05 and len(utm) > 990


def test_a_point_map_equals_naive(dimension):
    random = np.random.default_rng(4)
    poses = [lie.exp(random.normal(size=3 if dimension == 2 else 6)) for _ in range(4)]
    scans = [random.normal(scale=3.0, size=(6000, dimension)) for _ in range(4)]
    built = maps.build_point_map(zip(poses, scans, strict=True), dimension=dimension, voxel_size_m=0.2)
    world = np.concatenate([lie.transform(T, scan) for T, scan in zip(poses, scans, strict=True)])
    np.testing.assert_allclose(built.points(), naive.voxel_means(world, 0.2), atol=1e-9)


def test_a_full_point_map_doubles_its_voxels_and_keeps_every_point():
    random = np.random.default_rng(4)
    built = maps.PointMap(3, 0.1, max_voxels=500)
    points = random.uniform(-10.0, 10.0, (20_000, 3))
    for part in np.array_split(points, 7):
        built.insert(lie.identity(3), part)
    assert len(built) <= 500
    assert built.voxel_size_m in (3.2, 6.4)
    assert built.counts[: len(built)].sum() == 20_000
    voxels = np.floor(built.points() / built.voxel_size_m).astype(int)
    assert len(np.unique(voxels, axis=0)) == len(built)
    np.testing.assert_allclose(built.sums[: len(built)].sum(axis=0), points.sum(axis=0))


def test_points_that_are_not_finite_stay_out_of_the_maps():
    points = np.array([[np.nan, 0.0, 0.0], [np.inf, 0.0, 0.0], [0.0, -np.inf, 0.0], [1.0, 2.0, 0.3]])
    built = maps.build_point_map([(lie.identity(3), points)], dimension=3, voxel_size_m=0.1)
    np.testing.assert_allclose(built.points(), points[3:])
    assert hits(maps.draw_grid([(lie.identity(3), points)], ENDLESS)) == 1


def test_a_ply_file_holds_the_points(tmp_path):
    points = np.random.default_rng(0).normal(size=(100, 2))
    maps.write_ply(tmp_path / "a.ply", points)
    header, body = (tmp_path / "a.ply").read_bytes().split(b"end_header\n")
    assert b"format binary_little_endian 1.0\n" in header
    assert b"element vertex 100\n" in header
    rows = np.frombuffer(body, "<f4").reshape(-1, 3)
    np.testing.assert_allclose(rows[:, :2], points, atol=1e-6)
    assert (rows[:, 2] == 0.0).all()
    np.testing.assert_array_equal(maps.read_ply(tmp_path / "a.ply"), rows)
    library = pytest.importorskip("small_gicp")
    np.testing.assert_array_equal(library.read_ply(str(tmp_path / "a.ply")).points()[:, :3], rows)


@pytest.mark.parametrize(("count", "dimension"), [(100, 2), (100, 3), (0, 3)])
def test_pcd_and_laz_hold_the_points(tmp_path, count, dimension):
    points = np.random.default_rng(0).normal(scale=300.0, size=(count, dimension)) + 1000.0
    expected = np.pad(points, ((0, 0), (0, 3 - dimension)))
    maps.write_pcd(tmp_path / "a.pcd", points)
    ours, library = read_pcd(tmp_path / "a.pcd"), Open3dPairs("point-to-point").open3d
    theirs = np.asarray(library.io.read_point_cloud(str(tmp_path / "a.pcd")).points)
    for read in (np.column_stack([ours[axis] for axis in "xyz"]), theirs):
        np.testing.assert_array_equal(read, expected.astype(np.float32))
    maps.write_laz(tmp_path / "a.laz", points)
    cloud = laspy.read(tmp_path / "a.laz")
    assert cloud.header.are_points_compressed
    np.testing.assert_allclose(cloud.xyz, expected, atol=0.0006)


@pytest.mark.parametrize("tilt_deg", [0.0, 25.0])
def test_the_grid_is_level_however_the_lidar_is_mounted(tilt_deg):
    path = made.log("town", seconds=3, sensor="os1-32")
    T_lidar_level = lie.exp(np.array([0.0, 0.0, 0.0, 0.0, math.radians(tilt_deg), 0.0]))
    log, slam = open_log(path), Slam(dimension=3)
    for scan in log.scans():
        slam.process(replace(scan, points=lie.transform(T_lidar_level, scan.points).astype(np.float32)))
    found = results_of(log, slam.finish(), ())
    tilt_rad = math.acos(min(found.T_world_level[2, 2], 1.0))
    assert math.degrees(tilt_rad) == pytest.approx(tilt_deg, abs=2.0)
    assert [f"tilted by {tilt_deg:.0f} deg" in warning for warning in found.warnings] == [True] * (tilt_deg > 0.0)
    occupied = found.grid.probability() > OCCUPIED_PROBABILITY
    assert occupied.sum() > 450


def test_a_damaged_laz_ends_in_one_line_whatever_it_does_to_its_decoder(tmp_path, monkeypatch):
    path = tmp_path / "m.laz"
    points = np.random.default_rng(0).uniform(-20.0, 20.0, (60_000, 3))
    maps.write_laz(path, points)
    np.testing.assert_allclose(maps.files.read_las(path), points, atol=0.00051)
    data = bytearray(path.read_bytes())
    half = len(data) // 2
    endless = data[:100] + (2**31 - 1).to_bytes(4, "little") + data[104:]  # as many records before the points
    for damaged, words in (
        (data[:half] + data[half + 1 :], "ended by SIGABRT"),  # an abort in Rust, which nothing can catch
        (data[:-1], "LazrsError"),
        (endless, "decoding it takes over 2 s"),
    ):
        monkeypatch.setattr(processes, "_READ_S", 2.0 if damaged is endless else 300.0)
        path.write_bytes(damaged)
        with pytest.raises(InputError, match=f"is no LAS or LAZ file that can be read .*{words}"):
            maps.files.read_las(path)
    monkeypatch.setattr(processes, "_READ_MIB", 1.0)
    with pytest.raises(InputError, match=r"decoding it takes over .* MiB"):
        maps.files.read_las(path)
